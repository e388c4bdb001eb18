"""Reads lenses and mountings from the files of other tools.

ROS camera_info (also a printed message), Kalibr's camchain, OpenCV's FileStorage, ORB-SLAM's settings,
EuRoC's sensor.yaml, URDF, printed tf, lists of transforms, and Scanweave's calibration.yaml.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.parsers import expat

import gtsam
import numpy as np

from slam.datasets.bags.decoding import frame_name
from slam.datasets.bags.lens import Lens, lens_of
from slam.datasets.calibration import pose_from, pose_from_matrix, positive
from slam.datasets.dataset import RecordFault
from slam.foreign import MOST_TEXT, from_yaml
from slam.measurements import FloatArray

_CAMERA = re.compile(r"cam\d+")
_MODELS = {"radtan": "plumb_bob", "radial-tangential": "plumb_bob", "none": "", "opencv": "plumb_bob"}
_K_NAMES = ("camera_matrix", "cameraMatrix", "CameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "k")
_D_NAMES = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "dist_coeffs",
    "distCoeffs",
    "dist_coeff",
    "D",
    "d",
)
_WIDTHS, _HEIGHTS = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")


@dataclass(frozen=True, slots=True, eq=False)
class FileCamera:
    """A camera of a calibration file.

    Attributes
    ----------
    name
        Its name in the file, else the file name.
    lens
        Lens with distortion; None if the file contains only a mounting or a depth unit.
    source
        The file, for messages.
    topic
        Topic of its images, if the file contains it.
    frame
        Its name in the transforms of the same file.
    depth_steps_per_m
        Units per metre of depth images; None if the file does not contain them.
    """

    name: str
    lens: Lens | None
    source: str
    topic: str = ""
    frame: str = ""
    depth_steps_per_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FileTransform:
    """``T_parent_child`` in a file."""

    parent: str
    child: str
    pose: gtsam.Pose3
    source: str


@dataclass(slots=True)
class FileContent:
    """The contents of one file.

    Attributes
    ----------
    T_base_camera, T_base_lidar
        Pose of the only camera or 3D lidar, from a `calibration.yaml`.
    """

    cameras: list[FileCamera] = field(default_factory=list)
    transforms: list[FileTransform] = field(default_factory=list)
    T_base_camera: gtsam.Pose3 | None = None
    T_base_lidar: gtsam.Pose3 | None = None

    def __bool__(self) -> bool:
        placed = self.T_base_camera is not None or self.T_base_lidar is not None
        return bool(self.cameras or self.transforms or placed)


def read_calibration_file(path: Path) -> FileContent:
    """The lenses and mountings in a file; nothing if it is of another type.

    Raises
    ------
    ValueError
        It is of a known type and contains an invalid value.
    OSError
        It cannot be read.
    """
    if path.stat().st_size > MOST_TEXT:
        return FileContent()
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        if text.lstrip().startswith("<"):
            return _from_xml(text, path)
        tree = _yaml(text)
        return _from_tree(tree, path) if isinstance(tree, Mapping) else FileContent()
    except (RecordFault, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(missing) from error


def _yaml(text: str) -> Any:
    """The first document of a YAML text; None if it is not YAML."""
    # OpenCV writes a first line and tags that are not YAML.
    plain = re.sub(r"^%YAML[^\n]*\n|!!opencv-matrix", "", text, flags=re.MULTILINE)
    first = re.split(r"^---[^\n]*$", plain.lstrip().removeprefix("---"), maxsplit=1, flags=re.MULTILINE)[0]
    try:
        return from_yaml(first)
    except ValueError:
        return None


def _from_tree(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse a mapping by its keys."""
    for reads in (_own, _kalibr, _printed_tf, _matrices, _orb_slam, _euroc, _camera_info):
        if content := reads(tree, path):
            return content
    return FileContent()


def _own(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse Scanweave's ``calibration.yaml``."""
    content, source = FileContent(), path.name
    lens, fields = None, tree.get("intrinsics")
    if isinstance(fields, Mapping):
        size = int(fields.get("width") or 0), int(fields.get("height") or 0)
        lens = _lens([float(fields[name]) for name in ("fx", "fy", "cx", "cy")], size)
    steps = _steps(tree.get("depth_steps_per_m"))
    if lens is not None or steps is not None:
        content.cameras.append(FileCamera("", lens, source, depth_steps_per_m=steps))
    for name in ("T_base_camera", "T_base_lidar"):
        if isinstance(placed := tree.get(name), Mapping):
            setattr(content, name, pose_from(placed["translation_m"], placed["quaternion_xyzw"]))
    return content


def _kalibr(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse Kalibr's camchain; its transforms map points of the second frame to the first."""
    content, source = FileContent(), path.name
    for name, fields in tree.items():
        if not (isinstance(fields, Mapping) and _CAMERA.fullmatch(str(name))):
            continue
        if "intrinsics" in fields:
            lens = _named_lens(fields, fields.get("distortion_coeffs", ()))
            topic = str(fields.get("rostopic", ""))
            content.cameras.append(FileCamera(str(name), lens, source, topic, str(name)))
        before = f"cam{int(str(name)[3:]) - 1}"
        for key, other in (("T_cam_imu", "imu"), ("T_cn_cnm1", before), ("T_cam_lidar", "lidar")):
            if key in fields:
                pose = pose_from_matrix(np.asarray(fields[key], dtype=np.float64).reshape(4, 4))
                content.transforms.append(FileTransform(str(name), other, pose, source))
        if "T_imu_cam" in fields:  # OpenVINS writes the inverse
            pose = pose_from_matrix(np.asarray(fields["T_imu_cam"], dtype=np.float64).reshape(4, 4))
            content.transforms.append(FileTransform("imu", str(name), pose, source))
    return content


def _printed_tf(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse a printed TFMessage or TransformStamped, or a list of them."""
    rows = tree.get("transforms", [tree] if "child_frame_id" in tree else ())
    content = FileContent()
    for row in rows if isinstance(rows, list) else ():
        at = row["transform"]
        translation = [at["translation"][axis] for axis in "xyz"]
        pose = pose_from(translation, [at["rotation"][axis] for axis in "xyzw"])
        parent = row["header"]["frame_id"] if "header" in row else row["frame_id"]
        content.transforms.append(
            FileTransform(frame_name(parent), frame_name(row["child_frame_id"]), pose, path.name)
        )
    return content


def _matrices(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse lists of transforms with frame names: matrices, or a translation and a rotation each."""
    content = FileContent()
    for rows in tree.values():
        for row in rows if isinstance(rows, list) else ():
            if not (isinstance(row, Mapping) and {"parent_frame", "child_frame"} <= set(row)):
                continue
            if "matrix" in row:
                pose = pose_from_matrix(numbers_in(row["matrix"]).reshape(4, 4))
            else:
                pose = pose_from(numbers_in(row["translation"]), numbers_in(row["rotation"]))
            frames = frame_name(row["parent_frame"]), frame_name(row["child_frame"])
            content.transforms.append(FileTransform(*frames, pose, path.name))
    return content


def _orb_slam(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse settings of ORB-SLAM 2 and 3."""
    fields = {re.sub(r"^Camera1?\.", "", key): tree[key] for key in map(str, tree) if key in tree}
    if "fx" not in fields or not any(str(key).startswith("Camera") for key in tree):
        return FileContent()
    distortion = [float(fields.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2", "k3")]
    size = int(fields.get("width", 0)), int(fields.get("height", 0))
    model = "equidistant" if fields.get("type") == "KannalaBrandt8" else "plumb_bob"
    if model == "equidistant":
        distortion = [float(fields.get(f"k{place}", 0.0)) for place in range(1, 5)]
    pin_hole = [float(fields[name]) for name in ("fx", "fy", "cx", "cy")]
    steps = _steps(tree.get("DepthMapFactor", tree.get("RGBD.DepthMapFactor")))
    lens = _lens(pin_hole, size, distortion, model)
    return FileContent([FileCamera(path.stem, lens, path.name, depth_steps_per_m=steps)])


def _euroc(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse ``sensor.yaml`` of a camera in EuRoC's layout: its pose in the body frame, and its lens."""
    if tree.get("sensor_type") != "camera" or "intrinsics" not in tree:
        return FileContent()
    name = path.parent.name
    lens = _named_lens(tree, tree.get("distortion_coefficients", ()))
    content = FileContent([FileCamera(name, lens, f"{name}/{path.name}", frame=name)])
    if "T_BS" in tree:
        pose = pose_from_matrix(numbers_in(tree["T_BS"]).reshape(4, 4))
        content.transforms.append(FileTransform("body", name, pose, f"{name}/{path.name}"))
    return content


def _camera_info(tree: Mapping[Any, Any], path: Path) -> FileContent:
    """Parse a ROS camera_info file, a printed CameraInfo, or the output of OpenCV's calibration."""
    matrix = next((tree[name] for name in _K_NAMES if name in tree), None)
    if matrix is None:
        return FileContent()
    k = numbers_in(matrix)
    if k.size != 9:
        raise ValueError(f"a camera matrix of {k.size} numbers")
    distortion = next((numbers_in(tree[name]) for name in _D_NAMES if name in tree), np.zeros(0))
    size = [next((int(tree[name]) for name in names if name in tree), 0) for names in (_WIDTHS, _HEIGHTS)]
    for name in ("image_size", "imageSize", "resolution"):
        if name in tree:
            size = [int(number) for number in numbers_in(tree[name])]
    model = str(tree.get("distortion_model", ""))
    lens = _lens([k[0], k[4], k[2], k[5]], (size[0], size[1]), distortion, _MODELS.get(model, model))
    header = tree.get("header")
    frame = frame_name(header["frame_id"]) if isinstance(header, Mapping) else ""
    name = f"{path.stem} {tree.get('camera_name', '')}".strip()
    return FileContent([FileCamera(name, lens, path.name, frame=frame)])


def _named_lens(fields: Mapping[Any, Any], distortion: Any) -> Lens:
    """A lens with its models by name, as Kalibr writes it."""
    projection, model = str(fields.get("camera_model", "pinhole")), str(fields.get("distortion_model", ""))
    numbers = numbers_in(fields["intrinsics"])[-4:]
    width, height = (int(number) for number in numbers_in(fields.get("resolution", (0, 0))))
    model = _MODELS.get(model, model) if projection == "pinhole" else projection
    return _lens(numbers, (width, height), numbers_in(distortion), model)


def _lens(pin_hole: Any, size: tuple[int, int], distortion: Any = (), model: str = "plumb_bob") -> Lens:
    """A lens from fx, fy, cx and cy, checked like that of a CameraInfo."""
    fx, fy, cx, cy = (float(number) for number in pin_hole)
    k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    info = SimpleNamespace(k=k, p=[], d=distortion, width=size[0], height=size[1], distortion_model=model)
    return lens_of(info, rectified=False)


def _from_xml(text: str, path: Path) -> FileContent:
    """Parse a URDF, or OpenCV's FileStorage as XML."""
    elements = list(_elements(text))
    names = {name for name, _, _ in elements}
    if "opencv_storage" in names:
        values: dict[str, Any] = {}
        for name, above, content in elements:
            if above == "opencv_storage":
                values.setdefault(name, content)
            elif name == "data":
                values[above] = content.split()
        return _camera_info(values, path)
    return FileContent(transforms=list(_joints(text, path.name))) if "robot" in names else FileContent()


def _joints(text: str, source: str) -> Iterator[FileTransform]:
    """The joints of a URDF at position zero."""
    joint: dict[str, str] = {}
    for name, above, content in _elements(text, attributes=True):
        if name == "joint" and above == "robot":
            if "parent" in joint and "child" in joint:
                yield _joint(joint, source)
            joint = {}
        elif above == "joint":
            joint[name] = content
    if "parent" in joint and "child" in joint:
        yield _joint(joint, source)


def _joint(joint: Mapping[str, str], source: str) -> FileTransform:
    """One joint; roll, pitch and yaw are rotations about fixed axes."""
    origin = dict(re.findall(r"(\w+)=([^\n]*)", joint.get("origin", "")))
    translation = numbers_in(origin.get("xyz", "0 0 0").split())
    turn = gtsam.Rot3.RzRyRx(*numbers_in(origin.get("rpy", "0 0 0").split()).tolist())
    if translation.size != 3:
        raise ValueError(f"origin {origin}")
    links = [joint[end].partition("=")[2].strip() for end in ("parent", "child")]
    return FileTransform(frame_name(links[0]), frame_name(links[1]), gtsam.Pose3(turn, translation), source)


def _elements(text: str, *, attributes: bool = False) -> Iterator[tuple[str, str, str]]:
    """The elements of an XML text as they end: name, name of the parent, and text or attributes.

    With ``attributes``, elements are returned when they start. Entities are not resolved.
    """
    stack, texts, elements = list[str](), list[list[str]](), list[tuple[str, str, str]]()

    def begin(name: str, given: dict[str, str]) -> None:
        if attributes:
            content = "\n".join(f"{key}={value}" for key, value in given.items())
            elements.append((name, stack[-1] if stack else "", content))
        stack.append(name)
        texts.append([])

    def end(name: str) -> None:
        stack.pop()
        content = "".join(texts.pop())
        if not attributes:
            elements.append((name, stack[-1] if stack else "", content.strip()))

    def refuse(*_: Any) -> None:
        raise ValueError("entities are not read")

    parser = expat.ParserCreate()
    handlers: dict[str, Callable[..., None]] = {
        "StartElementHandler": begin,
        "EndElementHandler": end,
        "CharacterDataHandler": lambda part: texts[-1].append(part) if texts else None,
        "EntityDeclHandler": refuse,
    }
    for name, handler in handlers.items():
        setattr(parser, name, handler)
    try:
        parser.Parse(text, True)
    except expat.ExpatError:
        return iter(())
    return iter(elements)


def numbers_in(value: Any) -> FloatArray:
    """The finite numbers of a list, nested lists, or a matrix as OpenCV writes it, (N,)."""
    numbers: FloatArray = np.asarray(
        value["data"] if isinstance(value, Mapping) else value, dtype=np.float64
    ).ravel()
    if not np.isfinite(numbers).all():
        raise ValueError(f"{value} is not of finite numbers")
    return numbers


def _steps(value: Any) -> float | None:
    """A positive number, or None."""
    return None if value is None else positive(value)
