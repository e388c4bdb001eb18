"""Score a trajectory against ground truth or relations, and format the scores."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from slam.datasets import open_dataset
from slam.datasets.truth_files import read_truth
from slam.errors import EvaluationError, path_of
from slam.estimates import Trajectory
from slam.evaluation.coverage import coverage
from slam.evaluation.relations import Relations, read_relations, score_relations
from slam.evaluation.trajectory_error import MAX_DIFFERENCE_S, absolute_error, relative_error
from slam.measurements import FloatArray
from slam.outputs.finished_map import Map
from slam.storage.tum import covariance_path, read_covariances, read_tum


def evaluate(
    trajectory: Trajectory | Map | Path | str,
    *,
    groundtruth: Trajectory | Map | Path | str | None = None,
    relations: Relations | Path | str | None = None,
    tolerance_s: float | None = None,
    delta_m: float = 1.0,
    covariances: FloatArray | None = None,
) -> dict[str, Any]:
    """Score a trajectory by ATE and RPE (Sturm 2012) with ground truth, or by relations (Kuemmerle 2009).

    Parameters
    ----------
    trajectory
        A trajectory in any frame, a map, or a TUM file.
    groundtruth
        Ground truth poses, a file of them (format of TUM, EuRoC, KITTI, Newer College, NCLT, Boreas, MulRan
        or Redwood), or the folder of a dataset with ground truth. The ATE is computed after rigid alignment
        (Umeyama 1991, without scale), or planar alignment if all poses are in the plane.
    relations
        Relative poses checked by hand, or a file of them: ``t1 t2 x y z roll pitch yaw``.
    tolerance_s
        Largest time difference between pose and ground truth; None uses 0.05 s. Relations always use 0.1 s.
    delta_m
        Path length in metres of the motions that the RPE compares.
    covariances
        Covariance of every pose, as `slam.Map.covariances`. None reads the file that ``scanweave map`` wrote
        next to the trajectory, if there is one.

    Returns
    -------
    By name: ``ate`` and ``rpe``, or ``relations``. Each has ``translation_m`` and ``rotation_rad`` with
    ``mean``, ``std``, ``median``, ``rmse`` and ``max``. ``rpe`` is None if the path is shorter than
    ``delta_m``. With covariances and ground truth also ``coverage``: the ``nees``, and the shares of poses
    whose 95 % ellipse (``position``) and interval (``yaw``) contain the ground truth, aligned at the pose
    with the smallest covariance.

    Raises
    ------
    DatasetError, EvaluationError, MapFileError
        If a file cannot be read, the times do not overlap, or not exactly one reference is given.

    Examples
    --------
    >>> import numpy as np, slam
    >>> stamps_s = np.arange(0.0, 60.0, 0.5)
    >>> yaw = stamps_s / 9.0
    >>> circle = np.column_stack([3.0 * np.sin(yaw), -3.0 * np.cos(yaw), yaw])
    >>> truth = slam.Trajectory.from_planar(stamps_s, circle)
    >>> wider = slam.Trajectory.from_planar(stamps_s, circle * [1.01, 1.01, 1.0])
    >>> scores = slam.evaluate(wider, groundtruth=truth)
    >>> round(scores["ate"]["translation_m"]["rmse"], 2), round(scores["rpe"]["translation_m"]["mean"], 2)
    (0.03, 0.01)
    """
    poses = _poses(trajectory)
    if (groundtruth is None) == (relations is None):
        count = "none" if relations is None else "both"
        raise EvaluationError(f"a trajectory is scored by groundtruth or by relations: give one, not {count}")
    if relations is not None:
        checked = (
            relations if isinstance(relations, Relations) else read_relations(path_of(relations, "relations"))
        )
        return {"relations": score_relations(poses, checked).to_dict()}
    assert groundtruth is not None
    truth = _truth(groundtruth)
    limit_s = MAX_DIFFERENCE_S if tolerance_s is None else tolerance_s
    relative = relative_error(poses, truth, delta_m=delta_m, max_difference_s=limit_s)
    scores = {
        "ate": absolute_error(poses, truth, max_difference_s=limit_s).to_dict(),
        "rpe": None if relative is None else asdict(relative),
    }
    if isinstance(trajectory, Map) and covariances is None:
        covariances = trajectory.covariances
    if covariances is None and isinstance(trajectory, str | Path):
        covariances = _beside(Path(trajectory), poses)
    if covariances is not None:
        scores["coverage"] = asdict(coverage(poses, covariances, truth, limit_s))
    return scores


def score_text(scores: dict[str, Any]) -> str:
    """Format scores as a few lines of text, with angles in degrees."""
    lines = []
    for name, values in scores.items():
        if values is None:
            lines.append(f"{name}: none: the drive is shorter than delta")
            continue
        lines.append(f"{name}:")
        lines += _lines(values, "  ")
    return "\n".join(lines)


def _lines(values: dict[str, Any], indent: str) -> list[str]:
    """Return one line for each group of statistics."""
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
            lines.append(f"{indent}{name}: {round(value, 4) if isinstance(value, float) else value}")
    return lines


def _beside(path: Path, poses: Trajectory) -> FloatArray | None:
    """Return the covariances of a trajectory file; None if there are none."""
    file = covariance_path(path)
    if not file.is_file():
        return None
    stamps_s, covariances = read_covariances(file)
    if not np.array_equal(stamps_s, poses.stamps_s):
        raise EvaluationError(f"{file} has other stamps than {path}; it belongs to another trajectory")
    return covariances


def _poses(source: Trajectory | Map | Path | str) -> Trajectory:
    """Return a trajectory, or that of a map or a TUM file."""
    source = source.trajectory if isinstance(source, Map) else source
    return source if isinstance(source, Trajectory) else read_tum(path_of(source, "the trajectory"))


def _truth(source: Trajectory | Map | Path | str) -> Trajectory:
    """Return `_poses`, or the ground truth that a data set publishes or a recording contains."""
    if isinstance(source, Trajectory | Map):
        return _poses(source)
    if path_of(source, "groundtruth").is_file():
        return read_truth(Path(source)) or read_tum(Path(source))
    truth = open_dataset(source).groundtruth()
    if truth is None:
        raise EvaluationError(f"{source} has no true trajectory; give a file in TUM format")
    return truth
