"""Gravity direction as factors of the pose graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from slam.matching.upright import Gravity, upright_of
from slam.measurements import FloatArray, Pose, spatial


def upright_poses(poses: Sequence[Pose], down: dict[int, Gravity]) -> list[gtsam.Pose3]:
    """All poses of a map, turned as one so that gravity at its nodes points down on average."""
    seen = [spatial(poses[key]).rotation().rotate(one.down) / one.sigma_rad**2 for key, one in down.items()]
    mean = np.sum(seen, axis=0)
    turn = gtsam.Pose3(upright_of(mean / np.linalg.norm(mean)), np.zeros(3))
    return [turn.compose(spatial(pose)) for pose in poses]


def gravity_factors(down: dict[int, Gravity]) -> Iterator[gtsam.NonlinearFactor]:
    """One for each node at which gravity is known."""
    for key, one in down.items():
        noise = gtsam.noiseModel.Isotropic.Sigma(2, one.sigma_rad)
        yield gtsam.AttitudeFactorPose3(key, gtsam.Unit3(0.0, 0.0, -1.0), noise, gtsam.Unit3(one.down))


def heading_alone(origin: Pose, held: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a node whose roll and pitch gravity tells: a radian on what holds it else."""
    upright = np.asarray(spatial(origin).rotation().matrix())[2]
    covariance = held.copy()
    covariance[:3, :3] += np.eye(3) - np.outer(upright, upright)
    return covariance
