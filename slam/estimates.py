"""Results estimated from measurements: frozen records with the same frames, stamps and units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.showing import drawn, one_line, with_pictures
from slam.errors import ScanweaveError
from slam.measurements import FloatArray, Pose, numbers_of

# Public ground truths have four decimals in each component; what is farther from unit length is no rotation.
NORM_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """A measured motion between two base frames, with its uncertainty.

    Attributes
    ----------
    T_reference_base
        Pose of the current base frame in the reference frame, Pose2 or Pose3.
    covariance
        (d, d) covariance in GTSAM's tangent order of the current frame: Pose2 (x, y, theta).
        It is already inflated in a degenerate direction.
    inlier_share
        Share of the used readings that are inliers, 0..1.
    fit
        Mean robust weight of the used readings, 0..1; it decreases with every millimetre of error.
    residual_m
        Robust standard deviation of the residuals of the inliers.
    converged
        Whether the iteration converged; for a cloud also True if as many points fit as usual.
    degenerate
        Whether the readings leave a direction of motion undetermined (a corridor).
    weak_direction
        (d,) unit tangent vector of the undetermined direction; zero if all directions are determined.

    Examples
    --------
    >>> import numpy as np, slam
    >>> bearings = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    >>> ranges_m = np.minimum(3.0 / np.abs(np.cos(bearings)), 2.0 / np.abs(np.sin(bearings) + 1e-9))
    >>> points = ranges_m[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])  # a room
    >>> motion = slam.match_scans(points, points)
    >>> motion.converged, motion.degenerate, bool(np.sqrt(motion.covariance[0, 0]) < 0.02)  # metres
    (True, False, True)
    """

    T_reference_base: Pose
    covariance: FloatArray
    inlier_share: float
    fit: float
    residual_m: float
    converged: bool
    degenerate: bool
    weak_direction: FloatArray

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time, in the order of the log (which need not be the order of the stamps).

    Attributes
    ----------
    stamps_s
        (N,) seconds.
    positions_m
        (N, 3) positions of the base frame in the map frame.
    quaternions_xyzw
        (N, 4), unit length.

    Raises
    ------
    ScanweaveError
        If the arrays have other shapes, a number is not finite, or a quaternion is not of unit length.

    Examples
    --------
    >>> import numpy as np, slam
    >>> rows = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1.57]])  # x, y, yaw
    >>> way = slam.Trajectory.from_planar(np.array([0.0, 0.5, 1.0]), rows)
    >>> len(way), way.positions_m[-1].tolist(), way[1:].stamps_s.tolist()
    (3, [1.0, 1.0, 0.0], [0.5, 1.0])
    """

    stamps_s: FloatArray
    positions_m: FloatArray
    quaternions_xyzw: FloatArray

    def __post_init__(self) -> None:
        length = np.shape(self.stamps_s)[:1] or (None,)
        for name, shape in (("stamps_s", ()), ("positions_m", (3,)), ("quaternions_xyzw", (4,))):
            object.__setattr__(self, name, numbers_of(getattr(self, name), (*length, *shape), name))
        off = np.abs(np.linalg.norm(self.quaternions_xyzw, axis=1) - 1.0) > NORM_TOLERANCE
        if off.any():
            raise ScanweaveError(f"quaternion {off.argmax()} is not of unit length (order x, y, z, w)")

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, drawn(blue=self.positions_m[:, :2]))

    def __len__(self) -> int:
        return int(self.stamps_s.size)

    def __getitem__(self, chosen: slice | NDArray[Any]) -> Trajectory:
        return Trajectory(self.stamps_s[chosen], self.positions_m[chosen], self.quaternions_xyzw[chosen])

    @classmethod
    def from_planar(cls, stamps_s: FloatArray, poses_xyt: FloatArray) -> Trajectory:
        """Lift (N, 3) rows of x, y, yaw into the plane z = 0.

        Examples
        --------
        >>> import numpy as np, slam
        >>> rows = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, np.pi]])
        >>> way = slam.Trajectory.from_planar(np.array([0.0, 1.0]), rows)
        >>> way.quaternions_xyzw[1].round(3).tolist()  # half a turn about z
        [0.0, 0.0, 1.0, 0.0]
        """
        poses_xyt = numbers_of(poses_xyt, (None, 3), "poses_xyt")
        count = len(poses_xyt)
        positions = np.zeros((count, 3))
        positions[:, :2] = poses_xyt[:, :2]
        quaternions = np.zeros((count, 4))
        quaternions[:, 2] = np.sin(0.5 * poses_xyt[:, 2])
        quaternions[:, 3] = np.cos(0.5 * poses_xyt[:, 2])
        return cls(stamps_s, positions, quaternions)

    def poses(self) -> list[gtsam.Pose3]:
        """Return the N poses.

        Examples
        --------
        >>> import numpy as np, slam
        >>> way = slam.Trajectory.from_planar(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [2.0, 1.0, 0.5]]))
        >>> first, last = way.poses()
        >>> round(first.between(last).x(), 3)
        2.0
        """
        return [
            gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), position)
            for (x, y, z, w), position in zip(self.quaternions_xyzw.tolist(), self.positions_m, strict=True)
        ]

    def to_planar(self) -> FloatArray:
        """Project onto the ground plane: (N, 3) rows of x, y, yaw.

        Examples
        --------
        >>> import numpy as np, slam
        >>> rows = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.5]])
        >>> slam.Trajectory.from_planar(np.array([0.0, 1.0]), rows).to_planar().round(3).tolist()
        [[0.0, 0.0, 0.0], [2.0, 1.0, 0.5]]
        """
        x, y, z, w = self.quaternions_xyzw.T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return np.column_stack([self.positions_m[:, :2], yaw])


def one_after_another(parts: Sequence[Trajectory]) -> Trajectory:
    """Concatenate the poses of one or more trajectories."""
    columns = zip(*((one.stamps_s, one.positions_m, one.quaternions_xyzw) for one in parts), strict=True)
    return Trajectory(*map(np.concatenate, columns))
