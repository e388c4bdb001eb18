"""A recorded session (Robot@Home) for the reproduction: without ground truth, so only grades and repairs."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import gtsam
import numpy as np
from xu2024_drive import DriveResult, pair_pictures
from xu2024_rows import register_rows
from xu2024_score import Tally

import fusion
from slam.datasets import open_dataset
from slam.datasets.frame_pairs import nearest_partners
from slam.measurements import LaserScan, RgbdFrame

TOLERANCE_S = 0.1


def run_recorded(folder: Path, most: int) -> DriveResult:
    """Register and repair the pairs of a session; every scan that has an image of all cameras near in time.

    Raises
    ------
    DatasetError
        The folder cannot be read, or holds no pair.
    """
    scans: list[LaserScan] = []
    stamps: dict[str, list[float]] = {}
    for record in open_dataset(folder):
        if isinstance(record, LaserScan):
            scans.append(record)
        elif isinstance(record, RgbdFrame):
            stamps.setdefault(record.sensor, []).append(record.stamp_s)
    result = DriveResult("robot_at_home", 0, Tally(), {"rows": Counter(), "heights": Counter()})
    wanted = _wanted(scans, stamps, most)
    rig, kept = fusion.Rig(), []
    for scan, images in _load(folder, wanted):
        ours = fusion.register(scan, images)
        rows = register_rows(scan, images)
        result.tally.add("high", [ours.grade == fusion.Grade.HIGH])
        for name, at in (("rows", rows), ("heights", ours)):
            result.grades[name][(folder.name, at.grade.name)] += 1
        rig.add(ours)
        kept.append((scan, images, ours))
    estimate = rig.estimate()
    result.pairs = len(kept)
    if estimate is not None:
        scan, images, ours = max(kept, key=lambda pair: pair[2].confidence)
        result.pictures = pair_pictures(scan, images, ours, fusion.denoise(scan, images, estimate))
    return result


def _wanted(
    scans: list[LaserScan], stamps: dict[str, list[float]], most: int
) -> list[tuple[LaserScan, dict[str, float]]]:
    """Evenly spread scans, each with the stamp of every camera's nearest image."""
    found = []
    times = np.array([scan.stamp_s for scan in scans])
    nearest: list[dict[str, float]] = [{} for _ in scans]
    for sensor, own in stamps.items():
        for i, j in enumerate(nearest_partners(times, np.array(own), TOLERANCE_S)):
            if j >= 0:
                nearest[i][sensor] = own[j]
    for scan, images in zip(scans, nearest, strict=True):
        if images and len(images) == len(stamps):
            found.append((scan, images))
    chosen = np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int))
    return [found[index] for index in chosen]


def _load(
    folder: Path, wanted: list[tuple[LaserScan, dict[str, float]]]
) -> list[tuple[fusion.LidarCurve, list[fusion.DepthImage]]]:
    """The images of the chosen scans, read in one more pass."""
    needed = {(sensor, stamp) for _, images in wanted for sensor, stamp in images.items()}
    held = {
        (record.sensor, record.stamp_s): _depth_image(record)
        for record in open_dataset(folder)
        if isinstance(record, RgbdFrame) and (record.sensor, record.stamp_s) in needed
    }
    return [
        (
            fusion.LidarCurve(scan.ranges_m, scan.start_angle_rad, scan.step_rad, scan.range_max_m),
            [held[key] for key in sorted(images.items())],
        )
        for scan, images in wanted
    ]


def _depth_image(frame: RgbdFrame) -> fusion.DepthImage:
    """The depth of a frame, levelled by its mounting if the log contains it."""
    camera = frame.intrinsics
    mount = frame.T_base_camera or gtsam.Pose3(
        gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])), np.zeros(3)
    )
    return fusion.DepthImage(
        frame.depth_m,
        fusion.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        mount.rotation().matrix(),
    )
