"""Surveys the start of a bag: what its topics contain, and the poses and lenses of its sensors."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.cloud_messages import header_at
from slam.datasets.bags.clouds import CloudView, cloud_view
from slam.datasets.bags.decoding import Decoder, frame_name, stamp_of
from slam.datasets.bags.files import Bag
from slam.datasets.bags.images import is_depth
from slam.datasets.bags.imu import quantities_in
from slam.datasets.bags.ouster import Ousters
from slam.datasets.bags.ouster_model import FRAMES, OusterModel
from slam.datasets.bags.records import BagRecord, Channel
from slam.datasets.bags.registered import EXTRINSICS, CameraFacts
from slam.datasets.bags.robots import Robots
from slam.datasets.bags.topics import (
    CAMERA_INFO,
    CLOUDS,
    IMAGES,
    IMU,
    METADATA,
    ODOMETRY,
    SCANS,
    SENSORS,
    STRING,
    TRANSFORMS,
    camera_info_topics,
)
from slam.datasets.bags.transforms import BASE_FRAMES, FrameTree
from slam.datasets.dataset import RecordFault

LOOK_S = 10.0  # of the bag's time, at most
_LEAST_S = 2.0  # of the bag's time, for image stamps and for transforms at 1 Hz
_STAMPS_KEPT = 200
_SAME_S = 1e-6  # no recorder is as even: record times were made of the stamps
OTHER_CLOCK_S = 5.0  # at least one message is recorded faster; the doctor finds smaller offsets


@dataclass(slots=True)
class Survey:
    """The result of a survey of the start of a bag.

    Attributes
    ----------
    channels
        All topics, by name; from the index, or as seen if there is none.
    seen
        Sensor topics with at least one message, even if damaged.
    frames
        Frame of each sensor topic with at least one valid message.
    odometry
        For each odometry topic, its frame and the child frame that it moves.
    lenses
        First usable CameraInfo message of each topic.
    depths
        For each image topic, whether it contains depth.
    stamps_s
        First stamps of each image topic.
    late_s, uneven
        Of each sensor topic, the least record time minus stamp, None without a stamp; topics where it varies.
    clouds, in_pieces
        Properties of the first valid cloud of each topic; and whether the next has another direction.
    scans, scan_stamps_s
        The newest message of each scan topic, and its first stamps.
    imus
        For each IMU topic, whether its first message contains angular rates, and accelerations.
    sizes
        Width and height of the images of each topic whose messages contain them undecoded.
    facts
        What drivers report about their cameras in their own messages.
    ousters
        Metadata of lidars with packets in the bag, by the namespace of their topics.
    robots
        The robots in the bag, and the one that is read.
    """

    channels: dict[str, Channel] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)
    frames: dict[str, str] = field(default_factory=dict)
    odometry: dict[str, tuple[str, str]] = field(default_factory=dict)
    lenses: dict[str, Any] = field(default_factory=dict)
    depths: dict[str, bool] = field(default_factory=dict)
    stamps_s: dict[str, list[float]] = field(default_factory=dict)
    late_s: dict[str, float | None] = field(default_factory=dict)
    uneven: set[str] = field(default_factory=set)
    clouds: dict[str, CloudView] = field(default_factory=dict)
    in_pieces: dict[str, bool] = field(default_factory=dict)
    scans: dict[str, Any] = field(default_factory=dict)
    scan_stamps_s: dict[str, set[float]] = field(default_factory=dict)
    imus: dict[str, tuple[bool, bool]] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    facts: CameraFacts = field(default_factory=CameraFacts)
    ousters: dict[str, OusterModel] = field(default_factory=dict)
    robots: Robots = field(default_factory=Robots)
    tree: FrameTree = field(default_factory=FrameTree)

    def base_frame(self, wheels: Sequence[str] = ()) -> str | None:
        """The robot's frame: the frame that the wheels move, else one with a usual name, else the root.

        Parameters
        ----------
        wheels
            The odometry topics that are read; all if none are given.
        """
        children = [self.odometry[topic][1] for topic in wheels or self.odometry if topic in self.odometry]
        named = self.tree.named(BASE_FRAMES)
        for child in children:
            if child in self.tree:
                # Visual odometry moves the camera, which is mounted on the robot.
                above = [frame for frame in named if self.tree.is_attached(child, frame)]
                return child if child in named or not above else above[0]
        if named:
            return named[0]
        return self.tree.root()

    def is_enough(self, seconds: float) -> bool:
        """Whether everything that the choice depends on is known."""
        if seconds < _LEAST_S:
            return False
        sensors = {topic for topic, channel in self.channels.items() if channel.kind in SENSORS}
        if not sensors <= set(self.frames):
            return False
        infos = {topic for topic, channel in self.channels.items() if channel.kind == CAMERA_INFO}
        placed = {topic for topic, channel in self.channels.items() if EXTRINSICS.search(channel.kind)}
        if not infos <= set(self.lenses) or not placed <= set(self.facts.extrinsics):
            return False
        base = self.base_frame()
        reported = any(channel.kind in TRANSFORMS for channel in self.channels.values())
        mounted = [self.frames[topic] for topic in sensors if self.channels[topic].kind != ODOMETRY]
        return not reported or (
            base is not None and all(self.tree.between(base, frame) is not None for frame in mounted)
        )

    def lens_topic(self, image_topic: str) -> str | None:
        """The CameraInfo topic of an image topic: in its namespace, else the first with its frame."""
        for topic in camera_info_topics(image_topic):
            if topic in self.lenses:
                return topic
        frame = self.frames.get(image_topic)
        same = [topic for topic, lens in self.lenses.items() if frame_name(lens.header.frame_id) == frame]
        return same[0] if frame and same else None


def survey_bag(bag: Bag, requested: Sequence[str] = ()) -> Survey:
    """Survey the start of a bag, or all of it if its index is missing.

    Parameters
    ----------
    requested
        Topics or namespaces named by the user: they select one of several robots.

    Raises
    ------
    DatasetError
        A file cannot be read at all.
    """
    survey = Survey()
    announced = bag.announced()
    for channel in announced or []:
        survey.channels.setdefault(channel.topic, channel)
    survey.robots = Robots.of({topic: info.kind for topic, info in survey.channels.items()}, requested)
    budget = bag.budget()
    decoder = Decoder(budget, Ousters(bag.path))
    quiet = Account.quiet(bag.path)
    first_s: float | None = None
    looking = True
    for record in bag.records(quiet, budget):
        first_s = record.recorded_s if first_s is None else first_s
        survey.channels.setdefault(record.channel.topic, record.channel)
        seconds = record.recorded_s - first_s
        if looking:
            if METADATA.search(record.channel.topic) and record.channel.kind == STRING:
                _learn(decoder, record)
            _look(survey, record, decoder)
            looking = seconds < LOOK_S and not survey.is_enough(seconds)
        elif announced is not None:
            break
    survey.ousters = decoder.ousters.models
    for model in survey.ousters.values():
        sensor, *_ = FRAMES
        for frame, pose in model.mountings().items():
            if frame not in survey.tree:
                survey.tree.add_frame(sensor, frame, pose)
    return survey


def _learn(decoder: Decoder, record: BagRecord) -> None:
    """Read the metadata of an Ouster; skip it if it cannot be decoded."""
    try:
        decoder.ousters.learn(record.channel.topic, str(decoder.decode(record).data))
    except (RecordFault, AttributeError):
        return


def clock_shifts(survey: Survey) -> dict[str, float]:
    """How far the stamps of topics are ahead of the others' clock: of their own clock, or of last points.

    The common clock is the one that is nearest to the recorder's. If a revolution arrives before its last
    point was measured, its stamp is of that point; record times made of the stamps (converted) show nothing.
    """
    stamped = {topic: late_s for topic, late_s in survey.late_s.items() if late_s is not None}
    reference_s, shifts = min(stamped.values(), key=abs, default=0.0), dict[str, float]()
    ends_s = {topic: view.ends_s for topic, view in survey.clouds.items() if not survey.in_pieces.get(topic)}
    for topic, scan in survey.scans.items():
        ends_s[topic] = abs(scan.time_increment) * (len(scan.ranges) - 1) / times_unit(survey, topic)
    for topic, late_s in stamped.items():
        end_s = ends_s.get(topic, 0.0)
        clock_s = min([0.0, *(one for other, one in stamped.items() if other != topic)])
        if abs(late_s - reference_s) > OTHER_CLOCK_S:
            shifts[topic] = reference_s - late_s + end_s
        elif topic in survey.uneven and abs(late_s - clock_s) < 0.5 * end_s:
            shifts[topic] = end_s
    return shifts


def times_unit(survey: Survey, scan: str) -> float:
    """Factor by which the stated times of a scan's beams exceed a revolution; 1 unless it is a unit."""
    step_s, message = np.diff(sorted(survey.scan_stamps_s[scan])), survey.scans[scan]
    turn_s = math.tau * abs(message.time_increment / (message.angle_increment or math.inf))
    turns = turn_s / float(np.median(step_s)) if step_s.size else 0.0
    unit = 10.0 ** (3 * round(math.log10(turns) / 3)) if 0.0 < turns < math.inf else 1.0
    return unit if 4.0 * abs(turns / unit - 1.0) < 1.0 else 1.0


def _look(survey: Survey, record: BagRecord, decoder: Decoder) -> None:
    """Process one message; damaged ones are ignored here and counted when the bag is read."""
    kind, topic = record.channel.kind, record.channel.topic
    if kind in SENSORS:
        survey.seen.add(topic)
    useful = kind in SENSORS | TRANSFORMS or kind == CAMERA_INFO or survey.facts.describes_camera(topic, kind)
    known: Container[str] = survey.in_pieces if kind in CLOUDS else survey.frames
    is_done = (topic in known and kind not in IMAGES | SCANS) or topic in survey.lenses
    if not useful or is_done or survey.robots.of_another(topic):
        return
    try:
        message = decoder.decode(record)
        if message is None:
            return
        if kind in TRANSFORMS:
            survey.tree.add(message)
        elif survey.facts.describes_camera(topic, kind):
            survey.facts.add(topic, kind, message)
        elif kind == CAMERA_INFO:
            survey.lenses[topic] = message
        else:
            _look_at_reading(survey, record, message)
    except (RecordFault, AttributeError, TypeError, ValueError, RuntimeError):
        return


def _look_at_reading(survey: Survey, record: BagRecord, message: Any) -> None:
    """Process a message of a sensor."""
    topic, kind = record.channel.topic, record.channel.kind
    survey.frames[topic] = frame_name(message.header.frame_id)
    unset = message.header.stamp.sec == 0 and message.header.stamp.nanosec == 0
    least_s = survey.late_s.setdefault(topic, None if unset else math.inf)
    if least_s is None:
        message.header.stamp = header_at(record.recorded_s, "").stamp
    else:
        late_s = record.recorded_s - stamp_of(message.header)
        survey.late_s[topic] = min(least_s, late_s)
        survey.uneven |= {topic} if _SAME_S < abs(late_s - least_s) < math.inf else set()
    if kind in CLOUDS:
        view = cloud_view(message)
        if topic in survey.clouds:
            survey.in_pieces[topic] = survey.clouds[topic].turns_to(view)
        survey.clouds.setdefault(topic, view)
    elif kind in SCANS:
        survey.scan_stamps_s.setdefault(topic, set()).add(stamp_of(message.header))
        survey.scans[topic] = message
    elif kind == IMU:
        survey.imus[topic] = quantities_in(message)
    elif kind == ODOMETRY:
        survey.odometry[topic] = survey.frames[topic], frame_name(message.child_frame_id)
    elif kind in IMAGES:
        survey.depths.setdefault(topic, is_depth(message, topic))
        if hasattr(message, "encoding"):
            survey.sizes.setdefault(topic, (int(message.width), int(message.height)))
        stamps = survey.stamps_s.setdefault(topic, [])
        if len(stamps) < _STAMPS_KEPT:
            stamps.append(stamp_of(message.header))
