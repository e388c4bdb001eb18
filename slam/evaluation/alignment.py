"""Associate poses by their stamps, and align a trajectory with its reference, in 3D or in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import spatial

from fusion.estimation import TINY
from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.measurements import FloatArray

# Share of the largest spread: a smaller one is rounding, and the points are on a line.
_OPEN_SHARE = 1e-12
# Length of the mean up axis of an upright robot: it tilts by 18 degrees on average.
_UPRIGHT = 0.95


@dataclass(frozen=True, slots=True)
class Alignment:
    """The result of an alignment.

    Attributes
    ----------
    T_target_point
        (4, 4) transform applied to the points.
    name
        ``se2`` or ``se3``.
    mirrored
        A message if a mirror image would fit far better; None otherwise.
    """

    T_target_point: FloatArray
    name: str
    mirrored: str | None = None


def align(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """Align N poses with their ground truth.

    In the plane if the estimate never leaves it and the true robot stays upright: the true up axis shows
    which side of the floor is seen.

    Raises
    ------
    EvaluationError
        If the poses do not determine the alignment.

    Examples
    --------
    >>> import numpy as np, slam
    >>> from slam.evaluation.alignment import align
    >>> at_s = np.arange(3.0)
    >>> truth = slam.Trajectory.from_planar(at_s, np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]))
    >>> moved = slam.Trajectory.from_planar(at_s, np.array([[2.0, 0, 0], [3, 0, 0], [3, 1, 0]]))
    >>> found = align(moved, truth)
    >>> found.name, (found.T_target_point[:3, 3].round(6) + 0.0).tolist()
    ('se2', [-2.0, 0.0, 0.0])
    """
    level = _level(truth) if _in_plane(estimate) else None
    if level is None:
        return Alignment(umeyama(estimate.positions_m, truth.positions_m), "se3")
    points, targets = estimate.positions_m, level.apply(truth.positions_m)
    centred, centred_targets = points - points.mean(axis=0), targets - targets.mean(axis=0)
    if not (np.abs(centred[:, :2]).max() > TINY and np.abs(centred_targets[:, :2]).max() > TINY):
        raise EvaluationError(f"{len(points)} associated poses in one place leave the alignment open")
    turn, rmse_m = _turned(centred, centred_targets)
    _, mirrored_m = _turned(centred * [1.0, -1.0, 1.0], centred_targets)
    rotation = level.inv() * spatial.transform.Rotation.from_rotvec([0.0, 0.0, turn])
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = truth.positions_m.mean(axis=0) - rotation.apply(points.mean(axis=0))
    if not 2 * mirrored_m < rmse_m:
        return Alignment(T, "se2")
    why = "a lidar mounted upside down, or an inverted axis or sign"
    return Alignment(T, "se2", f"its mirror image fits, to {mirrored_m:.4f} m (RMSE): {why}")


def umeyama(points: FloatArray, targets: FloatArray) -> FloatArray:
    """Return the rigid transform (4, 4) that best aligns (N, 3) points with their targets in least squares.

    Umeyama 1991, Eq. (34)-(41), with the scale fixed at one.

    Raises
    ------
    EvaluationError
        If the points or the targets are on a line or in one place.

    Examples
    --------
    >>> import numpy as np
    >>> from slam.evaluation.alignment import umeyama
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]])
    >>> turned = points @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # a quarter turn about z
    >>> (umeyama(points, turned)[:3, :3].round(6) + 0.0).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    mean_points, mean_targets = points.mean(axis=0), targets.mean(axis=0)
    covariance = (targets - mean_targets).T @ (points - mean_points) / len(points)
    left, singular, right = np.linalg.svd(covariance)
    if np.count_nonzero(singular > _OPEN_SHARE * singular[0]) < 2:
        raise EvaluationError(
            f"{len(points)} associated poses in one place or on one line leave the alignment open"
        )
    # Umeyama 1991 Eq. (43): keep a rotation from becoming a reflection.
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    T = np.eye(4)
    T[:3, :3] = left @ flip @ right
    T[:3, 3] = mean_targets - T[:3, :3] @ mean_points
    return T


def _turned(points: FloatArray, targets: FloatArray) -> tuple[float, float]:
    """Return the rotation about z that best aligns centred points (N, 3) with their targets, and the RMSE."""
    (xx, xy), (yx, yy) = targets[:, :2].T @ points[:, :2]
    turn = math.atan2(yx - xy, xx + yy)
    residuals = spatial.transform.Rotation.from_rotvec([0.0, 0.0, turn]).apply(points) - targets
    return turn, float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def _in_plane(trajectory: Trajectory) -> bool:
    """Return whether poses have one height and rotate only about z."""
    tilted, heights = np.abs(trajectory.quaternions_xyzw[:, :2]).max(), trajectory.positions_m[:, 2]
    return bool(tilted < TINY and np.ptp(heights) < TINY)


def _level(truth: Trajectory) -> spatial.transform.Rotation | None:
    """Return the rotation after which up is along z; None if the robot does not stay upright."""
    up = spatial.transform.Rotation.from_quat(truth.quaternions_xyzw).apply([0.0, 0.0, 1.0]).mean(axis=0)
    if np.linalg.norm(up) < _UPRIGHT:
        return None
    level, _ = spatial.transform.Rotation.align_vectors([[0.0, 0.0, 1.0]], [up / np.linalg.norm(up)])
    return level


def nearest_indices(stamps_s: FloatArray, queries_s: FloatArray) -> NDArray[np.intp]:
    """Return the index of the stamp nearest in time to each query; the earlier of two equally near.

    The stamps are put in order first, equal ones staying as they stand; of equal stamps the one that is
    adjacent to the query in that order is taken. It is evo's rule for sorted stamps. In real logs with a
    coarse clock one reading in four shares its stamp, and of the rules tried this one takes the reading that
    lies nearest to the checked relations (intel, short relations, wheel odometry: 0.046 m, first of the
    equals 0.053 m, last of them 0.048 m).

    Parameters
    ----------
    stamps_s
        (N,) in any order, N >= 1.
    queries_s
        (M,)

    Returns
    -------
    (M,) indices into ``stamps_s``.

    Examples
    --------
    >>> import numpy as np
    >>> from slam.evaluation.alignment import nearest_indices
    >>> nearest_indices(np.array([0.0, 1.0, 2.0]), np.array([0.4, 0.6, 5.0])).tolist()
    [0, 1, 2]
    """
    order = np.argsort(stamps_s, kind="stable")
    ordered = stamps_s[order]
    after = np.minimum(np.searchsorted(ordered, queries_s, side="right"), ordered.size - 1)
    before = np.maximum(after - 1, 0)
    # After the last stamp, the first difference is negative, and the last stamp is chosen.
    take_after = ordered[after] - queries_s < queries_s - ordered[before]
    return order[np.where(take_after, after, before)]
