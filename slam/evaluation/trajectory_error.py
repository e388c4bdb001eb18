"""Absolute and relative trajectory error against a reference: ATE and RPE, equal to the results of evo.

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import spatial

from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.alignment import align, nearest_indices
from slam.measurements import FloatArray
from slam.trajectory.poses import Poses

# As in `scanweave evaluate`: poses of ground truth and log rarely share a stamp.
MAX_DIFFERENCE_S = 0.05
# evo's limits, so that the figures agree.
DEFAULT_MAX_DIFFERENCE_S = 0.01


@dataclass(frozen=True, slots=True)
class AbsoluteError:
    """ATE: distance of each pose to its reference after the alignment.

    Attributes
    ----------
    T_reference_map
        (4, 4) transform that the alignment applied to the trajectory.
    translation_m, rotation_rad
        Errors: distance, and angle of the rotation between the two poses.
    alignment
        ``se3``: rigid in 3D, without scale; ``se2``: rigid in the plane, for a robot on a floor.
    mirrored
        A message if the mirror image would fit far better; None otherwise.
    """

    count: int
    T_reference_map: FloatArray
    translation_m: ErrorStatistics
    rotation_rad: ErrorStatistics
    alignment: str
    mirrored: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return values for JSON."""
        return asdict(self) | {"T_reference_map": self.T_reference_map.tolist()}


@dataclass(frozen=True, slots=True)
class RelativeError:
    """RPE: error of the motions over a fixed distance, compared with the reference.

    Attributes
    ----------
    translation_m, rotation_rad
        Errors of a whole motion (not divided by its length).
    """

    count: int
    delta: float
    translation_m: ErrorStatistics
    rotation_rad: ErrorStatistics
    unit: str = "metres"


def associate(
    trajectory: Trajectory, reference: Trajectory, max_difference_s: float = DEFAULT_MAX_DIFFERENCE_S
) -> tuple[Trajectory, Trajectory]:
    """Associate poses by time: to each pose of the shorter trajectory the nearest of the longer.

    Raises
    ------
    EvaluationError
        If no pair is within ``max_difference_s``.

    Examples
    --------
    >>> import numpy as np, slam
    >>> from slam.evaluation.trajectory_error import associate
    >>> fast, slow = np.arange(0.0, 2.0, 0.1), np.arange(0.0, 2.0, 0.5) + 0.004
    >>> ours, truth = (slam.Trajectory.from_planar(at_s, np.zeros((at_s.size, 3))) for at_s in (fast, slow))
    >>> pairs = associate(ours, truth)
    >>> pairs[0].stamps_s.tolist(), len(pairs[1])
    ([0.0, 0.5, 1.0, 1.5], 4)
    """
    if not len(trajectory) or not len(reference):
        raise EvaluationError(
            f"nothing to compare: {len(trajectory)} poses, {len(reference)} of the reference"
        )
    reference_is_shorter = len(trajectory) > len(reference)
    short, long = (reference, trajectory) if reference_is_shorter else (trajectory, reference)
    nearest = nearest_indices(long.stamps_s, short.stamps_s)
    matched = np.flatnonzero(np.abs(long.stamps_s[nearest] - short.stamps_s) <= max_difference_s)
    if not matched.size:
        raise EvaluationError(
            f"no pose is within {max_difference_s} s of the reference's: trajectory"
            f" {trajectory.stamps_s.min():.3f} to {trajectory.stamps_s.max():.3f} s, reference"
            f" {reference.stamps_s.min():.3f} to {reference.stamps_s.max():.3f} s; is it the same clock?"
        )
    short, long = short[matched], long[nearest[matched]]
    return (long, short) if reference_is_shorter else (short, long)


def absolute_error(
    trajectory: Trajectory, reference: Trajectory, *, max_difference_s: float = DEFAULT_MAX_DIFFERENCE_S
) -> AbsoluteError:
    """Absolute trajectory error of associated poses after a rigid alignment without scale.

    A robot on a floor is aligned in the plane: in 3D, a mirror image could be flipped to fit.

    Raises
    ------
    EvaluationError
        If no poses can be associated, or they do not determine the alignment: in 3D on a line, in the plane
        in one point.

    Examples
    --------
    >>> import numpy as np, slam
    >>> from slam.evaluation.trajectory_error import absolute_error
    >>> at_s = np.arange(0.0, 6.0, 0.1)
    >>> way = np.column_stack([np.cos(at_s), np.sin(at_s), at_s])
    >>> truth = slam.Trajectory.from_planar(at_s, way)
    >>> moved = slam.Trajectory.from_planar(at_s, way + [5.0, 0.0, 0.0])  # the same way in another frame
    >>> round(absolute_error(moved, truth).translation_m.rmse, 6)
    0.0
    """
    estimate, truth = associate(trajectory, reference, max_difference_s)
    aligned = align(estimate, truth)
    T_reference_map = aligned.T_target_point
    rotation = spatial.transform.Rotation.from_matrix(T_reference_map[:3, :3])
    positions = rotation.apply(estimate.positions_m) + T_reference_map[:3, 3]
    turned = rotation * spatial.transform.Rotation.from_quat(estimate.quaternions_xyzw)
    difference = turned.inv() * spatial.transform.Rotation.from_quat(truth.quaternions_xyzw)
    return AbsoluteError(
        count=len(estimate),
        T_reference_map=T_reference_map,
        translation_m=ErrorStatistics.of(np.linalg.norm(positions - truth.positions_m, axis=1)),
        rotation_rad=ErrorStatistics.of(np.asarray(difference.magnitude())),
        alignment=aligned.name,
        mirrored=aligned.mirrored,
    )


def relative_error(
    trajectory: Trajectory,
    reference: Trajectory,
    *,
    delta_m: float = 1.0,
    max_difference_s: float = DEFAULT_MAX_DIFFERENCE_S,
) -> RelativeError | None:
    """Relative pose error over consecutive motions of ``delta_m`` of the trajectory's own path.

    Returns
    -------
    The errors; None if the trajectory has no motion of that length.

    Raises
    ------
    EvaluationError
        If no poses can be associated, or ``delta_m`` is not positive.

    Examples
    --------
    >>> import numpy as np, slam
    >>> from slam.evaluation.trajectory_error import relative_error
    >>> at_s = np.arange(0.0, 10.0, 0.1)
    >>> way = np.column_stack([at_s, np.zeros_like(at_s), np.zeros_like(at_s)])
    >>> truth, longer = (slam.Trajectory.from_planar(at_s, way * scale) for scale in (1.0, 1.02))
    >>> round(relative_error(longer, truth, delta_m=1.0).translation_m.mean, 2)  # metres on each metre
    0.02
    """
    if not delta_m > 0.0:
        raise EvaluationError(f"delta must be positive; it is {delta_m:g} m")
    estimate, truth = associate(trajectory, reference, max_difference_s)
    starts, ends = _pairs_by_path(estimate.positions_m, delta_m)
    if not len(starts):
        return None
    own, true = (poses[starts].between(poses[ends]) for poses in map(Poses.of_trajectory, (estimate, truth)))
    # E = inverse(reference motion) * estimated motion: its translation is the rotated difference.
    return RelativeError(
        count=len(starts),
        delta=float(delta_m),
        translation_m=ErrorStatistics.of(np.linalg.norm(own.positions_m - true.positions_m, axis=1)),
        rotation_rad=ErrorStatistics.of(np.asarray((true.rotations.inv() * own.rotations).magnitude())),
    )


def _pairs_by_path(positions_m: FloatArray, delta_m: float) -> tuple[Any, Any]:
    """Return start and end indices that are ``delta_m`` of path apart."""
    steps = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    marks, travelled = [0], 0.0
    for index, step in enumerate(steps.tolist(), start=1):
        travelled += step
        if travelled >= delta_m:
            marks.append(index)
            travelled = 0.0
    return np.array(marks[:-1], dtype=np.intp), np.array(marks[1:], dtype=np.intp)


@dataclass(frozen=True, slots=True)
class TruthComparison:
    """A trajectory and its ground truth, associated and rigidly aligned.

    Attributes
    ----------
    stamps_s
        (N,) of the associated poses.
    positions_m, true_positions_m
        (N, 3) both in the map frame of the trajectory.
    errors_m
        (N,) distances between them.
    """

    error: AbsoluteError
    stamps_s: FloatArray
    positions_m: FloatArray
    true_positions_m: FloatArray
    errors_m: FloatArray


def compare_with_truth(trajectory: Trajectory, truth: Trajectory) -> TruthComparison:
    """Align a trajectory with its truth and measure what is left.

    Raises
    ------
    EvaluationError
        If no poses can be associated, or they lie on a line, which leaves the alignment open.
    """
    error = absolute_error(trajectory, truth, max_difference_s=MAX_DIFFERENCE_S)
    estimate, reference = associate(trajectory, truth, MAX_DIFFERENCE_S)
    rotation, shift = error.T_reference_map[:3, :3], error.T_reference_map[:3, 3]
    true_positions = (reference.positions_m - shift) @ rotation
    distances = np.linalg.norm(estimate.positions_m - true_positions, axis=1)
    return TruthComparison(error, estimate.stamps_s, estimate.positions_m, true_positions, distances)


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of non-negative errors, in the unit of the errors; ``std`` is that of the population."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorStatistics:
        """Compute the statistics of (N,) errors, N >= 1."""
        return cls(
            rmse=float(np.sqrt(np.mean(np.square(errors)))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
        )
