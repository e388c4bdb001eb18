"""How a camera's poses and motions become those of the body that is localised: on a floor, or in space."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import gtsam

from slam.measurements import FloatArray, Pose, pose2_from_row
from slam.vision.planar_motion import planar_motion


class Measured(NamedTuple):
    """A pose or a motion with its covariance (d, d), GTSAM's order, in the frame after it."""

    pose: Pose
    covariance: FloatArray


def composed(T_a_b: Pose, T_b_c: Pose) -> Pose:
    """``T_a_c``; both in the plane, or both in space."""
    if isinstance(T_a_b, gtsam.Pose2) and isinstance(T_b_c, gtsam.Pose2):
        return T_a_b.compose(T_b_c)
    assert isinstance(T_a_b, gtsam.Pose3) and isinstance(T_b_c, gtsam.Pose3)
    return T_a_b.compose(T_b_c)


class Body(Protocol):
    """What is localised."""

    def of_camera(self, T_map_camera: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """The body where its camera stands; None where it cannot be there."""
        ...

    def of_step(self, T_camera_camera: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """Its motion by its camera's; None where it cannot move so."""
        ...

    def camera_of(self, pose: Pose) -> gtsam.Pose3:
        """``T_map_camera`` where the body stands at a pose."""
        ...


class PlanarBody:
    """A robot on a floor.

    Parameters
    ----------
    T_base_camera
        Mounting of the camera.
    greatest_excess
        Mean square, in sigmas, up to which a camera may leave the floor.
    """

    def __init__(self, T_base_camera: gtsam.Pose3, greatest_excess: float) -> None:
        self._T_base_camera = T_base_camera
        self._greatest_excess = greatest_excess

    def of_camera(self, T_map_camera: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """See `Body`."""
        return self._planar(T_map_camera, covariance, gtsam.Pose3())

    def of_step(self, T_camera_camera: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """See `Body`."""
        return self._planar(T_camera_camera, covariance, self._T_base_camera)

    def camera_of(self, pose: Pose) -> gtsam.Pose3:
        """See `Body`."""
        assert isinstance(pose, gtsam.Pose2)
        return gtsam.Pose3(pose).compose(self._T_base_camera)

    def _planar(
        self, motion: gtsam.Pose3, covariance: FloatArray, T_before_camera: gtsam.Pose3
    ) -> Measured | None:
        """Projected to the floor, unless it leaves it."""
        planar = planar_motion(motion, covariance, self._T_base_camera, T_before_camera)
        if planar.excess > self._greatest_excess:
            return None
        return Measured(pose2_from_row(planar.motion), planar.covariance)


class SpatialBody:
    """A camera in the hand.

    Parameters
    ----------
    T_base_camera
        Mounting of the camera; the identity where the camera is its own base.
    """

    def __init__(self, T_base_camera: gtsam.Pose3) -> None:
        self._T_base_camera = T_base_camera

    def of_camera(self, T_map_camera: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """See `Body`."""
        return Measured(T_map_camera.compose(self._T_base_camera.inverse()), self._of_base(covariance))

    def of_step(self, T_camera_camera: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """See `Body`."""
        moved = self._T_base_camera.compose(T_camera_camera).compose(self._T_base_camera.inverse())
        return Measured(moved, self._of_base(covariance))

    def camera_of(self, pose: Pose) -> gtsam.Pose3:
        """See `Body`."""
        assert isinstance(pose, gtsam.Pose3)
        return pose.compose(self._T_base_camera)

    def _of_base(self, covariance: FloatArray) -> FloatArray:
        """A covariance of the camera as one of the base."""
        adjoint = self._T_base_camera.AdjointMap()
        seen: FloatArray = adjoint @ covariance @ adjoint.T
        return seen
