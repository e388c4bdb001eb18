"""Comparison of a trajectory with ground truth, as drawn in the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import AbsoluteError, absolute_error, associate
from slam.measurements import FloatArray

# As in `scanweave evaluate`: poses of ground truth and log rarely share a stamp.
MAX_DIFFERENCE_S = 0.05


@dataclass(frozen=True, slots=True)
class TruthComparison:
    """A trajectory and its ground truth, associated and rigidly aligned.

    Attributes
    ----------
    error
        Absolute trajectory error.
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
