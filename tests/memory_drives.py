"""Drives of a robot in memory: what wheels and lidar say is chosen scan by scan, and the truth is known."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from flat_worlds import sweep
from numpy.typing import ArrayLike

from slam.app.mapping import Measured
from slam.config import load_config
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, LaserScan, Measurement, WheelOdometry, pose2_from_row
from slam.odometry import STANDARD, Odometries

SCAN_S = 0.1
START_S = 100.0


def way(start: ArrayLike, steps: Sequence[ArrayLike]) -> FloatArray:
    """(N + 1, 3) poses from a start (3,) and steps (3,) in the robot's own frame."""
    poses = [np.asarray(start, dtype=np.float64)]
    for step in steps:
        poses.append(compose(poses[-1], np.asarray(step, dtype=np.float64)))
    return np.array(poses)


def steps_of(poses: FloatArray) -> FloatArray:
    """(N - 1, 3) steps between poses."""
    return np.array([between(*pair) for pair in itertools.pairwise(poses)])


def stamp_s(scan: int) -> float:
    """When a scan was taken."""
    return START_S + SCAN_S * scan


def wheels_at(scan: int, pose: FloatArray) -> WheelOdometry:
    """What the wheels say at the stamp of a scan."""
    return WheelOdometry(stamp_s(scan), pose2_from_row(pose))


def scans_along(
    truth: FloatArray, worlds: Sequence[FloatArray], *, fov_rad: float = np.pi, beams: int = 181
) -> list[LaserScan]:
    """A sweep with 1 cm of noise from every pose, each in its own world of segments."""
    rng = np.random.default_rng(0)
    return [
        sweep(world, pose, beams=beams, fov_rad=fov_rad, sigma_m=0.01, seed=rng, stamp_s=stamp_s(n))
        for n, (pose, world) in enumerate(zip(truth, worlds, strict=True))
    ]


def mapped_drive(
    scans: Sequence[LaserScan],
    wheels: FloatArray | None,
    *overrides: str,
    odometries: Odometries = STANDARD,
) -> MapResult:
    """The map of scans and of the wheels' poses (N, 3) at their stamps."""
    measurements: list[Measurement] = []
    for n, scan in enumerate(scans):
        if wheels is not None:
            measurements.append(wheels_at(n, wheels[n]))
        measurements.append(scan)
    return mapped(measurements, *overrides, odometries=odometries)


def mapped(measurements: list[Measurement], *overrides: str, odometries: Odometries = STANDARD) -> MapResult:
    """The map of measurements in their order."""
    config = load_config(None, ["dense_map.enabled=false", *overrides])
    return build_map(Measured(measurements), config, odometries=odometries)


def errors(result: MapResult, truth: FloatArray) -> FloatArray:
    """(R, 2) metres and radians by which every reading's pose is off, both seen from the first."""
    poses = result.map.trajectory.to_planar()
    at = np.rint((result.map.trajectory.stamps_s - START_S) / SCAN_S).astype(int)
    off = np.array(
        [
            between(between(truth[at[0]], truth[n]), between(poses[0], pose))
            for n, pose in zip(at, poses, strict=True)
        ]
    )
    return np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])])


def worst_m(result: MapResult, truth: FloatArray) -> float:
    """Greatest distance of a reading's pose from its truth."""
    return float(errors(result, truth)[:, 0].max())
