"""Pose graphs as g2o text, 2D and 3D, with full precision and GTSAM's order of the tangent space."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import gtsam
import numpy as np

from slam.errors import MapFileError
from slam.graph.edge import Edge
from slam.measurements import Pose, row_from_pose, row_from_pose2
from slam.storage.files import write_lines
from slam.storage.tum import upper_triangles


def write_g2o(path: Path, poses: Sequence[Pose], edges: Iterable[Edge]) -> None:
    """Write the poses of all nodes, all of one kind, and edges among them; node 0 is fixed.

    As gtsam's reader expects, the information matrix of a 3D edge is permuted but not scaled, though g2o's
    rotation coordinates are half of gtsam's.

    Raises
    ------
    MapFileError
        If a pose or an information matrix is not finite, or the file cannot be written.

    Examples
    --------
    >>> import gtsam, numpy as np, slam
    >>> from pathlib import Path
    >>> from slam.storage.g2o import write_g2o
    >>> step = gtsam.Pose2(1.0, 0.0, 0.0)
    >>> edge = slam.Edge(0, 1, step, np.eye(3), slam.EdgeKind.LIDAR, trusted=True)
    >>> write_g2o(Path("graph.g2o"), [gtsam.Pose2(), step], [edge])
    >>> print(Path("graph.g2o").read_text().splitlines()[2])
    EDGE_SE2 0 1 1.0 0.0 0.0 1.0 0.0 0.0 1.0 0.0 1.0
    """
    write_lines(path, list(_lines(path, poses, edges)))


def _lines(path: Path, poses: Sequence[Pose], edges: Iterable[Edge]) -> Iterator[str]:
    """Yield vertices, edges, then the fixed node: in another order, gtsam's reader finds no edge in 2D."""
    space = "SE2" if isinstance(poses[0], gtsam.Pose2) else "SE3:QUAT"
    for vertex, pose in enumerate(poses):
        yield f"VERTEX_{space} {vertex} {_text(path, _numbers(pose))}"
    edges = list(edges)
    if edges:
        informations = np.asarray(np.linalg.inv([edge.covariance for edge in edges]), np.float64)
        if informations.shape[1] == 6:
            # g2o keeps translation first in 3D, gtsam rotation first.
            informations = np.roll(informations, 3, axis=(1, 2))
        for edge, triangle in zip(edges, upper_triangles(informations).tolist(), strict=True):
            numbers = [*_numbers(edge.T_source_target), *triangle]
            yield f"EDGE_{space} {edge.source} {edge.target} {_text(path, numbers)}"
    yield "FIX 0"


def _text(path: Path, numbers: list[float]) -> str:
    """Return the shortest texts (at most 17 digits) that read back as the same numbers."""
    if not all(map(math.isfinite, numbers)):
        raise MapFileError(f"cannot write {path}: a pose or an information matrix is not finite")
    return " ".join(map(repr, numbers))


def _numbers(pose: Pose) -> list[float]:
    """Return the numbers x y theta, or x y z qx qy qz qw."""
    if isinstance(pose, gtsam.Pose2):
        row: list[float] = row_from_pose2(pose).tolist()
        return row
    return row_from_pose(pose)
