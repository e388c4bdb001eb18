"""A rig with few beams and pixels, and sensors without ray casting: for the tests of driving and writing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from slam.measurements import CameraIntrinsics
from slam.simulation import drive
from slam.simulation.rigs import RIGS, Rig
from slam.simulation.sensors import SimulatedImage, SimulatedScan

INTRINSICS = CameraIntrinsics(25.0, 25.0, 15.5, 11.5, 32, 24)
SECONDS = 6.0


def small_rig(cameras: int = 2) -> Rig:
    """The four-camera rig with fewer cameras and tiny images."""
    rig = RIGS["xu2024"]
    small = tuple(
        replace(camera, model=replace(camera.model, intrinsics=INTRINSICS))
        for camera in rig.cameras[:cameras]
    )
    return replace(rig, cameras=small)


def fake_sensors(patch: pytest.MonkeyPatch) -> None:
    """Make sensors answer from their pose, the person and their random numbers alone."""
    patch.setattr(drive, "Scene", lambda home: None)
    patch.setattr(drive, "scan_lidar", _scan)
    patch.setattr(drive, "render_rgbd", _image)


def _scan(scene: None, pose: gtsam.Pose3, model: Any, rng: np.random.Generator, person: Any) -> SimulatedScan:
    """Ranges that reveal where the laser was."""
    count = model.beams
    true = np.full(count, 1.0 + abs(pose.x()), dtype=np.float32)
    ranges = np.clip(true + rng.normal(0.0, 0.01, count), 0.1, model.range_max_m - 0.1).astype(np.float32)
    fault = (rng.random(count) < 0.05).astype(np.uint8)
    ranges[fault > 0] = np.nan
    ranges[:3] = np.inf
    if person is not None:
        ranges[10] = 0.5
    return SimulatedScan(ranges, true, fault)


def _image(
    scene: None, pose: gtsam.Pose3, model: Any, rng: np.random.Generator, person: Any
) -> SimulatedImage:
    """Images that reveal where the camera was."""
    shape = (model.intrinsics.height, model.intrinsics.width)
    color = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    true = np.full(shape, 1.0 + 0.1 * abs(pose.x()), dtype=np.float32)
    fault = (rng.random(shape) < 0.1).astype(np.uint8)
    return SimulatedImage(color, np.where(fault, 0.0, true).astype(np.float32), true, fault)
