"""A camera's motion in space as the motion of a robot on a floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from fusion.estimation import gate
from slam.measurements import IN_PLANE, FloatArray

# What two cameras differ by though both are right, x, y, yaw: their clocks and mountings.
_SLACK = np.array([0.01, 0.01, 0.005])


@dataclass(frozen=True, slots=True)
class PlanarMotion:
    """Motion of a robot's base on its floor.

    Attributes
    ----------
    motion
        (3,) x, y, yaw.
    covariance
        (3, 3), inflated where the motion leaves the plane by more than its covariance allows.
    excess
        Mean square of roll, pitch and height change in their standard deviations: about 1 for a robot.
    """

    motion: FloatArray
    covariance: FloatArray
    excess: float

    @property
    def leaves_the_floor(self) -> bool:
        """Whether even the inflated covariance does not explain the motion."""
        return self.excess > gate(3)


def planar_motion(
    T_camera_camera: gtsam.Pose3,
    covariance: FloatArray,
    T_base_camera: gtsam.Pose3,
    T_base_camera_before: gtsam.Pose3 | None = None,
) -> PlanarMotion:
    """Project a camera's motion to its robot's plane.

    Parameters
    ----------
    T_camera_camera
        Pose of the camera after the motion in its frame before it.
    covariance
        (6, 6) of it, GTSAM's order, in the frame after the motion.
    T_base_camera
        Mounting.
    T_base_camera_before
        Where the camera was seen from the base before the motion, if elsewhere.
    """
    before = T_base_camera if T_base_camera_before is None else T_base_camera_before
    motion = before.compose(T_camera_camera).compose(T_base_camera.inverse())
    adjoint = T_base_camera.AdjointMap()
    of_base = adjoint @ covariance @ adjoint.T
    roll, pitch, yaw = motion.rotation().roll(), motion.rotation().pitch(), motion.rotation().yaw()
    out_of_plane = [0, 1, 5]  # roll, pitch, z in GTSAM's order of a Pose3
    outside = np.array([roll, pitch, motion.z()])
    # A floor is not flat and a robot sways: so much, too, leaves the plane without being an error.
    spread = of_base[np.ix_(out_of_plane, out_of_plane)] + _SLACK[0] ** 2 * np.eye(3)
    excess = float(outside @ np.linalg.solve(spread, outside)) / 3.0
    inflation = max(1.0, 0.5 * excess)
    return PlanarMotion(
        motion=np.array([motion.x(), motion.y(), yaw]),
        covariance=of_base[np.ix_(IN_PLANE, IN_PLANE)] * inflation,
        excess=excess,
    )


@dataclass(frozen=True, slots=True)
class WitnessedMotion:
    """Motion that some cameras tell together.

    Attributes
    ----------
    motion, covariance
        (3,) x, y, yaw and (3, 3).
    witnesses
        Cameras that tell it.
    """

    motion: FloatArray
    covariance: FloatArray
    witnesses: int


def agreed_motion(motions: Sequence[PlanarMotion]) -> WitnessedMotion | None:
    """The motion that most cameras tell, the surest of them where they are as many; None without any.

    Its covariance is that of the surest: cameras on one robot share their errors of time and mounting.
    """
    if not motions:
        return None
    support = [[_squares(one, other) <= gate(3) for other in motions] for one in motions]
    counts = np.sum(support, axis=1)
    variances = [float(np.trace(motion.covariance)) for motion in motions]
    best = min(range(len(motions)), key=lambda n: (-counts[n], variances[n]))
    return WitnessedMotion(motions[best].motion, motions[best].covariance, int(counts[best]))


def _squares(one: PlanarMotion, other: PlanarMotion) -> float:
    """Squared distance of two motions in their common standard deviations."""
    offset = one.motion - other.motion
    offset[2] = np.remainder(offset[2] + np.pi, 2.0 * np.pi) - np.pi
    spread = one.covariance + other.covariance + np.diag(_SLACK**2)
    return float(offset @ np.linalg.solve(spread, offset))
