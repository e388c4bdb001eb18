"""Chooses the topics of a bag to read: by type, then by name and contents."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

LASER_SCAN = "sensor_msgs/msg/LaserScan"
MULTI_ECHO = "sensor_msgs/msg/MultiEchoLaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
POINT_CLOUD = "sensor_msgs/msg/PointCloud"  # of the first years of ROS
LIVOX = frozenset(
    {f"livox_{package}/msg/CustomMsg" for package in ("ros_driver", "ros_driver2", "interfaces")}
)
VELODYNE = "velodyne_msgs/msg/VelodyneScan"
OUSTER = frozenset(f"ouster_{package}/msg/PacketMsg" for package in ("ros", "msgs", "sensor_msgs"))
STRING = "std_msgs/msg/String"  # of an Ouster's metadata
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
NAVSAT = "sensor_msgs/msg/NavSatFix"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
SCANS = frozenset({LASER_SCAN, MULTI_ECHO})
CLOUDS = LIVOX | OUSTER | {CLOUD, POINT_CLOUD, VELODYNE}
IMAGES = frozenset({IMAGE, COMPRESSED})
SENSORS = SCANS | CLOUDS | IMAGES | {ODOMETRY, IMU, NAVSAT}

_KIND_WORD = re.compile(r"rgb|colou?r|depth|image|infra|^ir$|mono|stereo|left|right|^sensor_", re.IGNORECASE)
_REGISTERED = re.compile(r"aligned_depth|depth_registered|depth_to_(rgb|color)|registered", re.IGNORECASE)
_INFRARED = re.compile(r"infra|(^|[/_])ir\d?([/_]|$)|thermal|flir|confidence|disparity", re.IGNORECASE)
METADATA = re.compile(r"/metadata$")
_TRANSPORT = re.compile(r"/(compressed|compressedDepth|theora|ffmpeg|zstd)$")


@dataclass(frozen=True, slots=True)
class CameraTopics:
    """Two image topics of one camera."""

    name: str
    color: str
    depth: str


@dataclass(frozen=True, slots=True)
class Choice:
    """The topics that are read.

    Attributes
    ----------
    scans, clouds, odometry
        Topics of one laser each, of one lidar each, and of the wheels.
    imus, receivers
        Topics of one IMU each, and of one GNSS receiver each; all are read, and the mapper uses one.
    lonely
        Image topics that are not read because the matching colour or depth topic is missing.
    left_out
        Why other sensor topics are not read.
    """

    scans: tuple[str, ...]
    clouds: tuple[str, ...]
    odometry: tuple[str, ...]
    cameras: tuple[CameraTopics, ...]
    lonely: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    imus: tuple[str, ...] = ()
    receivers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Evidence:
    """Criteria to choose between several topics of one type.

    Attributes
    ----------
    scan, cloud, odometry
        The rank of a topic; the lowest is the best.
    frame
        The frame of an image topic.
    apart
        Whether two laser scanners have different positions, both of them known.
    """

    scan: Callable[[str], tuple[Any, ...]] = lambda topic: (topic,)
    cloud: Callable[[str], tuple[Any, ...]] = lambda topic: (topic,)
    odometry: Callable[[str], tuple[Any, ...]] = lambda topic: (topic,)
    frame: Callable[[str], str] = lambda topic: ""
    apart: Callable[[str, str], bool] = lambda first, second: False


# Unsupported message types that would be useful, and how to convert each to a supported one.
_REPUBLISH = "record it again through 'ros2 run image_transport republish {} raw'"
_REMEDIES = (
    (r"^(rslidar_msg|hesai_ros_driver)/", "record it again through its driver, as PointCloud2"),
    (r"^theora_image_transport/", _REPUBLISH.format("theora")),
    (r"^ffmpeg_image_transport", _REPUBLISH.format("ffmpeg")),
    (r"CompressedVideo$", "unpack the video to sensor_msgs/Image"),
    (r"^foxglove\.|^foxglove_msgs/", "write it as the ROS type of the same name (sensor_msgs, tf2_msgs)"),
    (r"^stereo_msgs/msg/DisparityImage$", "record depth, which stereo_image_proc makes of it"),
)
NO_EVIDENCE = Evidence()

_WHY = {
    ODOMETRY: "wheel odometry is preferred to estimates, then the frame of the robot",
    **dict.fromkeys(SCANS, "of two at one place the wider field of view is preferred"),
    **dict.fromkeys(CLOUDS, "raw points are preferred to processed ones, then the wider view"),
}


def choose(
    kinds: Mapping[str, str],
    depths: Mapping[str, bool],
    requested: tuple[str, ...],
    never: Mapping[str, str] | None = None,
    evidence: Evidence = NO_EVIDENCE,
) -> Choice:
    """The topics to read.

    Parameters
    ----------
    kinds
        Message type of each topic that holds messages.
    depths
        For each image topic, whether it contains depth.
    requested
        Topics named by the user: no other topics of their type (scans, clouds, wheels, images) are read.
    never
        Topics that are read only if the user names them, with the reason.
    """
    never = {topic: why for topic, why in (never or {}).items() if topic not in requested}
    left_out = {topic: f"{why}; --topics {topic} reads it" for topic, why in never.items()}

    def of(*sort: str) -> list[str]:
        return [topic for topic, kind in kinds.items() if kind in sort and topic not in never]

    scans = _named(of(*SCANS), requested) or _lasers(of(*SCANS), evidence)
    clouds = _named(of(*CLOUDS), requested) or tuple(sorted(of(*CLOUDS), key=evidence.cloud)[:1])
    odometry = _named(of(ODOMETRY), requested) or tuple(sorted(of(ODOMETRY), key=evidence.odometry)[:1])
    imus, receivers = (_named(of(kind), requested) or tuple(of(kind)) for kind in (IMU, NAVSAT))
    images = of(*IMAGES)
    named = [topic for topic in images if topic in requested]
    raw = [one for one in images if _TRANSPORT.sub("", one) not in images or not _TRANSPORT.search(one)]
    cameras, unpaired = _cameras(named or raw, depths, evidence, named=bool(named))
    read = {*scans, *clouds, *odometry, *imus, *receivers, *unpaired}
    read |= {topic for camera in cameras for topic in (camera.color, camera.depth)}
    for topic, kind in kinds.items():
        if topic in read or topic in left_out or kind not in SENSORS:
            continue
        if kind in IMAGES:
            left_out[topic] = f"another image topic of its camera is read; --topics {topic} reads it"
        elif any(name in requested for name in of(kind)):
            left_out[topic] = "--topics names others of its kind"
        else:
            instead = ", ".join(other for other in (*scans, *clouds, *odometry) if kinds[other] == kind)
            left_out[topic] = f"{instead} is read, {_WHY[kind]}; --topics {topic} reads this one"
    return Choice(scans, clouds, odometry, cameras, unpaired, left_out, imus, receivers)


def _named(topics: list[str], requested: tuple[str, ...]) -> tuple[str, ...]:
    """The topics that the user named."""
    return tuple(topic for topic in topics if topic in requested)


def _lasers(topics: list[str], evidence: Evidence) -> tuple[str, ...]:
    """The scanner with the widest view, and those at other positions on the robot."""
    chosen: list[str] = []
    for topic in sorted(topics, key=evidence.scan):
        if all(evidence.apart(topic, other) for other in chosen):
            chosen.append(topic)
    return tuple(sorted(chosen))


def is_registered(topic: str) -> bool:
    """Whether a topic name says that its depth is registered to the colour camera."""
    return bool(_REGISTERED.search(topic))


def is_infrared(topic: str) -> bool:
    """Whether a topic name says that its images are infrared, or contain no light at all."""
    return bool(_INFRARED.search(topic))


def camera_info_topics(image_topic: str) -> tuple[str, ...]:
    """Topics where the CameraInfo of an image topic may be, by the convention of image_transport."""
    base = _TRANSPORT.sub("", image_topic)
    parent = base.rpartition("/")[0]
    recorded = base.removesuffix("/image/data")  # by librealsense
    return f"{parent}/camera_info", f"{base}/camera_info", f"{recorded}/info/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Whether a topic name says that its images are already undistorted."""
    return "rect" in _TRANSPORT.sub("", image_topic).rpartition("/")[2]


def _cameras(
    images: list[str], depths: Mapping[str, bool], evidence: Evidence, *, named: bool
) -> tuple[tuple[CameraTopics, ...], tuple[str, ...]]:
    """Cameras, and the image topics that belong to no camera."""
    groups: dict[str, list[str]] = {}
    for topic in sorted(images):
        groups.setdefault(_namespace(topic), []).append(topic)
    cameras: list[CameraTopics] = []
    unpaired: list[str] = []
    for space, topics in groups.items():
        pair = _of_one_place(topics, depths, evidence, named=named)
        if len(pair) == 1:
            pair = [CameraTopics(space or "/camera", pair[0].color, pair[0].depth)]
        cameras += pair
        unpaired += [] if pair else topics
    # If names share nothing, topics with the same frame, or the only ones of their type, still match.
    if not cameras and (pair := _of_one_place(unpaired, depths, evidence, named=named)):
        cameras = [CameraTopics("/camera", pair[0].color, pair[0].depth)]
        unpaired = []
    return tuple(cameras), tuple(unpaired)


def _of_one_place(
    topics: list[str], depths: Mapping[str, bool], evidence: Evidence, *, named: bool
) -> list[CameraTopics]:
    """The cameras of one namespace; none if it has no depth or no colour."""
    depth = _best([topic for topic in topics if depths.get(topic)], _depth_rank, named=named)
    frames = {evidence.frame(topic) for topic in depth}

    def color_rank(topic: str) -> tuple[bool, ...]:
        infrared, *rest = _color_rank(topic)
        return infrared, evidence.frame(topic) not in frames, *rest

    color = _best([topic for topic in topics if not depths.get(topic)], color_rank, named=named)
    if not depth or not color:
        return []
    if len(depth) == len(color) > 1:
        return _paired(color, depth)
    if named and len(depth) != len(color):
        depth, color = _best(depth, _depth_rank, named=False), _best(color, color_rank, named=False)
    return [CameraTopics("", color[0], depth[0])]


def _namespace(topic: str) -> str:
    """The part of a topic name before the type of image."""
    parts = topic.strip("/").split("/")
    own: list[str] = []
    for part in parts:
        if _KIND_WORD.search(part):
            break
        own.append(part)
    return "/" + "/".join(own) if own else ""


def _best(topics: list[str], rank: Callable[[str], tuple[bool, ...]], *, named: bool) -> list[str]:
    """The topics of the best rank; all if the user chose them."""
    if named or len(topics) < 2:
        return topics
    ranks = {topic: rank(topic) for topic in topics}
    least = min(ranks.values())
    return [topic for topic in topics if ranks[topic] == least]


def _depth_rank(topic: str) -> tuple[bool, bool, bool]:
    """Depth registered to colour first, then undistorted depth, then raw depth."""
    return not is_registered(topic), not is_rectified(topic), "raw" not in topic


def _color_rank(topic: str) -> tuple[bool, bool, bool, bool]:
    """Colour before grey and infrared, then undistorted images."""
    name = topic.rpartition("/")[2]
    grey = "mono" in name
    return (
        bool(_INFRARED.search(topic)),
        grey,
        not is_rectified(topic),
        "color" not in name and "raw" not in name,
    )


def _paired(colors: list[str], depths: list[str]) -> list[CameraTopics]:
    """Each depth topic with the colour topic that has the longest common prefix."""
    cameras, unpaired = [], list(colors)
    for depth in depths:
        color = max(unpaired, key=lambda topic: len(shared(topic, depth)))
        unpaired.remove(color)
        name = shared(color, depth).rstrip("/_") or depth
        cameras.append(CameraTopics(name, color, depth))
    return cameras


def shared(first: str, second: str) -> str:
    """The common prefix of two names."""
    same = takewhile(lambda pair: pair[0] == pair[1], zip(first, second, strict=False))
    return "".join(letter for letter, _ in same)


def advice(kind: str) -> str:
    """The remedy for messages of an unsupported type, to append to the reason; or nothing."""
    return next((f"; {remedy}" for pattern, remedy in _REMEDIES if re.search(pattern, kind)), "")
