"""Write frames in layouts with all frames in one folder; see `tools/pack_layouts.py`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from slam.measurements import CameraIntrinsics
from tools.pack_layouts import Footage, matrix, numbers, put, rows


def _frames(folder: Path, footage: Footage, color: str, depth: str) -> Path:
    """``frame-000000.color``, ``.depth`` and ``.pose.txt``."""
    for number, pose in enumerate(footage.poses):
        name = f"frame-{number:06d}"
        put(folder / f"{name}.color.{color}", footage.colors[number])
        put(folder / f"{name}.depth.{depth}", footage.depths_mm[number])
        put(folder / f"{name}.pose.txt", rows(pose))
    return folder


def seven_scenes(folder: Path, footage: Footage) -> Path:
    """7-Scenes; our own file has the lens, since theirs is that of a Kinect."""
    put(folder / "seq-01" / "camera-intrinsics.txt", rows(matrix(footage.lens)))
    return _frames(folder / "seq-01", footage, "png", "png")


def three_r_scan(folder: Path, footage: Footage, color_lens: CameraIntrinsics | None = None) -> Path:
    """3RScan, and what ScanNet's SensReader extracts: PGM, and both lenses in one file."""
    lens = footage.lens
    place = folder / "0a4b8ef6-a83a-21f2-8672-dce34dd0d7ca" / "sequence"
    lenses = {"Color": color_lens or lens, "Depth": lens}
    lines = ["m_versionNumber = 4", "m_sensorName = tango", "m_depthShift = 1000"]
    for kind, one in lenses.items():
        lines += [f"m_{kind.lower()}Width = {one.width}", f"m_{kind.lower()}Height = {one.height}"]
        lines.append(f"m_calibration{kind}Intrinsic = {numbers(matrix(one, 4))}")
        lines.append(f"m_calibration{kind}Extrinsic = {numbers(np.eye(4))}")
    put(place / "_info.txt", "\n".join([*lines, f"m_frames.size = {len(footage.poses)}"]) + "\n")
    return _frames(place, footage, "jpg", "pgm")


def washington(folder: Path, footage: Footage) -> Path:
    """RGB-D Scenes v2: tenths of millimetres, no poses beside the images; our own file has the lens."""
    put(folder / "scene_01" / "camera-intrinsics.txt", rows(matrix(footage.lens)))
    for number, (color, depth) in enumerate(zip(footage.colors, footage.depths_mm, strict=True)):
        put(folder / "scene_01" / f"{number:05d}-color.png", color)
        tenths = np.minimum(10 * depth.astype(np.uint32), 65535).astype(np.uint16)
        put(folder / "scene_01" / f"{number:05d}-depth.png", tenths)
    return folder / "scene_01"


SCENES: dict[str, Callable[[Path, Footage], Path]] = {
    "seven_scenes": seven_scenes,
    "three_r_scan": three_r_scan,
    "washington": washington,
}
