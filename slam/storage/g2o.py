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
from slam.storage.files import numbered_fields, parse_floats, write_lines

_NORM_TOLERANCE = 1e-2
_SUPPORTED = "VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX"
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
    """A pose graph as a file tells it.

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


def read_g2o(path: Path) -> G2oGraph:
    """Read a g2o file, plain or ``.gz``.

    As in gtsam's own reader, the information matrix of a 3D edge is permuted but not scaled, though g2o's
    rotation coordinates are half of gtsam's: published errors of public graphs are stated that way.

    Raises
    ------
    MapFileError
        Naming the line, where a record is not known, has the wrong count of fields, a number that is not
        finite, a quaternion that is not of unit length, an id twice, or mixes 2D with 3D;
        or where an edge or FIX names a vertex that the file does not list.
    """
    vertices: dict[int, Pose] = {}
    edges: list[G2oEdge] = []
    fixed: set[int] = set()
    dimensions: set[str] = set()
    for number, (tag, *fields) in numbered_fields(path):
        where = f"{path}:{number}"
        if tag == "FIX":
            fixed.update(_parse_ids(fields, where))
            continue
        kind, _, space = tag.partition("_")
        if (kind, space) not in {(k, s) for k in ("VERTEX", "EDGE") for s in ("SE2", "SE3:QUAT")}:
            raise MapFileError(f"{where}: unknown record '{tag}'; supported are {_SUPPORTED}")
        dimensions.add(space)
        if len(dimensions) > 1:
            raise MapFileError(f"{where}: '{tag}' mixes 2D and 3D in one graph")
        if kind == "VERTEX":
            vertex, pose = _parse_vertex(fields, space, where)
            if vertex in vertices:
                raise MapFileError(f"{where}: vertex {vertex} is listed twice")
            vertices[vertex] = pose
        else:
            edges.append(_parse_edge(fields, space, where))
    _check_ids(f"{path}", vertices, edges, fixed)
    return G2oGraph(vertices, edges, frozenset(fixed))


def write_g2o(path: Path, graph: G2oGraph) -> None:
    """Write a graph so that reading it back gives the same one, to the last digit in 2D.

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


def _parse_ids(fields: list[str], where: str) -> list[int]:
    """Vertex ids, at least one."""
    if not fields:
        raise MapFileError(f"{where}: a vertex id is missing")
    try:
        return [int(text) for text in fields]
    except ValueError as cause:
        raise MapFileError(f"{where}: vertex ids must be whole numbers, not {' '.join(fields)}") from cause


def _parse_vertex(fields: list[str], space: str, where: str) -> tuple[int, Pose]:
    """``id x y theta`` or ``id x y z qx qy qz qw``."""
    size = 3 if space == "SE2" else 7
    if len(fields) != 1 + size:
        raise MapFileError(f"{where}: {len(fields)} fields after VERTEX_{space}, it has {1 + size}")
    return _parse_ids(fields[:1], where)[0], _parse_pose(parse_floats(fields[1:], where), where)


def _parse_edge(fields: list[str], space: str, where: str) -> G2oEdge:
    """``i j pose upper-triangle``."""
    size, dimension = (3, 3) if space == "SE2" else (7, 6)
    expected = 2 + size + dimension * (dimension + 1) // 2
    if len(fields) != expected:
        raise MapFileError(f"{where}: {len(fields)} fields after EDGE_{space}, it has {expected}")
    i, j = _parse_ids(fields[:2], where)
    if i == j:
        raise MapFileError(f"{where}: edge from vertex {i} to itself")
    numbers = parse_floats(fields[2:], where)
    information = np.zeros((dimension, dimension))
    information[np.triu_indices(dimension)] = numbers[size:]
    information += np.triu(information, 1).T
    if dimension == 6:
        information = information[np.ix_(_SWAP_3D, _SWAP_3D)]
    return G2oEdge(i, j, _parse_pose(numbers[:size], where), information)


def _parse_pose(numbers: list[float], where: str) -> Pose:
    """A Pose2 from x y theta, a Pose3 from x y z qx qy qz qw."""
    if len(numbers) == 3:
        return gtsam.Pose2(*numbers)
    quaternion = np.array(numbers[3:])
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise MapFileError(f"{where}: quaternion of length {norm:.6g}, it must be 1 (order qx qy qz qw)")
    qx, qy, qz, qw = quaternion / norm
    return gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array(numbers[:3]))


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
