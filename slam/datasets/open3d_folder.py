"""Folders of numbered or stamped images with a lens file: Open3D, Redwood, SUN3D, ScanNet, and others.

Choi et al. 2015, "Robust Reconstruction of Indoor Scenes" (Redwood); Xiao et al. 2013, "SUN3D"; Dai et al.
2017, "ScanNet: Richly-annotated 3D Reconstructions of Indoor Scenes".
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.datasets.account import Account
from slam.datasets.budget import Budget
from slam.datasets.calibration import FILE_NAME, KINECT, Calibration, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import pair_images
from slam.datasets.image_files import FILES, MANY_CHANNELS, ImageFiles, decoded, file_content, metres_of
from slam.datasets.lens_files import camera_matrix, four_numbers, open3d_lens, plain_lens
from slam.datasets.log_file import files_inside
from slam.datasets.numbered_frames import (
    NO_STAMPS,
    RATE_HZ,
    at_rate,
    numbered_camera,
    numbered_files,
    poses_of_files,
    with_own_calibration,
)
from slam.datasets.pose_files import numbers_of, pose_blocks, trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile, in_seconds
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics, Float32Array

# Redwood's folders start with the name of the scene: livingroom1-color, livingroom1-depth-clean.
_COLORS = re.compile(r"(?:.+-)?(?:colors?|rgb|images?)")
_DEPTHS = re.compile(r"(?:.+-)?depths?(?:TSDF|[-_](?:clean|simulated|noisy))?")
# ScanNet has a lens for each; if there is only one, it applies to both.
_LENSES_OF = tuple(f"{name}_{{}}.txt" for name in ("intrinsic/intrinsic", "intrinsic", "intrinsics"))
_LENSES = (
    *("camera_intrinsic.json", "camera_intrinsics.json", "intrinsic.json", "intrinsics.json"),
    *("camera_primesense.json", "intrinsics.txt", "intrinsic.txt", "camera.txt", "camera-intrinsics.txt"),
)
_POSES = ("trajectory.log", "*-traj.txt", "*.log", "scene/trajectory.log")
ASSUMED = (
    "intrinsics and millimetres assumed (525 525 319.5 239.5 at 640 x 480, as Redwood's); "
    "give a camera_intrinsic.json, a calibration.yaml or --calibration FILE"
)
NO_NUMBER = "image whose name is no number"
STAMPS_IN_NAMES = "stamps from the names of the files"

# 000012, frame000012, color_12, frame-000012.color
_NUMBER = re.compile(r"[a-z_-]*0*(\d{1,8})(?:\.(?:color|depth))?", re.IGNORECASE)
_POSE_FILE = r"(?:frame-)?(\d{1,9})(?:\.pose)?\.txt"
_FRAME_AND_STAMP = re.compile(r"(\d{1,9})-(\d{6,15})")  # 0000012-000000400400: a frame, microseconds
_CLOCK = re.compile(r"[a-z_-]*(\d{9,19}(?:\.\d{1,9})?|\d{1,8}\.\d{1,9})", re.IGNORECASE)
_IMAGES = frozenset({".png", ".jpg", ".jpeg"})


@dataclass(frozen=True, slots=True)
class _RotatedDepth(ImageFiles):
    """SUN3D's depth: millimetres with 16 bits rotated by three."""

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `slam.datasets.image_files.ImageSource`."""
        steps = decoded(file_content(file.path, budget), file.path.name, budget)
        if steps.ndim != 2 or steps.dtype != np.uint16:
            raise RecordFault(MANY_CHANNELS, f"{file.path.name}: {steps.dtype} {steps.shape}")
        return metres_of((steps >> 3) | (steps << 13), calibration)


def _places(path: Path) -> tuple[Path, Path] | None:
    """The colour and the depth folder."""
    inside = sorted((len(entry.name), entry) for entry in path.iterdir() if entry.is_dir())
    colors, depths = (
        [entry for _, entry in inside if pattern.fullmatch(entry.name)] for pattern in (_COLORS, _DEPTHS)
    )
    return (colors[0], depths[0]) if colors and depths else None


def _named(folder: Path) -> list[tuple[str, Path]]:
    """Images by their file names without suffix."""
    return sorted((file.stem, file) for file in files_inside(folder, _IMAGES))


def _camera(path: Path, account: Account) -> Camera:
    """Pairs by number, or by the stamps in the names."""
    places = _places(path)
    assert places is not None
    colors, depths = (_named(place) for place in places)
    sun3d = places[0].name == "image" and (path / "intrinsics.txt").is_file()
    source = _RotatedDepth() if sun3d else FILES
    calibration = _calibration(path)
    unnumbered = [file.name for name, file in (*colors, *depths) if not _NUMBER.fullmatch(name)]
    if 2 * len(unnumbered) < len(colors) + len(depths):
        for name in unnumbered:
            account.refuse(RecordFault(NO_NUMBER, name), path.name, 0)
        account.report.note(NO_STAMPS.format(rate=RATE_HZ), 1)
        numbered = [numbered_files(place, _NUMBER.pattern + r"\.(?:png|jpe?g)") for place in places]
        return numbered_camera(numbered[0], numbered[1], calibration, account, at_rate(), source)
    account.report.note(STAMPS_IN_NAMES, 1)
    stamped = [_stamped(place, named, account) for place, named in zip(places, (colors, depths), strict=True)]
    return Camera(
        "camera", pair_images(stamped[0], stamped[1], account, "camera"), calibration, source=source
    )


def _stamped(folder: Path, named: list[tuple[str, Path]], account: Account) -> list[StampedFile]:
    """Images sorted by the stamps in their names."""
    stamped = []
    for number, (name, file) in enumerate(named, 1):
        if match := _FRAME_AND_STAMP.fullmatch(name):
            stamped.append(StampedFile(int(match[2]) * 1e-6, file, number))
        elif match := _CLOCK.fullmatch(name):
            stamped.append(StampedFile(float(match[1]), file, number))
        else:
            raise DatasetError(
                f"{folder} holds '{file.name}', which is no number and no stamp; "
                "list the images with their stamps in rgb.txt and depth.txt, as TUM does"
            )
    return sorted(in_seconds(stamped, account, folder.name), key=lambda image: image.stamp_s)


def _calibration(path: Path) -> Calibration:
    """Calibration from the lens file, else PrimeSense's, as Redwood and Open3D use it."""
    places = (path, path.resolve().parent)
    depth, color = (
        next((place / name for place in places for name in names if (place / name).is_file()), None)
        for names in (
            [*(name.format("depth") for name in _LENSES_OF), *_LENSES],
            [name.format("color") for name in _LENSES_OF],
        )
    )
    if depth is None:
        assumed = "" if (path / FILE_NAME).is_file() else ASSUMED
        return read_calibration(path, Calibration(KINECT, 1000.0, assumed=assumed))
    color_lens = plain_lens(_lens(color)) if color else None
    return with_own_calibration(path, Calibration(_lens(depth), 1000.0, color_lens=color_lens))


def _lens(file: Path) -> CameraIntrinsics:
    """Read a lens as JSON, as a matrix of nine or sixteen numbers, or as four numbers."""
    if file.suffix == ".json":
        return open3d_lens(file)
    numbers = numbers_of(file)
    size = 0 if numbers is None else numbers.size
    return camera_matrix(file, 3 if size == 9 else 4) if size in (9, 16) else four_numbers(file)


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Camera to world from blocks of numbered matrices, or one file each; frame N has the stamp N / 30 s."""
    if files := numbered_files(path / "pose", _POSE_FILE):
        return poses_of_files(files, at_rate(), account)
    pose_file = next((file for pattern in _POSES for file in sorted(path.glob(pattern))), None)
    poses = pose_blocks(pose_file, account) if pose_file else {}
    return trajectory_of((number / RATE_HZ, pose) for number, pose in sorted(poses.items()))


FORMAT = recorded(
    "Open3D, Redwood, SUN3D or ScanNet folder",
    lambda path, head: bool(path.is_dir() and (places := _places(path)) and all(map(_named, places))),
    lambda *folder: Contents([_camera(*folder)]),
    _groundtruth,
)
