"""Score a trajectory file, and say the scores to people."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from slam.datasets import open_dataset
from slam.errors import EvaluationError
from slam.evaluation.relations import read_relations, score_relations
from slam.evaluation.trajectory_error import absolute_error, relative_error
from slam.measurements import Trajectory
from slam.storage.tum import read_tum

_TOLERANCE_S = 0.05


def score(
    trajectory: Path,
    relations: Path | None,
    groundtruth: Path | None,
    *,
    tolerance_s: float | None,
    delta_m: float,
) -> dict[str, Any]:
    """Score a TUM trajectory by relations, or by ATE and RPE where a true trajectory is given.

    Parameters
    ----------
    groundtruth
        A TUM file, or the folder of a dataset that comes with its truth.

    Returns
    -------
    By name; None of the RPE of a drive that is shorter than ``delta_m``.

    Raises
    ------
    DatasetError, EvaluationError, MapFileError
        For files that cannot be read, or that share no time.
    """
    poses = read_tum(trajectory)
    if relations is not None:
        return {"relations": score_relations(poses, read_relations(relations)).to_dict()}
    if groundtruth is None:
        raise ValueError("relations or groundtruth must be given")
    truth = _truth(groundtruth)
    limit_s = _TOLERANCE_S if tolerance_s is None else tolerance_s
    relative = relative_error(poses, truth, delta=delta_m, unit="metres", max_difference_s=limit_s)
    return {
        "ate": absolute_error(poses, truth, max_difference_s=limit_s).to_dict(),
        "rpe": None if relative is None else relative.to_dict(),
    }


def _truth(path: Path) -> Trajectory:
    """A TUM file, or what a dataset folder knows of its truth."""
    if not path.is_dir():
        return read_tum(path)
    truth = open_dataset(path).groundtruth()
    if truth is None:
        raise EvaluationError(f"{path} has no true trajectory; give a file in TUM format")
    return truth


def score_text(scores: dict[str, Any]) -> str:
    """A few lines for people; angles in degrees."""
    lines = []
    for name, values in scores.items():
        if values is None:
            lines.append(f"{name}: none: the drive is shorter than delta")
            continue
        lines.append(f"{name}:")
        lines += _lines(values, "  ")
    return "\n".join(lines)


def _lines(values: dict[str, Any], indent: str) -> list[str]:
    """Nested figures, one line a group of statistics."""
    lines = []
    for name, value in values.items():
        if isinstance(value, dict) and "mean" in value:
            scale, unit = (math.degrees(1.0), "deg") if name.endswith("_rad") else (1.0, "m")
            shown = ", ".join(
                f"{key} {scale * value[key]:.4f}" for key in ("mean", "std", "median", "rmse", "max")
            )
            lines.append(f"{indent}{name.rsplit('_', 1)[0]} [{unit}]: {shown}")
        elif isinstance(value, dict):
            lines.append(f"{indent}{name}:")
            lines += _lines(value, indent + "  ")
        elif value is not None and not isinstance(value, list):
            lines.append(f"{indent}{name}: {value}")
    return lines
