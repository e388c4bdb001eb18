"""How a bag is read: its topics, and the pose and the intrinsics of each sensor."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.by_files import FileFacts
from slam.datasets.bags.camera import APART_M, BagCamera
from slam.datasets.bags.clouds import CloudReader, TurnReader
from slam.datasets.bags.evidence import evidence_of, never_read
from slam.datasets.bags.files import Bag
from slam.datasets.bags.gnss import gnss_reader
from slam.datasets.bags.imu import NO_VALUES, ImuReader, JoinedImu, paired_halves
from slam.datasets.bags.laser import ANGLE_TOLERANCE_RAD, LaserMount, scan_from
from slam.datasets.bags.lens import Lens, lens_of
from slam.datasets.bags.ouster_model import OusterModel
from slam.datasets.bags.survey import OTHER_CLOCK_S, Survey, clock_shifts, times_unit
from slam.datasets.bags.topics import (
    CAMERA_INFO,
    SENSORS,
    TRANSFORMS,
    CameraTopics,
    Choice,
    advice,
    choose,
    is_rectified,
    is_registered,
)
from slam.datasets.bags.truth import IS_TRUTH, TRUTHS, is_truth
from slam.datasets.bags.wheels import wheel_reader, wheels_from_tf
from slam.datasets.calibration_files import KnownCalibration
from slam.datasets.dataset import WARNING, RecordFault
from slam.datasets.frame_pairs import tolerance_of
from slam.datasets.laser_geometry import RepeatedRange
from slam.errors import DatasetError
from slam.measurements import Measurement, WheelOdometry


@dataclass(slots=True)
class Layout:
    """How the messages of a bag become measurements.

    Attributes
    ----------
    base
        The robot's frame, None if the bag has no tf.
    files
        What calibration files contain about the sensors.
    readers
        For each topic, the function that converts a message to one or more readings.
    joined
        For each topic with only a part of a sensor (accelerations, images, lenses), the sensor.
    images
        For each image topic, the index of its camera in ``cameras``, and whether it is depth.
    wheels_from
        Reads wheel odometry from a tf message, if there is no odometry topic.
    shifts_s
        How far the stamps of topics are ahead of the common clock; infinite if they have no stamps.
    lenses
        Topics that contain a lens, a depth unit, or the pose of the colour camera in the depth camera.
    left_out
        Why a sensor topic is not read.
    """

    base: str | None
    files: FileFacts
    readers: dict[str, Callable[[Any], Measurement | list[Measurement]]] = field(default_factory=dict)
    joined: dict[str, str] = field(default_factory=dict)
    clouds: list[CloudReader] = field(default_factory=list)
    imus: list[ImuReader | JoinedImu] = field(default_factory=list)
    cameras: list[BagCamera] = field(default_factory=list)
    images: dict[str, tuple[int, bool]] = field(default_factory=dict)
    wheels_from: Callable[[Any], Iterator[WheelOdometry]] | None = None
    notes: list[str] = field(default_factory=list)
    shifts_s: dict[str, float] = field(default_factory=dict)
    lenses: set[str] = field(default_factory=set)
    left_out: dict[str, str] = field(default_factory=dict)
    ousters: dict[str, OusterModel] = field(default_factory=dict)

    def reads(self, topic: str, kind: str) -> bool:
        """Whether messages of a topic are decoded."""
        known = topic in self.readers or topic in self.images
        return known or (kind in TRANSFORMS and topic not in self.left_out)

    def makes(self, topic: str, kind: str) -> str:
        """Name of a topic's measurements in the report; empty if there are none."""
        if topic in self.images:
            return frames_of(self.cameras[self.images[topic][0]].sensor)
        own = self.joined.get(topic, topic)
        return f"{own} ({kind.rpartition('/')[2]})" if topic in self.readers else ""

    def why_not(self, topic: str, kind: str, count: int) -> str:
        """Why a topic's messages are not used; empty if they are."""
        if self.reads(topic, kind) or topic in self.lenses:
            return "" if count else "it has no message"
        if kind == CAMERA_INFO:
            return "no camera that is read has this lens"
        if topic in self.left_out:
            return self.left_out[topic]
        if kind not in SENSORS:
            return f"{kind or 'a type without a name'} is not read{advice(kind)}"
        return f"its first message comes late; --topics {topic} reads it" if count else "it has no message"


def frames_of(camera: str) -> str:
    """Name of a camera's frames in the report."""
    return f"{camera} frame"


def layout_of(bag: Bag, survey: Survey, requested: tuple[str, ...], known: KnownCalibration) -> Layout:
    """How to read a bag.

    Parameters
    ----------
    known
        Intrinsics and mountings from files next to the bag and from files that the user gave.

    Raises
    ------
    DatasetError
        A topic is not in the bag, or there are several of one type and the user named none.
    """
    files = FileFacts(known)
    files.place(survey)
    choice = _choice(bag, survey, requested)
    layout = Layout(survey.base_frame(choice.odometry), files, ousters=survey.ousters)
    layout.lenses |= {f"{space}/metadata" for space in survey.ousters}
    layout.left_out = choice.left_out
    for topic, channel in survey.channels.items():
        if channel.kind in TRANSFORMS and survey.robots.of_another(topic):
            layout.left_out[topic] = f"it is of another robot than {survey.robots.read}"
    for topic, channel in survey.channels.items():
        if channel.kind not in SENSORS and (is_truth(topic, channel.kind) or topic in requested):
            layout.left_out[topic] = IS_TRUTH
    for topic in choice.scans:
        layout.readers[topic] = _scan_reader(survey, layout, topic)
    for topic in choice.clouds:
        layout.readers[topic] = _cloud_reader(survey, layout, topic, only=len(choice.clouds) == 1)
    for topic in choice.odometry:
        layout.readers[topic] = wheel_reader(survey, layout.base or "", topic, layout.notes)
    _read_imus(survey, layout, choice.imus)
    layout.readers |= {topic: gnss_reader(topic, _mount(survey, layout, topic)) for topic in choice.receivers}
    for place, camera in enumerate(choice.cameras):
        layout.cameras.append(_camera(survey, layout, camera, only=len(choice.cameras) == 1))
        layout.images[camera.color], layout.images[camera.depth] = (place, False), (place, True)
        layout.joined |= {camera.color: camera.name, camera.depth: camera.name}
    layout.lenses |= survey.facts.fact_topics if layout.cameras else set()
    for topic in choice.lonely:
        layout.left_out[topic] = f"no {'colour' if survey.depths.get(topic) else 'depth'} beside it"
        if {"depth", "aligned_depth_to_color"} & {*topic.split("/")} and not survey.depths.get(topic, True):
            layout.left_out[topic] = "its images are pictures of depth; record it as 16UC1 or 32FC1"
        layout.notes.append(f"{topic} is not read: {layout.left_out[topic]}")
    if not choice.odometry and layout.base:
        layout.wheels_from = wheels_from_tf(survey, layout.base, layout.notes)
    _read_clocks(survey, layout)
    layout.notes += [*files.notes, *files.unused()]
    return layout


def _read_clocks(survey: Survey, layout: Layout) -> None:
    """Find topics without stamps, and topics with a clock of their own."""
    for topic in sorted({*layout.readers, *layout.images}):
        if topic in survey.late_s and survey.late_s[topic] is None:
            layout.shifts_s[topic] = math.inf
            layout.notes.append(f"{WARNING}{topic} has no stamps; the recorder's clock is used")
    for topic, shift_s in clock_shifts(survey).items():
        if topic in layout.readers or topic in layout.images:
            layout.shifts_s[topic] = shift_s
            ahead = f"{abs(shift_s):.1f} s {'ahead of' if shift_s > 0 else 'behind'} the other topics'"
            text = f"its clock is {ahead}; corrected by its first arrival"
            if abs(shift_s) < OTHER_CLOCK_S:
                text = f"it arrives before its last point, so it is stamped there; {shift_s:.3f} s taken off"
            layout.notes.append(f"{WARNING}{topic}: {text}")


def _choice(bag: Bag, survey: Survey, requested: tuple[str, ...]) -> Choice:
    """Choose the topics; the error lists those among which it cannot choose."""
    requested = tuple(
        topic for topic in requested if topic.rstrip("/") != survey.robots.read or not topic.strip("/")
    )
    if unknown := [topic for topic in requested if topic not in survey.channels]:
        raise DatasetError(f"{bag.path} has no topic {unknown[0]}; it holds {_listing(bag, survey)}")
    kinds = {topic: survey.channels[topic].kind for topic in sorted(survey.seen)}
    for topic in requested:
        kind = survey.channels[topic].kind
        if kind in TRUTHS - SENSORS:
            continue
        if kind not in SENSORS:
            raise DatasetError(
                f"{topic} of {bag.path} holds {kind}, which is not read; it holds {_listing(bag, survey)}"
            )
        kinds[topic] = kind
    # If no image could be decoded, its name must decide.
    depths = {topic: survey.depths.get(topic, "depth" in topic.lower()) for topic in kinds}
    return choose(kinds, depths, requested, never_read(survey), evidence_of(survey))


def _listing(bag: Bag, survey: Survey) -> str:
    """Sensor topics with types and numbers of messages."""
    records = bag.records(Account.quiet(bag.path), bag.budget())
    counts = Counter(record.channel.topic for record in records)
    topics = [
        f"{topic} ({channel.kind.rpartition('/')[2]}, {counts[topic]} messages)"
        for topic, channel in sorted(survey.channels.items())
        if channel.kind in SENSORS
    ]
    return ", ".join(topics) or "no topic of a sensor"


def _mount(
    survey: Survey, layout: Layout, topic: str, kind: str = "", *, only: bool = False
) -> gtsam.Pose3 | None:
    """``T_base_sensor`` of a type's only sensor by `calibration.yaml`, else by tf; a note if unknown."""
    notes = len(layout.notes)
    own = _mount_by_tf(survey, layout, topic)
    mount = layout.files.mount(kind, topic, own, only=only) if kind else own
    if own is None and mount is not None:
        del layout.notes[notes:]
    return mount


def _mount_by_tf(survey: Survey, layout: Layout, topic: str) -> gtsam.Pose3 | None:
    """``T_base_sensor`` by tf, with a note if tf does not contain it."""
    frame = survey.frames.get(topic, "")
    if not layout.base:
        layout.notes.append(
            f"{topic}: no tf in the bag; its mounting is unknown, unless given by --calibration"
        )
        return None
    pose = survey.tree.between(layout.base, frame) if frame != layout.base else gtsam.Pose3()
    if pose is None:
        layout.notes.append(f"{topic}: tf does not connect {frame or 'its frame'} with {layout.base}")
    elif survey.tree.moves_between(layout.base, frame):
        layout.notes.append(f"{topic}: {frame} moves on the robot; its first pose is used")
    return pose


def _mount_of_lidar(
    survey: Survey, layout: Layout, topic: str, kind: str = "", *, only: bool = False
) -> gtsam.Pose3 | None:
    """Like `_mount`, with a warning if the robot has tf and the lidar is not in it."""
    mount = _mount(survey, layout, topic, kind, only=only)
    if mount is None and any(channel.kind in TRANSFORMS for channel in survey.channels.values()):
        text = f"{topic}: tf has no mounting for it; assumed at {layout.base or 'the robot'}"
        layout.notes.append(f"{WARNING}{text}, unless --calibration gives it (a URDF, a yaml of tf)")
    return mount


def _scan_reader(survey: Survey, layout: Layout, topic: str) -> Callable[[Any], Measurement]:
    """A function that reads scans of a topic."""
    pose = _mount_of_lidar(survey, layout, topic)
    mount = LaserMount(gtsam.Pose2())
    if pose is not None:
        try:
            mount = LaserMount.of(pose)
        except RecordFault as fault:
            raise DatasetError(f"{topic}: {fault}; name other topics with --topics") from fault
    if mount.tilt_rad > ANGLE_TOLERANCE_RAD:
        long = 1.0 / math.cos(mount.tilt_rad) - 1.0
        text = (
            f"{topic}: by tf the laser is tilted by {math.degrees(mount.tilt_rad):.0f} degrees; it is taken"
        )
        layout.notes.append(f"{WARNING}{text} as level: ranges are up to {long:.0%} too long")
    if mount.inverted:
        layout.notes.append(f"{topic}: the laser is mounted upside down; its beams are reversed")
    repeated, unit = RepeatedRange(), times_unit(survey, topic) if topic in survey.scans else 1.0
    if unit != 1.0:
        text = f"{topic}: by time_increment, a revolution takes {unit:g} times as long as from scan to scan"
        layout.notes.append(f"{WARNING}{text}; divided by it")
    return lambda message: scan_from(message, mount, topic, repeated, unit)


def _cloud_reader(
    survey: Survey, layout: Layout, topic: str, *, only: bool
) -> Callable[[Any], Measurement | list[Measurement]]:
    """A function that reads clouds of a topic."""
    reader = CloudReader(topic, _mount_of_lidar(survey, layout, topic, "lidar", only=only) or gtsam.Pose3())
    layout.clouds.append(reader)
    if survey.in_pieces.get(topic):
        layout.notes.append(f"{topic}: its messages are parts of a revolution; joined")
        return TurnReader(reader).read
    return reader.read


def _read_imus(survey: Survey, layout: Layout, topics: tuple[str, ...]) -> None:
    """Add the readers of IMUs; an IMU on two topics gets one."""
    pairs = paired_halves(topics, survey.imus)
    for topic in topics:
        if topic in pairs.values():
            continue
        if forces := pairs.get(topic):
            joined = JoinedImu(topic, forces, _mount(survey, layout, topic))
            layout.imus.append(joined)
            layout.readers |= {topic: joined.read_rates, forces: joined.read_forces}
            layout.joined[forces] = topic
        elif topic in pairs and not survey.imus[topic][0]:
            layout.left_out[topic] = NO_VALUES
        else:
            reader = ImuReader(topic, _mount(survey, layout, topic), gyro_alone=topic in pairs)
            layout.imus.append(reader)
            layout.readers[topic] = reader.read


def _camera(survey: Survey, layout: Layout, topics: CameraTopics, *, only: bool) -> BagCamera:
    """A camera with its lenses and its pose on the robot."""
    T_depth_color = _color_in_depth(survey, layout, topics)
    stamps = [survey.stamps_s.get(topic, []) for topic in (topics.color, topics.depth)]
    camera = BagCamera(
        topics.name,
        layout.files.lens(survey, topics.depth, _lens(survey, layout, topics.depth, topics.name)),
        layout.files.lens(survey, topics.color, _lens(survey, layout, topics.color, topics.name)),
        T_depth_color,
        _mount(survey, layout, topics.depth, "camera", only=only),
        tolerance_of(*(np.array(of_one, dtype=np.float64) for of_one in stamps)),
    )
    if unit_m := survey.facts.unit_m(topics.depth):
        layout.notes.append(f"{topics.name}: the depth unit is {unit_m:g} m, by its option in the bag")
    steps = layout.files.depth_steps_per_m(topics.name, 1.0 / unit_m if unit_m else None)
    camera.depth_steps_per_m = steps or camera.depth_steps_per_m
    if camera.assumed:
        layout.notes.append(f"{WARNING}{topics.name}: {camera.assumed}")
    return camera


def _color_in_depth(survey: Survey, layout: Layout, topics: CameraTopics) -> gtsam.Pose3:
    """Pose of the colour camera in the depth camera: by the driver's own messages, else by tf."""
    by_driver = survey.facts.color_in_depth(topics.color, topics.depth)
    frames = survey.frames.get(topics.depth, ""), survey.frames.get(topics.color, "")
    if is_registered(topics.depth) or (frames[0] == frames[1] and not survey.facts.streams):
        return gtsam.Pose3()  # one camera, or depth registered to colour by the driver
    known = [(by_driver[0], by_driver[1])] if by_driver else []
    if frames[0] != frames[1] and (between := survey.tree.between(*frames)) is not None:
        known.append((between, "tf"))
    if not known:
        layout.notes.append(f"{topics.name}: no pose of colour relative to depth; assumed identical")
        return gtsam.Pose3()
    pose, source = known[0]
    values = [np.asarray(pose_known.translation()) for pose_known, _ in known]
    if float(np.abs(values[0] - values[-1]).max()) > APART_M:
        layout.notes.append(
            f"{WARNING}{topics.name}: colour relative to depth at {_xyz(values[0])} m by {source}, at "
            f"{_xyz(values[-1])} m by {known[-1][1]}; that of {source} is used"
        )
    if (apart_m := float(np.linalg.norm(values[0]))) > APART_M:
        layout.notes.append(
            f"{topics.name}: colour is {apart_m:.3f} m from depth by {source}; drawn in the depth image"
        )
    return pose


def _xyz(translation: Any) -> str:
    """Three numbers as text for the user."""
    return " ".join(f"{number:.3f}" for number in translation)


def _lens(survey: Survey, layout: Layout, topic: str, camera: str) -> Lens | None:
    """The lens of an image topic of a camera, None if it has no usable CameraInfo."""
    source = survey.lens_topic(topic)
    if source is None:
        return None
    message = survey.lenses[source]
    try:
        lens = lens_of(message, rectified=is_rectified(topic))
    except (RecordFault, AttributeError, TypeError, ValueError) as error:
        layout.notes.append(f"{topic}: {error}")
        return None
    layout.lenses.add(source)
    layout.joined.setdefault(source, camera)
    if lens.unknown_model:
        text = f"distortion model {lens.unknown_model[:32]} is unknown; it is left in the images"
        layout.notes.append(f"{WARNING}{topic}: {text}")
    elif lens.distortion.size:
        layout.notes.append(f"{topic}: distortion taken out of the images")
    return lens
