"""Pose graphs as g2o text, 2D and 3D, with full precision and gtsam's order of the tangent space."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.errors import MapFileError
from slam.measurements import FloatArray, Pose, row_from_pose2
from slam.storage.files import write_lines

# g2o keeps translation first in 3D, gtsam rotation first; the permutation is its own inverse.
_SWAP_3D = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True, slots=True)
class G2oEdge:
    """A measured pose of vertex j in the frame of vertex i.

    Attributes
    ----------
    i, j
        Vertex ids.
    T_i_j
        The measurement, Pose2 or Pose3.
    information
        (d, d) inverse covariance in gtsam's tangent order: Pose2 (x, y, theta), Pose3 rotation first.
    """

    i: int
    j: int
    T_i_j: Pose
    information: FloatArray


@dataclass(frozen=True, slots=True)
class G2oGraph:
    """A pose graph as a file has it.

    Attributes
    ----------
    vertices
        Pose T_map_vertex of every vertex id. Empty where the file has edges only.
    edges
        In file order.
    fixed
        Ids that must not move.
    """

    vertices: dict[int, Pose]
    edges: list[G2oEdge]
    fixed: frozenset[int] = field(default_factory=frozenset)

    def is_3d(self) -> bool:
        """Whether the poses are Pose3; an empty graph counts as planar."""
        poses: Iterator[Pose] = iter([*self.vertices.values(), *(edge.T_i_j for edge in self.edges)])
        return isinstance(next(poses, None), gtsam.Pose3)


def write_g2o(path: Path, graph: G2oGraph) -> None:
    """Write a graph so that reading it back gives the same one, to the last digit in 2D.

    As gtsam's reader expects, the information matrix of a 3D edge is permuted but not scaled, though g2o's
    rotation coordinates are half of gtsam's.

    Raises
    ------
    MapFileError
        Where poses mix 2D and 3D or are not finite, an information matrix is not symmetric or of the wrong
        size, an edge names an unknown vertex, or the file cannot be written.
    """
    where = f"cannot write {path}"
    if not (graph.vertices or graph.edges):
        raise MapFileError(f"{where}: the graph is empty")
    _check_ids(where, graph.vertices, graph.edges, set(graph.fixed))
    space = "SE3:QUAT" if graph.is_3d() else "SE2"
    write_lines(path, list(_lines(graph, space, where)))


def _lines(graph: G2oGraph, space: str, where: str) -> Iterator[str]:
    """The file's lines: vertices, edges, fixed ids: these last, or gtsam's reader finds no edge in 2D."""
    for vertex, pose in graph.vertices.items():
        yield f"VERTEX_{space} {vertex} {_numbers_text(_pose_numbers(pose, space, where), where)}"
    for edge in graph.edges:
        numbers = [*_pose_numbers(edge.T_i_j, space, where), *_upper_triangle(edge, space, where)]
        yield f"EDGE_{space} {edge.i} {edge.j} {_numbers_text(numbers, where)}"
    for vertex in sorted(graph.fixed):
        yield f"FIX {vertex}"


def _numbers_text(numbers: list[float], where: str) -> str:
    """The shortest texts (at most 17 digits) that read back as the same numbers."""
    if not np.isfinite(numbers).all():
        raise MapFileError(f"{where}: a pose or an information matrix is not finite")
    return " ".join(repr(number) for number in numbers)


def _pose_numbers(pose: Pose, space: str, where: str) -> list[float]:
    """The numbers x y theta, or x y z qx qy qz qw."""
    if space == "SE2" and isinstance(pose, gtsam.Pose2):
        row: list[float] = row_from_pose2(pose).tolist()
        return row
    if space == "SE3:QUAT" and isinstance(pose, gtsam.Pose3):
        q: Any = pose.rotation().toQuaternion()
        return [*pose.translation().tolist(), q.x(), q.y(), q.z(), q.w()]
    raise MapFileError(f"{where}: the graph mixes Pose2 and Pose3")


def _upper_triangle(edge: G2oEdge, space: str, where: str) -> list[float]:
    """Row-major upper triangle of the information matrix in g2o's order."""
    size = 3 if space == "SE2" else 6
    information = np.asarray(edge.information, dtype=np.float64)
    if information.shape != (size, size) or not np.allclose(information, information.T, rtol=1e-9, atol=0.0):
        raise MapFileError(
            f"{where}: edge {edge.i} {edge.j} needs a symmetric {size} x {size} information matrix,"
            f" it has shape {information.shape}"
        )
    if size == 6:
        information = information[np.ix_(_SWAP_3D, _SWAP_3D)]
    triangle: list[float] = information[np.triu_indices(size)].tolist()
    return triangle


def _check_ids(where: str, vertices: dict[int, Pose], edges: list[G2oEdge], fixed: set[int]) -> None:
    """Refuse ids without a vertex, unless the graph is given by its edges alone."""
    if not vertices:
        return
    for edge in edges:
        for vertex in (edge.i, edge.j):
            if vertex not in vertices:
                raise MapFileError(
                    f"{where}: edge {edge.i} {edge.j} names vertex {vertex}, which is not listed"
                )
    for vertex in sorted(fixed - vertices.keys()):
        raise MapFileError(f"{where}: FIX names vertex {vertex}, which is not listed")
