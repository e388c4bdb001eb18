"""Arithmetic on many rigid motions at once, in 2D or 3D, for trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from slam.estimates import Trajectory
from slam.measurements import FloatArray, Pose, spatial


@dataclass(frozen=True, slots=True)
class Poses:
    """N poses; planar ones are in the plane.

    Attributes
    ----------
    positions_m
        (N, 3) positions.
    rotations
        N rotations.
    """

    positions_m: FloatArray
    rotations: scipy.spatial.transform.Rotation

    def __len__(self) -> int:
        return len(self.positions_m)

    def __getitem__(self, chosen: slice | NDArray[Any]) -> Poses:
        return Poses(self.positions_m[chosen], self.rotations[chosen])

    @classmethod
    def planar(cls, rows: FloatArray) -> Poses:
        """Create poses from (N, 3) rows of x, y, yaw."""
        positions, turns = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
        positions[:, :2], turns[:, 2] = rows[:, :2], rows[:, 2]
        return cls(positions, scipy.spatial.transform.Rotation.from_rotvec(turns))

    @classmethod
    def of(cls, poses: Sequence[Pose]) -> Poses:
        """Create poses from at least one pose of GTSAM."""
        matrices = np.array([spatial(pose).matrix() for pose in poses])
        return cls(matrices[:, :3, 3], scipy.spatial.transform.Rotation.from_matrix(matrices[:, :3, :3]))

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> Poses:
        """Create poses from a trajectory."""
        return cls(
            trajectory.positions_m, scipy.spatial.transform.Rotation.from_quat(trajectory.quaternions_xyzw)
        )

    def compose(self, other: Poses) -> Poses:
        """Return ``self * other``, pose by pose."""
        placed = self.positions_m + self.rotations.apply(other.positions_m)
        return Poses(placed, self.rotations * other.rotations)

    def between(self, other: Poses) -> Poses:
        """Return ``inverse(self) * other``, pose by pose."""
        back = self.rotations.inv()
        return Poses(back.apply(other.positions_m - self.positions_m), back * other.rotations)

    def offsets(self) -> FloatArray:
        """Return (N, 6) positions and rotation vectors."""
        return np.hstack([self.positions_m, self.rotations.as_rotvec()])

    def moved(self, offsets: FloatArray) -> Poses:
        """Add (N, 6) to each: to the position, and as a rotation vector, both in the fixed frame."""
        turned = scipy.spatial.transform.Rotation.from_rotvec(offsets[:, 3:]) * self.rotations
        return Poses(self.positions_m + offsets[:, :3], turned)

    def where(self, chosen: NDArray[np.bool_], other: Poses) -> Poses:
        """Return these poses where ``chosen`` (N,), else the other ones."""
        quaternions = np.where(chosen[:, None], self.rotations.as_quat(), other.rotations.as_quat())
        positions = np.where(chosen[:, None], self.positions_m, other.positions_m)
        return Poses(positions, scipy.spatial.transform.Rotation.from_quat(quaternions))

    def trajectory(self, stamps_s: FloatArray) -> Trajectory:
        """Return the trajectory with (N,) stamps."""
        return Trajectory(stamps_s, self.positions_m, self.rotations.as_quat(canonical=True))
