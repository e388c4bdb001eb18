"""Gravity direction as factors of the pose graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from slam.matching.upright import Gravity, upright_of
from slam.measurements import FloatArray, Pose, spatial


def upright_poses(poses: Sequence[Pose], down: dict[int, Gravity]) -> list[gtsam.Pose3]:
    """Rotate all poses of a map together so that gravity at the nodes points down on average."""
    downs = [spatial(poses[key]).rotation().rotate(one.down) / one.sigma_rad**2 for key, one in down.items()]
    mean = np.sum(downs, axis=0)
    turn = gtsam.Pose3(upright_of(mean / np.linalg.norm(mean)), np.zeros(3))
    return [turn.compose(spatial(pose)) for pose in poses]


def gravity_factors(down: dict[int, Gravity]) -> Iterator[gtsam.NonlinearFactor]:
    """Return one factor for each node with known gravity."""
    for key, one in down.items():
        noise = gtsam.noiseModel.Isotropic.Sigma(2, one.sigma_rad)
        yield gtsam.AttitudeFactorPose3(key, gtsam.Unit3(0.0, 0.0, -1.0), noise, gtsam.Unit3(one.down))


def heading_alone(origin: Pose, held: FloatArray) -> FloatArray:
    """Return (6, 6) the prior of a node whose roll and pitch gravity measures: there 1 rad is added."""
    upright = np.asarray(spatial(origin).rotation().matrix())[2]
    covariance = held.copy()
    covariance[:3, :3] += np.eye(3) - np.outer(upright, upright)
    return covariance
