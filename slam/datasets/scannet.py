"""ScanNet scenes as its own tool extracts them: images, poses and lenses in folders.

Dai et al. 2017, "ScanNet: Richly-annotated 3D Reconstructions of Indoor Scenes".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.lens_files import camera_matrix, plain_lens
from slam.datasets.numbered_frames import (
    NO_STAMPS,
    RATE_HZ,
    at_rate,
    numbered_camera,
    numbered_files,
    poses_of_files,
    with_own_calibration,
)
from slam.datasets.recording import Contents, Recording

DEPTH_STEPS_PER_M = 1000.0
_LENSES = ("intrinsic/intrinsic_%s.txt", "intrinsic_%s.txt", "intrinsics_%s.txt")


def looks_like_scannet(path: Path, head: bytes) -> bool:
    """Whether a path is a folder of images with the lens of its depth camera."""
    return _lens_file(path, "depth") is not None and (path / "depth").is_dir() and (path / "color").is_dir()


def open_scannet(path: Path, strict: bool) -> Recording:
    """A folder of one scene; frame N is N / 30 s old, colour is drawn as the depth camera's lens sees it."""

    def load(account: Account) -> Contents:
        account.report.note(NO_STAMPS.format(rate=RATE_HZ), 1)
        colors = numbered_files(path / "color", r"(?:frame-)?(\d{1,9})(?:\.color)?\.(?:jpe?g|png)")
        depths = numbered_files(path / "depth", r"(?:frame-)?(\d{1,9})(?:\.depth)?\.png")
        camera = numbered_camera(colors, depths, _calibration(path), account, at_rate())
        return Contents([camera])

    poses = numbered_files(path / "pose", r"(?:frame-)?(\d{1,9})(?:\.pose)?\.txt")
    return Recording(path, load, lambda account: poses_of_files(poses, at_rate(), account), strict=strict)


def _calibration(path: Path) -> Calibration:
    """Both lenses; the places of the two cameras are published as one."""
    depth, color = _lens_file(path, "depth"), _lens_file(path, "color")
    assert depth is not None
    lens = plain_lens(camera_matrix(color, 4)) if color else None
    return with_own_calibration(
        path, Calibration(camera_matrix(depth, 4), DEPTH_STEPS_PER_M, color_lens=lens)
    )


def _lens_file(path: Path, kind: str) -> Path | None:
    """The file of a camera's matrix."""
    return next((path / (name % kind) for name in _LENSES if (path / (name % kind)).is_file()), None)


FORMAT = DatasetFormat("ScanNet scene, extracted", looks_like_scannet, open_scannet)
