"""How a bag is read: its topics, and where and through which lens each sensor looks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from slam.datasets.bags.camera import BagCamera
from slam.datasets.bags.camera_clouds import camera_clouds
from slam.datasets.bags.clouds import CloudReader
from slam.datasets.bags.decoding import frame_name, stamp_of
from slam.datasets.bags.files import Bag
from slam.datasets.bags.imu import ImuReader
from slam.datasets.bags.laser import LaserMount, scan_from
from slam.datasets.bags.lens import Lens, lens_of
from slam.datasets.bags.survey import Survey, count_messages
from slam.datasets.bags.topics import (
    CAMERA_INFO,
    SENSORS,
    TRANSFORMS,
    AmbiguousError,
    CameraTopics,
    Choice,
    choose,
    is_rectified,
)
from slam.datasets.bags.transforms import pose_of
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import tolerance_of
from slam.errors import DatasetError
from slam.measurements import Measurement, WheelOdometry

_ODOM_FRAMES = ("odom", "odom_combined")
_APART_M = 0.001  # colour and depth that are nearer than that are one camera


@dataclass(slots=True)
class Layout:
    """How the messages of a bag become measurements.

    Attributes
    ----------
    base
        The robot's frame, None where the bag has no tf.
    readers
        By topic, what makes a reading of a message.
    images
        For each image topic the place of its camera in ``cameras``, and whether it holds depth.
    wheels_from
        Gives the wheels from a tf message, where no odometry topic does.
    notes
        What was concluded, for the report.
    lenses
        CameraInfo topics that told a lens.
    left_out
        Why a topic of a sensor is not read.
    """

    base: str | None
    readers: dict[str, Callable[[Any], Measurement]] = field(default_factory=dict)
    clouds: list[CloudReader] = field(default_factory=list)
    imus: list[ImuReader] = field(default_factory=list)
    cameras: list[BagCamera] = field(default_factory=list)
    images: dict[str, tuple[int, bool]] = field(default_factory=dict)
    wheels_from: Callable[[Any], Iterator[WheelOdometry]] | None = None
    notes: list[str] = field(default_factory=list)
    lenses: set[str] = field(default_factory=set)
    left_out: dict[str, str] = field(default_factory=dict)

    def reads(self, topic: str, kind: str) -> bool:
        """Whether messages of a topic are decoded."""
        return topic in self.readers or topic in self.images or kind in TRANSFORMS

    def makes(self, topic: str, kind: str) -> str:
        """What the report calls the measurements of a topic; empty where they are none."""
        if topic in self.images:
            return frames_of(self.cameras[self.images[topic][0]].sensor)
        return f"{topic} ({kind.rpartition('/')[2]})" if topic in self.readers else ""

    def why_not(self, topic: str, kind: str, count: int) -> str:
        """Why nothing is made of a topic's messages; empty where something is."""
        if self.reads(topic, kind) or topic in self.lenses:
            return "" if count else "it has no message"
        if kind == CAMERA_INFO:
            return "no camera that is read has this lens"
        if topic in self.left_out:
            return self.left_out[topic]
        if kind not in SENSORS:
            return f"{kind} is not read"
        return f"its first message comes late; --topics {topic} reads it" if count else "it has no message"


def frames_of(camera: str) -> str:
    """What the report calls the frames of a camera."""
    return f"{camera} frame"


def layout_of(bag: Bag, survey: Survey, wanted: tuple[str, ...]) -> Layout:
    """How to read a bag.

    Raises
    ------
    DatasetError
        A topic that the bag does not have, or several of a sort and none named.
    """
    choice = _choice(bag, survey, wanted)
    layout = Layout(survey.base_frame())
    layout.left_out = choice.left_out
    for topic in choice.scans:
        layout.readers[topic] = _scan_reader(survey, layout, topic)
    for topic in choice.clouds:
        layout.readers[topic] = _cloud_reader(survey, layout, topic)
    for topic in choice.odometry:
        layout.readers[topic] = lambda message, topic=topic: _wheels(message, topic)  # type: ignore[misc]
    for topic in choice.imus:
        reader = ImuReader(topic, _mount(survey, layout, topic))
        layout.imus.append(reader)
        layout.readers[topic] = reader.read
    for place, camera in enumerate(choice.cameras):
        layout.cameras.append(_camera(survey, layout, camera))
        layout.images[camera.color], layout.images[camera.depth] = (place, False), (place, True)
    for topic in choice.lonely:
        layout.left_out[topic] = f"no {'colour' if survey.depths.get(topic) else 'depth'} beside it"
        layout.notes.append(f"{topic} is not read: {layout.left_out[topic]}")
    if not choice.odometry and layout.base:
        _read_wheels_from_tf(survey, layout, layout.base)
    return layout


def _choice(bag: Bag, survey: Survey, wanted: tuple[str, ...]) -> Choice:
    """Which topics; what cannot be chosen is listed with its messages."""
    if unknown := [topic for topic in wanted if topic not in survey.channels]:
        raise DatasetError(f"{bag.path} has no topic {unknown[0]}; it holds {_listing(bag, survey, SENSORS)}")
    kinds = {topic: survey.channels[topic].kind for topic in sorted(survey.seen)}
    for topic in wanted:
        kind = survey.channels[topic].kind
        if kind not in SENSORS:
            raise DatasetError(
                f"{topic} of {bag.path} holds {kind}, which is not read; "
                f"it holds {_listing(bag, survey, SENSORS)}"
            )
        kinds[topic] = kind
    try:
        # Where no image could be decoded, its name must tell.
        depths = {topic: survey.depths.get(topic, "depth" in topic.lower()) for topic in kinds}
        return choose(kinds, depths, wanted, camera_clouds(survey))
    except AmbiguousError as error:
        listing = _listing(bag, survey, SENSORS, set(error.topics))
        raise DatasetError(
            f"{bag.path} holds {len(error.topics)} {error.what} topics: {listing}; "
            f"choose by --topics, as in --topics {error.topics[0]} (several with commas)"
        ) from error


def _listing(bag: Bag, survey: Survey, kinds: frozenset[str], topics: set[str] | None = None) -> str:
    """Topics with their types and numbers of messages."""
    counts = count_messages(bag)
    found = [
        f"{topic} ({channel.kind.rpartition('/')[2]}, {counts[topic]} messages)"
        for topic, channel in sorted(survey.channels.items())
        if channel.kind in kinds and (topics is None or topic in topics)
    ]
    return ", ".join(found) or "no topic of a sensor"


def _mount(survey: Survey, layout: Layout, topic: str) -> gtsam.Pose3 | None:
    """``T_base_sensor`` by tf, with a note where it cannot be reported."""
    frame = survey.frames.get(topic, "")
    if not layout.base:
        layout.notes.append(f"{topic}: no tf in the bag; its mounting is not known")
        return None
    pose = survey.tree.between(layout.base, frame) if frame != layout.base else gtsam.Pose3()
    if pose is None:
        layout.notes.append(f"{topic}: tf does not connect {frame or 'its frame'} with {layout.base}")
    elif survey.tree.moves_between(layout.base, frame):
        layout.notes.append(f"{topic}: {frame} moves on the robot; it is taken to stay where it was first")
    return pose


def _scan_reader(survey: Survey, layout: Layout, topic: str) -> Callable[[Any], Measurement]:
    """What reads scans of a topic."""
    pose = _mount(survey, layout, topic)
    mount = LaserMount(gtsam.Pose2())
    if pose is not None:
        try:
            mount = LaserMount.of(pose)
        except RecordFault as fault:
            raise DatasetError(f"{topic}: {fault}; name other topics with --topics") from fault
    if mount.inverted:
        layout.notes.append(f"{topic}: the laser hangs upside down; its beams are turned round")
    return lambda message: scan_from(message, mount, topic)


def _cloud_reader(survey: Survey, layout: Layout, topic: str) -> Callable[[Any], Measurement]:
    """What reads clouds of a topic."""
    reader = CloudReader(topic, _mount(survey, layout, topic) or gtsam.Pose3())
    layout.clouds.append(reader)
    return reader.read


def _camera(survey: Survey, layout: Layout, topics: CameraTopics) -> BagCamera:
    """A camera with its lenses and its place on the robot."""
    depth_frame, color_frame = survey.frames.get(topics.depth, ""), survey.frames.get(topics.color, "")
    between = survey.tree.between(depth_frame, color_frame) if depth_frame != color_frame else gtsam.Pose3()
    turn = np.eye(3) if between is None else np.asarray(between.rotation().matrix())
    if between is not None and (apart_m := float(np.linalg.norm(between.translation()))) > _APART_M:
        layout.notes.append(f"{topics.name}: colour sits {apart_m:.3f} m beside depth")
    stamps = [survey.stamps_s.get(topic, []) for topic in (topics.color, topics.depth)]
    camera = BagCamera(
        topics.name,
        _lens(survey, layout, topics.depth),
        _lens(survey, layout, topics.color),
        turn,
        _mount(survey, layout, topics.depth),
        tolerance_of(*(np.array(of_one, dtype=np.float64) for of_one in stamps)),
    )
    if camera.assumed:
        layout.notes.append(f"{topics.name}: {camera.assumed}")
    return camera


def _lens(survey: Survey, layout: Layout, topic: str) -> Lens | None:
    """The lens of an image topic, None where no usable CameraInfo goes with it."""
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
    if lens.unknown_model:
        layout.notes.append(
            f"{topic}: distortion model {lens.unknown_model[:32]} is not known; left in the images"
        )
    elif lens.distortion.size:
        layout.notes.append(f"{topic}: distortion taken out of the images")
    return lens


def _wheels(message: Any, topic: str) -> WheelOdometry:
    """The wheels from an Odometry message, in the plane."""
    return WheelOdometry(
        stamp_of(message.header), _flat(message.pose.pose.position, message.pose.pose.orientation), topic
    )


def _read_wheels_from_tf(survey: Survey, layout: Layout, base: str) -> None:
    """Take the wheels from tf, where it has an odom frame."""
    child, parent = base, survey.tree.parent_of(base)
    while parent is not None and parent not in _ODOM_FRAMES:
        child, parent = parent, survey.tree.parent_of(parent)
    if parent is None:
        return
    T_child_base = survey.tree.between(child, base) or gtsam.Pose3()
    layout.notes.append(f"no odometry topic: wheels from tf, {parent} to {child}")

    def read(message: Any) -> Iterator[WheelOdometry]:
        for item in message.transforms:
            if frame_name(item.header.frame_id) == parent and frame_name(item.child_frame_id) == child:
                pose = pose_of(item.transform.translation, item.transform.rotation).compose(T_child_base)
                yield WheelOdometry(stamp_of(item.header), _planar(pose), "tf")

    layout.wheels_from = read


def _flat(position: Any, rotation: Any) -> gtsam.Pose2:
    """A pose in the plane."""
    return _planar(pose_of(position, rotation))


def _planar(pose: gtsam.Pose3) -> gtsam.Pose2:
    """x, y and the heading of the x axis."""
    axes = pose.rotation().matrix()
    return gtsam.Pose2(pose.x(), pose.y(), math.atan2(axes[1, 0], axes[0, 0]))
