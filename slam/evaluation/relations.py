"""Kuemmerle 2009: score a trajectory by relative poses that were checked by hand.

R. Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27(4), 2009.
The score needs no global reference frame, so one early error does not affect all later poses.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.alignment import nearest_indices
from slam.evaluation.trajectory_error import ErrorStatistics
from slam.matching.planar import between, wrap
from slam.measurements import BoolArray, FloatArray
from slam.storage.files import numbered_fields, parse_floats

MAX_STAMP_DIFFERENCE_S = 0.1
SHORT_RELATION_S = 20.0


@dataclass(frozen=True, slots=True)
class Relations:
    """Reference relations: pose of the base at the second stamp relative to the first.

    Attributes
    ----------
    first_stamps_s, second_stamps_s
        (N,)
    xyz_rpy
        (N, 6) metres and radians: x, y, z, roll, pitch, yaw.
    """

    first_stamps_s: FloatArray
    second_stamps_s: FloatArray
    xyz_rpy: FloatArray

    def __len__(self) -> int:
        return int(self.first_stamps_s.size)


@dataclass(frozen=True, slots=True)
class RelationGroupScore:
    """Errors of a group of relations: sqrt(dx^2 + dy^2) and |dyaw|."""

    used: int
    translation_m: ErrorStatistics
    rotation_rad: ErrorStatistics


@dataclass(frozen=True, slots=True)
class RelationScore:
    """Errors over all usable relations, and over the short and the long ones.

    Attributes
    ----------
    skipped
        Relations with no pose within 0.1 s of one of their stamps.
    all
        Every used relation: the published figure.
    short, long
        Those that span less than 20 s (local accuracy), and the others (global consistency); None if there
        are none.
    """

    skipped: int
    all: RelationGroupScore
    short: RelationGroupScore | None
    long: RelationGroupScore | None

    @property
    def used(self) -> int:
        """Number of relations scored."""
        return self.all.used

    def to_dict(self) -> dict[str, Any]:
        """Return a dict for JSON: the statistics of all relations first, then of the two groups."""
        groups = asdict(self)
        return {**groups.pop("all"), **groups}


def read_relations(path: Path) -> Relations:
    """Read ``t1 t2 x y z roll pitch yaw`` lines, plain or ``.gz``.

    Raises
    ------
    EvaluationError
        If a line does not have eight finite numbers (the message names it), or the file is empty.

    Examples
    --------
    >>> from pathlib import Path
    >>> from slam.evaluation.relations import read_relations
    >>> line = "10.0 12.5 1.20 0.05 0.0 0.0 0.0 0.31"  # t1 t2 x y z roll pitch yaw
    >>> Path("checked.relations").write_text(line) > 0
    True
    >>> read_relations(Path("checked.relations")).xyz_rpy[0, [0, 1, 5]].tolist()
    [1.2, 0.05, 0.31]
    """
    rows: list[list[float]] = []
    for number, fields in numbered_fields(path, EvaluationError):
        where = f"{path}:{number}"
        if len(fields) != 8:
            raise EvaluationError(
                f"{where}: {len(fields)} fields, a relation has 8 (t1 t2 x y z roll pitch yaw)"
            )
        rows.append(parse_floats(fields, where, EvaluationError))
    if not rows:
        raise EvaluationError(f"{path}: holds no relation")
    table = np.array(rows)
    return Relations(table[:, 0].copy(), table[:, 1].copy(), table[:, 2:].copy())


def score_relations(trajectory: Trajectory, relations: Relations) -> RelationScore:
    """Compare a trajectory with relations, component by component, in the ground plane.

    For each stamp, the pose nearest in time is used, within 0.1 s and without interpolation. The trajectory
    may be in any order. The error is the difference of x, y and yaw between inverse(p1) * p2 and the
    relation, by component as in the published figures (not as a composition of the two motions).

    Raises
    ------
    EvaluationError
        If no relation has poses at both stamps.

    Examples
    --------
    >>> import numpy as np, slam
    >>> from slam.evaluation.relations import Relations, score_relations
    >>> way = slam.Trajectory.from_planar(np.array([10.0, 12.0]), np.array([[0.0, 0, 0], [1.25, 0, 0]]))
    >>> checked = Relations(np.array([10.0]), np.array([12.0]), np.array([[1.2, 0, 0, 0, 0, 0]]))
    >>> round(score_relations(way, checked).all.translation_m.mean, 3)
    0.05
    """
    if not len(trajectory) or not len(relations):
        raise EvaluationError(f"nothing to score: {len(trajectory)} poses and {len(relations)} relations")
    first, first_found = _look_up(trajectory, relations.first_stamps_s)
    second, second_found = _look_up(trajectory, relations.second_stamps_s)
    used = first_found & second_found
    if not used.any():
        raise EvaluationError(
            f"none of {len(relations)} relations has poses within {MAX_STAMP_DIFFERENCE_S} s of its stamps: "
            f"{_span('trajectory', trajectory.stamps_s)}, {_span('relations', relations.first_stamps_s)};"
            " is it the same log and the same clock?"
        )
    poses = trajectory.to_planar()
    ends = zip(poses[first[used]], poses[second[used]], strict=True)
    moved = np.array([between(one, other) for one, other in ends])
    reference = relations.xyz_rpy[used]
    translation_m = np.hypot(moved[:, 0] - reference[:, 0], moved[:, 1] - reference[:, 1])
    rotation_rad = np.abs([wrap(angle) for angle in moved[:, 2] - reference[:, 5]])
    is_short = np.abs(relations.second_stamps_s - relations.first_stamps_s)[used] < SHORT_RELATION_S
    return RelationScore(
        skipped=int(np.count_nonzero(~used)),
        all=_group(translation_m, rotation_rad),
        short=_group(translation_m[is_short], rotation_rad[is_short]) if is_short.any() else None,
        long=_group(translation_m[~is_short], rotation_rad[~is_short]) if not is_short.all() else None,
    )


def _look_up(trajectory: Trajectory, stamps_s: FloatArray) -> tuple[NDArray[np.intp], BoolArray]:
    """Return the index of the pose nearest to every stamp, and whether it is near enough."""
    nearest = nearest_indices(trajectory.stamps_s, stamps_s)
    return nearest, np.abs(trajectory.stamps_s[nearest] - stamps_s) <= MAX_STAMP_DIFFERENCE_S


def _group(translation_m: FloatArray, rotation_rad: FloatArray) -> RelationGroupScore:
    """Return the statistics of at least one relation."""
    return RelationGroupScore(
        used=int(translation_m.size),
        translation_m=ErrorStatistics.of(translation_m),
        rotation_rad=ErrorStatistics.of(rotation_rad),
    )


def _span(name: str, stamps_s: FloatArray) -> str:
    """Return first and last time of a set of stamps, for a message."""
    return f"{name} {stamps_s.min():.3f} to {stamps_s.max():.3f} s"
