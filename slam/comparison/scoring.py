"""All metrics of one run; they depend on the references that its log has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.comparison.loop_score import loop_scores
from slam.comparison.map_score import map_scores, read_true_grid
from slam.comparison.plan_score import plan_scores, robot_radius_m
from slam.comparison.product import Product
from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.relations import RelationScore, read_relations, score_relations
from slam.evaluation.trajectory_error import (
    MAX_DIFFERENCE_S,
    TruthComparison,
    compare_with_truth,
    relative_error,
)


@dataclass(frozen=True, slots=True)
class Truths:
    """References of a run; each may be missing.

    Attributes
    ----------
    trajectory
        True poses of the base.
    relations
        File of relations.
    grids
        The simulator's ground truth folder.
    """

    trajectory: Trajectory | None
    relations: Path | None
    grids: Path | None


@dataclass(frozen=True, slots=True)
class Scores:
    """Metrics by name, the trajectory aligned to the ground truth, and what could not be measured."""

    figures: dict[str, float]
    truth: TruthComparison | None
    warnings: tuple[str, ...]


def scores_of(product: Product, truths: Truths, rpe_m: tuple[float, ...]) -> Scores:
    """Score a run; metrics that cannot be computed give a warning, not an error."""
    figures: dict[str, float] = {}
    warnings: list[str] = []
    comparison = None
    if truths.relations is not None:
        try:
            score = score_relations(product.trajectory, read_relations(truths.relations))
            figures |= relation_figures(score)
        except EvaluationError as error:
            warnings.append(f"no relations: {error}")
    if truths.trajectory is not None:
        try:
            comparison = compare_with_truth(product.trajectory, truths.trajectory)
        except EvaluationError as error:
            warnings.append(f"no ATE: {error}")
    if comparison is not None and truths.trajectory is not None:
        figures |= absolute_figures(comparison)
        for length_m in rpe_m:
            relative = _relative_figures(product.trajectory, truths.trajectory, length_m)
            figures |= relative
            if not relative:
                warnings.append(f"no RPE over {length_m:g} m: the drive is shorter")
        if product.loops is not None:
            figures |= loop_scores(product.loops, product.keyframe_stamps_s, truths.trajectory)
            figures["loops_tried"] = float(product.loops_tried)
        if truths.grids is not None:
            figures |= _grid_figures(product, truths.grids, comparison)
    return Scores(figures, comparison, tuple(warnings))


def relation_figures(score: RelationScore) -> dict[str, float]:
    """Kuemmerle 2009: mean and standard deviation over all relations, means over short and long ones."""
    figures = {
        "relations_m": score.all.translation_m.mean,
        "relations_std_m": score.all.translation_m.std,
        "relations_deg": math.degrees(score.all.rotation_rad.mean),
        "relations_used": float(score.used),
    }
    for name, group in (("short", score.short), ("long", score.long)):
        if group is not None:
            figures[f"relations_{name}_m"] = group.translation_m.mean
    return figures


def absolute_figures(comparison: TruthComparison) -> dict[str, float]:
    """Compute the ATE after a rigid alignment."""
    error = comparison.error
    return {
        "ate_m": error.translation_m.rmse,
        "ate_median_m": error.translation_m.median,
        "ate_max_m": error.translation_m.max,
        "ate_deg": math.degrees(error.rotation_rad.rmse),
    }


def _relative_figures(trajectory: Trajectory, truth: Trajectory, length_m: float) -> dict[str, float]:
    """Compute the RPE over one length; nothing if the drive is shorter."""
    error = relative_error(trajectory, truth, delta_m=length_m, max_difference_s=MAX_DIFFERENCE_S)
    if error is None:
        return {}
    return {
        f"rpe_{length_m:g}m_m": error.translation_m.rmse,
        f"rpe_{length_m:g}m_deg": math.degrees(error.rotation_rad.rmse),
    }


def _grid_figures(product: Product, folder: Path, comparison: TruthComparison) -> dict[str, float]:
    """Compare maps with the true plan: obstacles for a robot, and obstacles at the lidar's height."""
    figures: dict[str, float] = {}
    T_true_map, true_xy = comparison.error.T_reference_map, _true_xy(comparison)
    robot, lidar = folder / "grid_robot.npz", folder / "grid_lidar.npz"
    driven_by = product.decision or product.plane
    if driven_by is not None and robot.is_file():
        truth, radius_m = read_true_grid(robot), robot_radius_m(folder)
        scores = map_scores(driven_by, truth, T_true_map, true_xy)
        if radius_m is not None:
            map_xy = product.trajectory.positions_m[:, :2]
            scores |= plan_scores(driven_by, truth, T_true_map, true_xy, map_xy, radius_m)
        figures |= {f"map_{name}": value for name, value in scores.items()}
    if product.plane is not None and lidar.is_file():
        scores = map_scores(product.plane, read_true_grid(lidar), T_true_map, true_xy)
        figures |= {f"plane_{name}": value for name, value in scores.items()}
    return figures


def _true_xy(comparison: TruthComparison) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(N, 2) true path of the robot in the frame of the ground truth."""
    T = comparison.error.T_reference_map
    positions = comparison.true_positions_m @ T[:3, :3].T + T[:3, 3]
    return np.asarray(positions[:, :2])
