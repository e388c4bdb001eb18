"""Intrinsics and mountings from files next to a recording and from files that the user gives.

A file from the user and Scanweave's ``calibration.yaml`` have priority over the recording; other files add
what it lacks. If two sources contradict each other, both values are reported.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.lens import Lens
from slam.datasets.calibration import FILE_NAME
from slam.datasets.calibration_formats import FileCamera, FileTransform, read_calibration_file
from slam.datasets.camera_frames import Camera
from slam.errors import DatasetError
from slam.foreign import plain
from slam.measurements import CameraIntrinsics

_SUFFIXES = {".yaml", ".yml", ".urdf", ".xml"}
_NO_CALIBRATION = {"metadata.yaml"}  # the index of a bag
_INSIDE = ("calibration", "calib")
_IMAGE_LIST = "rgb.txt"
_MOST_FILES = 64  # in a folder with any contents
_APART_SHARE = 0.005  # of focal lengths and the width: repeated calibrations of one lens agree no better
_ROLES = {
    "depth": re.compile(r"depth|(^|[^a-z])(ir|infra|tof)", re.IGNORECASE),
    "color": re.compile(r"rgb|colou?r", re.IGNORECASE),
}


@dataclass(slots=True)
class KnownCalibration:
    """Lenses and mountings from files.

    Attributes
    ----------
    cameras, transforms
        From all files; those with priority over the recording come first.
    T_base_camera, T_base_lidar
        Pose of the only camera or 3D lidar, with its source file.
    sure
        Names of the files with priority over the recording.
    notes
        Files that look like calibrations and cannot be read.
    """

    cameras: list[FileCamera] = field(default_factory=list)
    transforms: list[FileTransform] = field(default_factory=list)
    T_base_camera: tuple[gtsam.Pose3, str] | None = None
    T_base_lidar: tuple[gtsam.Pose3, str] | None = None
    sure: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)

    def lens(
        self, role: str, names: Iterable[str] = (), size: tuple[int, int] | None = None
    ) -> FileCamera | None:
        """The camera in the files whose lens belongs to an image.

        Found by topic or frame; else by its name, "depth" or "color"; else the only one with the image's
        size. None if there is none, or if it is ambiguous.

        Parameters
        ----------
        names
            Topic and frame of the image.
        size
            Its width and height; None if unknown.
        """
        lenses = [item for item in self.cameras if item.lens is not None]
        own = {name.strip("/") for name in names if name}
        for item in lenses:
            if {item.topic.strip("/"), item.frame.strip("/")} & own - {""}:
                return item
        fit = [item for item in lenses if size is None or _size(item) in (size, (0, 0))]
        called = [item for item in fit if _ROLES[role].search(f"{item.name} {item.topic}")]
        other = "color" if role == "depth" else "depth"
        nameless = [item for item in fit if not _ROLES[other].search(f"{item.name} {item.topic}")]
        for group in (called, nameless):
            if len(group) == 1 or (group and group[0].source in self.sure):
                return group[0]
        return None

    def depth_steps_per_m(self) -> tuple[float, str] | None:
        """Units per metre of depth images, with the source file."""
        stated = [(camera.depth_steps_per_m, camera.source) for camera in self.cameras]
        return next(((steps, source) for steps, source in stated if steps is not None), None)


def known_beside(path: Path, named: Sequence[Path] = ()) -> KnownCalibration:
    """Read the files that the user gave, and those next to a recording.

    Parameters
    ----------
    path
        The recording; the search is in this folder, or in the folder of this file.

    Raises
    ------
    DatasetError
        A file from the user or a `calibration.yaml` is no calibration or cannot be read.
    """
    known = KnownCalibration()
    folder = path if path.is_dir() else path.parent
    # Next to a bag and an image list, as in a simulated drive, `calibration.yaml` belongs to the images.
    of_images = path.is_file() and (folder / _IMAGE_LIST).is_file()
    own = [folder / FILE_NAME] if (folder / FILE_NAME).is_file() and not of_images else []
    for file in [*named, *own]:
        try:
            _add(known, file, priority=True)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{file}: {plain(error)}; correct the calibration, or leave it out") from error
    if silent := [file for file in named if file.name not in known.sure]:
        raise DatasetError(
            f"{silent[0]} contains neither lens nor mounting; give a calibration.yaml, a camera_info yaml, a "
            "Kalibr camchain, a URDF, a yaml of tf or what OpenCV wrote"
        )
    for file in _candidates(folder):
        if file in own or file in named or (of_images and file.name == FILE_NAME):
            continue
        try:
            _add(known, file, priority=False)
        except (OSError, ValueError) as error:
            known.notes.append(f"{file.name}, beside the recording, is not used: {plain(error)}")
    return known


def by_files(camera: Camera, known: KnownCalibration, account: Account) -> Camera:
    """A camera of image files; its lens comes from files if one was given or its own is assumed.

    The lens of its colour image applies to both; distortion remains in the images and is reported.
    """
    calibration = camera.calibration
    file = known.lens("color", [camera.sensor])
    priority = known.sure - {FILE_NAME}  # the folder reader has used this file already
    if file is not None and file.lens is not None and (calibration.assumed or file.source in priority):
        lens = file.lens
        if calibration.assumed:
            account.report.note(f"{camera.sensor}: lens by {file.source}", 1)
        else:
            warning = contradiction(
                camera.sensor,
                (lens, file.source),
                (Lens(calibration.intrinsics, np.zeros(0)), "the data set"),
            )
            account.report.note(warning or f"{camera.sensor}: lens by {file.source}", 1)
        if lens.distortion.size or lens.unknown_model:
            account.report.note(f"{camera.sensor}: the distortion in {file.source} is left in the images", 1)
        calibration = replace(calibration, intrinsics=lens.intrinsics, assumed="")
        if file.depth_steps_per_m is not None:
            calibration = replace(calibration, depth_steps_per_m=file.depth_steps_per_m)
    return replace(camera, calibration=calibration)


def contradiction(what: str, used: tuple[Lens, str], other: tuple[Lens, str]) -> str:
    """A warning if two sources contradict each other about a lens; else empty."""
    first, second = used[0].intrinsics, other[0].intrinsics
    scale = first.width / second.width if first.width and second.width else 1.0
    values = [np.array([lens.fx, lens.fy, lens.cx, lens.cy]) for lens in (first, second)]
    width = first.width or 2.0 * first.cx
    if np.abs(values[0] - scale * values[1]).max() <= _APART_SHARE * max(width, first.fx):
        return ""
    return (
        f"warning: {what}: {used[1]} says {_lens_text(first)}, {other[1]} says {_lens_text(second)}; "
        f"that of {used[1]} is used"
    )


def _lens_text(lens: CameraIntrinsics) -> str:
    """A lens as text for the user."""
    size = f" at {lens.width} x {lens.height}" if lens.width else ""
    return f"fx {lens.fx:.1f} fy {lens.fy:.1f} cx {lens.cx:.1f} cy {lens.cy:.1f}{size}"


def _add(known: KnownCalibration, file: Path, *, priority: bool) -> None:
    """Add one file."""
    content = read_calibration_file(file)
    if not content:
        return
    known.cameras += content.cameras
    known.transforms += content.transforms
    if content.T_base_camera is not None:
        known.T_base_camera = known.T_base_camera or (content.T_base_camera, file.name)
    if content.T_base_lidar is not None:
        known.T_base_lidar = known.T_base_lidar or (content.T_base_lidar, file.name)
    if priority:
        known.sure.add(file.name)


def _candidates(folder: Path) -> list[Path]:
    """Files that may be calibrations, sorted by name."""
    paths: list[Path] = []
    for place in (folder, *(folder / name for name in _INSIDE)):
        if place.is_dir():
            files = (file for file in place.iterdir() if file.suffix.lower() in _SUFFIXES)
            paths += sorted(
                islice((f for f in files if f.is_file() and f.name not in _NO_CALIBRATION), _MOST_FILES)
            )
    return paths


def _size(camera: FileCamera) -> tuple[int, int]:
    """Width and height of the images of a camera's lens."""
    assert camera.lens is not None
    return camera.lens.intrinsics.width, camera.lens.intrinsics.height
