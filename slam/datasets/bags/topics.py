"""Which topics of a bag are read: by their types, and by name where the types leave a choice."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import takewhile

LASER_SCAN = "sensor_msgs/msg/LaserScan"
MULTI_ECHO = "sensor_msgs/msg/MultiEchoLaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
SCANS = frozenset({LASER_SCAN, MULTI_ECHO})
IMAGES = frozenset({IMAGE, COMPRESSED})
SENSORS = SCANS | IMAGES | {CLOUD, ODOMETRY, IMU}

_KIND_WORD = re.compile(r"rgb|colou?r|depth|image|infra|^ir$|mono|left|right", re.IGNORECASE)
_REGISTERED = re.compile(r"aligned_depth|depth_registered|depth_to_(rgb|color)|registered", re.IGNORECASE)
_INFRARED = re.compile(r"infra|(^|[/_])ir([/_]|$)|confidence", re.IGNORECASE)
_TRANSPORT = re.compile(r"/(compressed|compressedDepth|theora|ffmpeg|zstd)$")


class AmbiguousError(Exception):
    """Several topics could be meant; ``topics`` are they, ``what`` they hold."""

    def __init__(self, what: str, topics: Iterable[str]) -> None:
        self.what, self.topics = what, sorted(topics)
        super().__init__(what)


@dataclass(frozen=True, slots=True)
class CameraTopics:
    """Two image topics that are one camera."""

    name: str
    color: str
    depth: str


@dataclass(frozen=True, slots=True)
class Choice:
    """The topics that are read.

    Attributes
    ----------
    scans, clouds, odometry
        Of one laser each, of one lidar each, and of the wheels.
    imus
        Of one inertial measurement unit each; all are read, and the mapper takes one.
    lonely
        Image topics that are not read since the colour or the depth beside them is missing.
    left_out
        Why other topics of sensors are not read.
    """

    scans: tuple[str, ...]
    clouds: tuple[str, ...]
    odometry: tuple[str, ...]
    cameras: tuple[CameraTopics, ...]
    lonely: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    imus: tuple[str, ...] = ()


def choose(
    kinds: Mapping[str, str],
    depths: Mapping[str, bool],
    wanted: tuple[str, ...],
    camera_clouds: Mapping[str, str] | None = None,
) -> Choice:
    """The topics to read.

    Parameters
    ----------
    kinds
        Message type of each topic that holds messages.
    depths
        For each image topic whether it holds depth.
    wanted
        Topics named by the user: of their sort (scans, clouds, wheels, images) no others are read.
    camera_clouds
        Clouds that a depth camera has made, with what tells so: read only where they are named, or the bag
        has nothing else that sees.

    Raises
    ------
    AmbiguousError
        Several topics of a sort, and none of them named.
    """
    made = {topic: why for topic, why in (camera_clouds or {}).items() if topic not in wanted}
    if made:
        without = {topic: kind for topic, kind in kinds.items() if topic not in made}
        choice = choose(without, depths, wanted)
        if choice.scans or choice.clouds or choice.cameras:
            why = "it is no lidar's but a depth camera's cloud ({}); --topics {} reads it as a lidar's"
            choice.left_out.update({topic: why.format(told, topic) for topic, told in made.items()})
            return choice
    scans = _one("laser", [topic for topic, kind in kinds.items() if kind in SCANS], wanted)
    clouds = _one("point cloud", [topic for topic, kind in kinds.items() if kind == CLOUD], wanted)
    odometry = _one("odometry", [topic for topic, kind in kinds.items() if kind == ODOMETRY], wanted)
    imus = [topic for topic, kind in kinds.items() if kind == IMU]
    imus = [topic for topic in imus if topic in wanted] or imus
    images = [topic for topic, kind in kinds.items() if kind in IMAGES]
    named = [topic for topic in images if topic in wanted]
    cameras, lonely = _cameras(named or _raw_first(images), depths, given=bool(named))
    read = {
        *scans,
        *clouds,
        *odometry,
        *imus,
        *lonely,
        *(t for one in cameras for t in (one.color, one.depth)),
    }
    left_out = {
        topic: f"another image topic of its camera is read; --topics {topic} reads it"
        if kind in IMAGES
        else "--topics names others of its sort"
        for topic, kind in kinds.items()
        if topic not in read
    }
    return Choice(scans, clouds, odometry, cameras, lonely, left_out, tuple(imus))


def camera_info_topics(image_topic: str) -> tuple[str, ...]:
    """Where the CameraInfo of an image topic is: beside it, by the rule of image_transport."""
    base = _TRANSPORT.sub("", image_topic)
    parent = base.rpartition("/")[0]
    return f"{parent}/camera_info", f"{base}/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Whether a topic's name says that distortion is taken out of its images already."""
    return "rect" in _TRANSPORT.sub("", image_topic).rpartition("/")[2]


def _one(what: str, topics: list[str], wanted: tuple[str, ...]) -> tuple[str, ...]:
    """The only topic of a sort, or those that are named."""
    named = tuple(topic for topic in topics if topic in wanted)
    if not named and len(topics) > 1:
        raise AmbiguousError(what, topics)
    return named or tuple(topics)


def _raw_first(images: list[str]) -> list[str]:
    """Image topics without the packed copies of others."""
    return [
        topic for topic in images if _TRANSPORT.sub("", topic) not in images or not _TRANSPORT.search(topic)
    ]


def _cameras(
    images: list[str], depths: Mapping[str, bool], *, given: bool
) -> tuple[tuple[CameraTopics, ...], tuple[str, ...]]:
    """Cameras, and the image topics that are none."""
    groups: dict[str, list[str]] = {}
    for topic in sorted(images):
        groups.setdefault(_namespace(topic), []).append(topic)
    cameras: list[CameraTopics] = []
    lonely: list[str] = []
    for space, topics in groups.items():
        depth = _best([topic for topic in topics if depths.get(topic)], _depth_rank, given=given)
        color = _best([topic for topic in topics if not depths.get(topic)], _color_rank, given=given)
        if not depth or not color:
            lonely += topics
            continue
        if len(depth) > 1 or len(color) > 1:
            if not given:
                raise AmbiguousError("camera" if not space else f"{space} camera", [*color, *depth])
            cameras += _paired(color, depth)
            continue
        cameras.append(CameraTopics(space or "/camera", color[0], depth[0]))
    # Where names share nothing, the only colour and the only depth still belong together.
    sorts = [[t for t in lonely if depths.get(t)], [t for t in lonely if not depths.get(t)]]
    if not cameras and all(len(sort) == 1 for sort in sorts):
        cameras.append(CameraTopics("/camera", sorts[1][0], sorts[0][0]))
        lonely = []
    return tuple(cameras), tuple(lonely)


def _namespace(topic: str) -> str:
    """What of a topic's name is before the part that tells the sort of image."""
    parts = topic.strip("/").split("/")
    own: list[str] = []
    for part in parts:
        if _KIND_WORD.search(part):
            break
        own.append(part)
    return "/" + "/".join(own) if own else ""


def _best(topics: list[str], rank: object, *, given: bool) -> list[str]:
    """The topics of the best rank; all where they are the user's own choice."""
    assert callable(rank)
    if given or len(topics) < 2:
        return topics
    ranks = {topic: rank(topic) for topic in topics}
    least = min(ranks.values())
    return [topic for topic in topics if ranks[topic] == least]


def _depth_rank(topic: str) -> tuple[bool, bool, bool]:
    """Depth that is registered to colour first, then without distortion, then as the camera gave it."""
    return not _REGISTERED.search(topic), not is_rectified(topic), "raw" not in topic


def _color_rank(topic: str) -> tuple[bool, bool, bool, bool]:
    """Colour before grey and infrared, then without distortion."""
    name = topic.rpartition("/")[2]
    grey = "mono" in name
    return (
        bool(_INFRARED.search(topic)),
        grey,
        not is_rectified(topic),
        "color" not in name and "raw" not in name,
    )


def _paired(colors: list[str], depths: list[str]) -> list[CameraTopics]:
    """Each depth topic with the colour topic whose name begins most alike."""
    cameras, left = [], list(colors)
    for depth in depths:
        if not left:
            raise AmbiguousError("camera", [*colors, *depths])
        color = max(left, key=lambda topic: len(_shared(topic, depth)))
        left.remove(color)
        name = _shared(color, depth).rstrip("/_") or depth
        cameras.append(CameraTopics(name, color, depth))
    return cameras


def _shared(first: str, second: str) -> str:
    """The letters with which two names begin alike."""
    same = takewhile(lambda pair: pair[0] == pair[1], zip(first, second, strict=False))
    return "".join(letter for letter, _ in same)
