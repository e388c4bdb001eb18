"""What is concluded from measurements: frozen records, frames, stamps and units as theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.showing import drawn, one_line, with_pictures
from slam.measurements import FloatArray, Pose


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """A measured motion between two base frames, with its own trust.

    Attributes
    ----------
    T_reference_base
        Pose of the current base frame in the reference frame, Pose2 or Pose3.
    covariance
        (d, d) covariance in GTSAM's tangent order of the current frame: Pose2 (x, y, theta).
        A degenerate direction is already inflated.
    inlier_share
        Share of the used readings that agree with the result, 0..1.
    fit
        Mean robust weight of the used readings, 0..1: falls with every millimetre.
    residual_m
        Robust standard deviation of the agreeing readings.
    converged
        Whether the iteration settled; of a cloud, also where as many of its points fit as usual.
    degenerate
        Whether a direction of motion is not determined by the readings (a corridor).
    weak_direction
        (d,) unit tangent vector of the undetermined direction; zero where all are determined.

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
        (N, 3) of the base frame in the map frame.
    quaternions_xyzw
        (N, 4), unit length.

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
        count = len(stamps_s)
        positions = np.zeros((count, 3))
        positions[:, :2] = poses_xyt[:, :2]
        quaternions = np.zeros((count, 4))
        quaternions[:, 2] = np.sin(0.5 * poses_xyt[:, 2])
        quaternions[:, 3] = np.cos(0.5 * poses_xyt[:, 2])
        return cls(np.asarray(stamps_s, dtype=np.float64), positions, quaternions)

    def poses(self) -> list[gtsam.Pose3]:
        """The N poses.

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
        """(N, 3) rows of x, y, yaw: the projection onto the ground plane.

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
    """The poses of several trajectories, one at least, in their order."""
    columns = zip(*((one.stamps_s, one.positions_m, one.quaternions_xyzw) for one in parts), strict=True)
    return Trajectory(*map(np.concatenate, columns))
