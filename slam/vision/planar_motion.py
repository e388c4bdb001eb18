"""Convert a 3D camera motion to the motion of a robot on a floor."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from fusion.estimation import gate
from slam.measurements import IN_PLANE, FloatArray

# Motion out of the plane that is no error: floors are uneven and robots sway.
_SWAY = 0.01  # radians and metres


@dataclass(frozen=True, slots=True)
class PlanarMotion:
    """Planar motion of a robot's base.

    Attributes
    ----------
    motion, covariance
        (3,) x, y, yaw and (3, 3), in the plane.
    excess
        Mean square of roll, pitch and height change in standard deviations: about 1 for a robot.
    """

    motion: FloatArray
    covariance: FloatArray
    excess: float

    @property
    def leaves_the_floor(self) -> bool:
        """Return whether the motion out of the plane exceeds its covariance."""
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
    T_base_camera_before
        Mounting before the motion, if different.
    """
    before = T_base_camera if T_base_camera_before is None else T_base_camera_before
    motion = before.compose(T_camera_camera).compose(T_base_camera.inverse())
    adjoint = T_base_camera.AdjointMap()
    of_base = adjoint @ covariance @ adjoint.T
    roll, pitch, yaw = motion.rotation().roll(), motion.rotation().pitch(), motion.rotation().yaw()
    out_of_plane = [0, 1, 5]  # roll, pitch, z in GTSAM's order of a Pose3
    outside = np.array([roll, pitch, motion.z()])
    spread = of_base[np.ix_(out_of_plane, out_of_plane)] + _SWAY**2 * np.eye(3)
    excess = float(outside @ np.linalg.solve(spread, outside)) / 3.0
    in_plane = np.array([motion.x(), motion.y(), yaw])
    return PlanarMotion(in_plane, of_base[np.ix_(IN_PLANE, IN_PLANE)], excess)
