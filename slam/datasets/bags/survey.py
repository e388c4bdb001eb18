"""The beginning of a bag: what its topics hold, where the sensors sit, which lenses they have."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from typing import Any

from slam.datasets.account import Account
from slam.datasets.bags.cloud_messages import header_at
from slam.datasets.bags.clouds import CloudView, cloud_view
from slam.datasets.bags.decoding import Decoder, frame_name, stamp_of
from slam.datasets.bags.files import Bag
from slam.datasets.bags.images import is_depth
from slam.datasets.bags.imu import told_by
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
_LEAST_S = 2.0  # of the bag's time, for stamps of images and for transforms that come once a second
_STAMPS_KEPT = 200
_OTHER_CLOCK_S = 5.0  # not every message waits so long for its recorder; the doctor looks for less


@dataclass(slots=True)
class Survey:
    """What the beginning of a bag tells.

    Attributes
    ----------
    channels
        All topics, by name; announced by the index, or seen where there is none.
    seen
        Sensor topics that have had a message, also if it is damaged.
    frames
        Frame of each sensor topic that has had a sound message.
    odometry
        Of each odometry topic its frame, and the child frame that it says to be moving.
    lenses
        First usable CameraInfo message of each topic.
    depths
        For each image topic whether it holds depth.
    stamps_s
        First stamps of each image topic.
    late_s
        Of each sensor's topic the record time less the stamp of its first message; None where that has none.
    clouds, in_pieces
        What the first sound cloud of each topic looks like; and whether the next looks elsewhere.
    scans
        Of each topic of scans the angle that it sees, and its range.
    scan_stamps_s
        First stamps of each topic of scans.
    imus
        Of each topic of an IMU whether its first message tells turn rates, and whether accelerations.
    sizes
        Width and height of the images of each topic that tells them before they are decoded.
    facts
        What drivers tell of their cameras in messages of their own.
    ousters
        What lidars whose packets are in the bag tell of themselves, by the namespace of their topics.
    robots
        Of several robots in the bag the one that is read.
    """

    channels: dict[str, Channel] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)
    frames: dict[str, str] = field(default_factory=dict)
    odometry: dict[str, tuple[str, str]] = field(default_factory=dict)
    lenses: dict[str, Any] = field(default_factory=dict)
    depths: dict[str, bool] = field(default_factory=dict)
    stamps_s: dict[str, list[float]] = field(default_factory=dict)
    late_s: dict[str, float | None] = field(default_factory=dict)
    clouds: dict[str, CloudView] = field(default_factory=dict)
    in_pieces: dict[str, bool] = field(default_factory=dict)
    scans: dict[str, tuple[float, float]] = field(default_factory=dict)
    scan_stamps_s: dict[str, set[float]] = field(default_factory=dict)
    imus: dict[str, tuple[bool, bool]] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    facts: CameraFacts = field(default_factory=CameraFacts)
    ousters: dict[str, OusterModel] = field(default_factory=dict)
    robots: Robots = field(default_factory=Robots)
    tree: FrameTree = field(default_factory=FrameTree)

    def base_frame(self, wheels: Sequence[str] = ()) -> str | None:
        """The robot's frame: what the wheels move, else by its usual names, else the root of all.

        Parameters
        ----------
        wheels
            The odometry topics that are read; all where there are none.
        """
        children = [self.odometry[topic][1] for topic in wheels or self.odometry if topic in self.odometry]
        named = self.tree.named(BASE_FRAMES)
        for child in children:
            if child in self.tree:
                # Odometry of a camera moves the camera, which sits on the robot.
                above = [frame for frame in named if self.tree.sits_on(child, frame)]
                return child if child in named or not above else above[0]
        if named:
            return named[0]
        return self.tree.root()

    def is_enough(self, seconds: float) -> bool:
        """Whether all that the choice depends on is known."""
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
        """The CameraInfo topic of an image topic: beside it, else the first of its frame."""
        for topic in camera_info_topics(image_topic):
            if topic in self.lenses:
                return topic
        frame = self.frames.get(image_topic)
        same = [topic for topic, lens in self.lenses.items() if frame_name(lens.header.frame_id) == frame]
        return same[0] if frame and same else None


def survey_bag(bag: Bag, wanted: Sequence[str] = ()) -> Survey:
    """Look at the beginning of a bag, at all of it where its index is missing.

    Parameters
    ----------
    wanted
        Topics or namespaces named by the user: of several robots they tell which.

    Raises
    ------
    DatasetError
        A file cannot be read at all.
    """
    survey = Survey()
    announced = bag.announced()
    for channel in announced or []:
        survey.channels.setdefault(channel.topic, channel)
    survey.robots = Robots.of({topic: one.kind for topic, one in survey.channels.items()}, wanted)
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
                survey.tree.sits(sensor, frame, pose)
    return survey


def _learn(decoder: Decoder, record: BagRecord) -> None:
    """Take in what an Ouster tells of itself; what cannot be decoded tells nothing."""
    try:
        decoder.ousters.learn(record.channel.topic, str(decoder.decode(record).data))
    except (RecordFault, AttributeError):
        return


def clock_shifts(survey: Survey) -> dict[str, float]:
    """By how much stamps of topics are ahead of the others' clock, where that is another one altogether.

    The clock of the topics is the one that is nearest to the recorder's.
    """
    told = {topic: late_s for topic, late_s in survey.late_s.items() if late_s is not None}
    reference_s = min(told.values(), key=abs, default=0.0)
    return {
        topic: reference_s - late_s
        for topic, late_s in told.items()
        if abs(late_s - reference_s) > _OTHER_CLOCK_S
    }


def restamp(message: Any, stamp_s: float) -> None:
    """Give a message another stamp."""
    message.header.stamp = header_at(stamp_s, "").stamp


def count_messages(bag: Bag) -> Counter[str]:
    """Messages on each topic, by reading all of the bag."""
    quiet = Account.quiet(bag.path)
    return Counter(record.channel.topic for record in bag.records(quiet, bag.budget()))


def _look(survey: Survey, record: BagRecord, decoder: Decoder) -> None:
    """Take in one message; damaged ones tell nothing here and are counted when the bag is read."""
    kind, topic = record.channel.kind, record.channel.topic
    if kind in SENSORS:
        survey.seen.add(topic)
    wanted = kind in SENSORS | TRANSFORMS or kind == CAMERA_INFO or survey.facts.tells(topic, kind)
    known: Container[str] = survey.in_pieces if kind in CLOUDS else survey.frames
    seen = (topic in known and kind not in IMAGES | SCANS) or topic in survey.lenses
    if not wanted or seen or survey.robots.of_another(topic):
        return
    try:
        message = decoder.decode(record)
        if message is None:
            return
        if kind in TRANSFORMS:
            survey.tree.add(message)
        elif survey.facts.tells(topic, kind):
            survey.facts.add(topic, kind, message)
        elif kind == CAMERA_INFO:
            survey.lenses[topic] = message
        else:
            _look_at_reading(survey, record, message)
    except (RecordFault, AttributeError, TypeError, ValueError, RuntimeError):
        return


def _look_at_reading(survey: Survey, record: BagRecord, message: Any) -> None:
    """Take in a message of a sensor."""
    topic, kind = record.channel.topic, record.channel.kind
    survey.frames[topic] = frame_name(message.header.frame_id)
    unset = message.header.stamp.sec == 0 and message.header.stamp.nanosec == 0
    least_s = survey.late_s.setdefault(topic, None if unset else math.inf)
    if least_s is None:
        restamp(message, record.recorded_s)
    else:
        survey.late_s[topic] = min(least_s, record.recorded_s - stamp_of(message.header))
    if kind in CLOUDS:
        looks = cloud_view(message)
        if topic in survey.clouds:
            survey.in_pieces[topic] = survey.clouds[topic].turns_to(looks)
        survey.clouds.setdefault(topic, looks)
    elif kind in SCANS:
        survey.scan_stamps_s.setdefault(topic, set()).add(stamp_of(message.header))
        span_rad = float(abs(message.angle_max - message.angle_min))
        view = span_rad, float(message.range_max)
        survey.scans[topic] = view if all(map(math.isfinite, view)) else (0.0, 0.0)
    elif kind == IMU:
        survey.imus[topic] = told_by(message)
    elif kind == ODOMETRY:
        survey.odometry[topic] = survey.frames[topic], frame_name(message.child_frame_id)
    elif kind in IMAGES:
        survey.depths.setdefault(topic, is_depth(message, topic))
        if hasattr(message, "encoding"):
            survey.sizes.setdefault(topic, (int(message.width), int(message.height)))
        stamps = survey.stamps_s.setdefault(topic, [])
        if len(stamps) < _STAMPS_KEPT:
            stamps.append(stamp_of(message.header))
