"""Convert a finished map to the data of its page: nodes, edges, loops, scans and path, as named arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import gate
from slam.config import Config
from slam.estimates import Trajectory
from slam.evaluation.alignment import nearest_indices
from slam.evaluation.page_charts import sigmas_of
from slam.evaluation.page_layers import layer_pictures
from slam.graph.influence import all_edges, elimination_order, influences
from slam.graph.loop_candidate import LoopCandidate
from slam.heap import give_back
from slam.mapping.layered_map import PASSED_BY
from slam.matching.planar import transform_points
from slam.measurements import FloatArray, LaserScan, Pose, row_from_pose, row_from_pose2
from slam.storage.map_contents import MapContents, SavedFactor
from slam.storage.map_sessions import MapSession, session_numbers
from slam.storage.tum import upper_triangles

# Limits of a page: points of scans, poses of the path. The rest is thinned evenly, and reported.
_SCAN_POINTS, _POSES = 1_000_000, 20_000
_CM_A_METRE = 100.0
_FARTHEST_CM = np.iinfo(np.int16).max


def map_data(
    saved: MapContents, config: Config, *, title: str, sessions: Sequence[MapSession] = (), digest: str = ""
) -> dict[str, Any]:
    """Return the data of a map's page, see `slam.evaluation.work_page.packed`.

    Parameters
    ----------
    sessions
        The logs of the map, in order; none for a map of one.
    digest
        Digest of the map, so that edits refer to it.
    """
    rows = _rows_of_nodes(saved, sessions)
    sigmas = _sigmas(saved)
    scans, scan_limits = _scans(saved.keyframe_scans, len(saved.node_poses))
    path, path_limits = _way(saved, rows, sigmas)
    names = [session.log_name for session in sessions] or [title]
    of_nodes = session_numbers(sessions) if sessions else np.zeros(len(saved.node_poses))
    node_session = of_nodes.astype(np.int32)
    path |= {"session": node_session[path["node"]].astype(np.uint8), "sessions": names}
    return {
        "kind": "map",
        "title": title,
        "digest": digest,
        "planar": saved.planar,
        "unit": "scan" if any(scan is not None for scan in saved.keyframe_scans) else "frame",
        "sessions": names,
        "nodes": {
            "stamps_s": saved.stamps_s,
            "session": node_session,
            "readings": saved.readings.astype(np.int32),
            "poses": pose_rows(saved.node_poses),
            "bases": saved.keyframe_poses,
            "sigmas_m": sigmas[0][rows],
            "ellipses": _plane_covariances(saved.covariances, rows),
        },
        "edges": _edges(saved.factors, saved.planar),
        "loops": _loops(saved.loops, saved.factors, saved.planar),
        "scans": scans,
        "repairs": _repairs(saved),
        "layers": layer_pictures(saved.layers(config), saved.grids.get(PASSED_BY)),
        "trajectory": path,
        "limits": [*scan_limits, *path_limits],
        **_what_if(saved, config),
    }


def _what_if(saved: MapContents, config: Config) -> dict[str, Any]:
    """Return influences and elimination order, see `slam.graph.influence`.

    Edges are those of the graph, and after them the matched loop candidates that never came into it, in
    order: so they are numbered in the page, too.
    """
    factors = [factor.edge for factor in saved.factors]
    edges = all_edges(factors, saved.loops)
    kept = [factor.kept for factor in saved.factors] + [False] * (len(edges) - len(factors))
    size = 3 if saved.planar else 6
    effect = influences(saved.node_poses, edges, kept)
    give_back()
    return {
        "influence": {
            "edge": effect.edges.astype(np.int32),
            "shift_m": effect.shifts_m.astype(np.float32),
            "node": effect.nodes.astype(np.int32),
            "residual": effect.residuals.astype(np.float32),
            "left_out": effect.left_out.astype(np.float32),
            # Squared sigmas exceeded by one in a thousand true loops: for one loop, two and so on.
            "gates": np.array([gate(size * n) for n in range(1, max(len(effect.edges), 1) + 1)], np.float32),
            # Loops within a local map of each other at both ends are one claim.
            "reach": config.match.local_map_keyframes,
        },
        "order": elimination_order(len(saved.node_poses), edges).astype(np.int32),
    }


def pose_rows(poses: Sequence[Pose]) -> FloatArray:
    """Return (N, 3) x, y, yaw of planar poses; (N, 7) x, y, z and a quaternion (x, y, z, w) in 3D."""
    if poses and isinstance(poses[0], gtsam.Pose2):
        return np.array([row_from_pose2(pose) for pose in poses])
    return np.array([row_from_pose(pose) for pose in poses], np.float64).reshape(-1, 7)


def way_data(
    trajectory: Trajectory, sigmas: tuple[NDArray[np.float32], NDArray[np.float32]]
) -> tuple[dict[str, Any], list[str], slice]:
    """Return the thinned path over time, lines about it, and the indices of its poses."""
    count = len(trajectory)
    chosen = slice(None, None, max(1, -(-count // _POSES)))
    part = trajectory[chosen]
    steps_s = np.diff(part.stamps_s)
    speed = np.full(len(part), np.nan, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.linalg.norm(np.diff(part.positions_m, axis=0), axis=1) / steps_s
    if len(part) > 1:
        speed[1:] = np.where(steps_s > 0.0, moved, np.nan)
    data = {
        "stamps_s": part.stamps_s,
        "xy": part.positions_m[:, :2].astype(np.float32),
        "z": part.positions_m[:, 2].astype(np.float32),
        "yaw": part.to_planar()[:, 2].astype(np.float32),
        "sigma_m": sigmas[0][chosen],
        "yaw_sigma": sigmas[1][chosen],
        "speed": speed,
    }
    limits = [] if chosen.step == 1 else [f"Trajectory: {len(part):,} of {count:,} poses, evenly sampled."]
    return data, limits, chosen


def _way(
    saved: MapContents, rows: NDArray[np.intp], sigmas: tuple[NDArray[np.float32], NDArray[np.float32]]
) -> tuple[dict[str, Any], list[str]]:
    """Return the path of the map, and the source of each step: the most certain inlier edge to it."""
    data, limits, chosen = way_data(saved.trajectory, sigmas)
    kinds = sorted({str(factor.edge.kind) for factor in saved.factors if factor.edge.loop is None})
    sources, spread = np.full(len(saved.node_poses), len(kinds), np.uint8), dict[int, float]()
    for factor in saved.factors:
        edge = factor.edge
        if factor.kept and edge.loop is None and edge.target == edge.source + 1:
            size = float(np.trace(edge.covariance))
            if size < spread.get(edge.target, np.inf):
                spread[edge.target] = size
                sources[edge.target] = kinds.index(str(edge.kind))
    sources[:1] = sources[1:2] if len(sources) > 1 else len(kinds)
    numbers, before = np.arange(len(saved.trajectory))[chosen], np.maximum.accumulate(rows)
    data["source"], data["node"] = np.zeros(len(numbers), np.uint8), np.zeros(len(numbers), np.int32)
    if len(rows):
        data["source"] = sources[np.minimum(np.searchsorted(before, numbers), len(rows) - 1)]
        data["node"] = np.maximum(np.searchsorted(before, numbers, side="right") - 1, 0).astype(np.int32)
    return {**data, "sources": [*kinds, "nothing"]}, limits


def _rows_of_nodes(saved: MapContents, sessions: Sequence[MapSession]) -> NDArray[np.intp]:
    """Return (K,) the trajectory pose of each node: the nearest stamp of its session."""
    stamps_s = saved.trajectory.stamps_s
    if not len(stamps_s):
        return np.zeros(0, np.intp)
    rows, node, pose = [], 0, 0
    for keyframes, poses in [(one.keyframes, one.poses) for one in sessions] or [
        (len(saved.stamps_s), len(stamps_s))
    ]:
        part = nearest_indices(stamps_s[pose : pose + poses], saved.stamps_s[node : node + keyframes])
        rows.append(part + pose)
        node, pose = node + keyframes, pose + poses
    return np.concatenate(rows)


def _sigmas(saved: MapContents) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (N,) the largest sigma of each position, and of the yaw, radians; NaN if unknown."""
    covariances = saved.covariances
    if covariances is None:
        unknown = np.full(len(saved.trajectory), np.nan, np.float32)
        return unknown, unknown
    positions, yaws = sigmas_of(covariances)
    return positions.astype(np.float32), yaws.astype(np.float32)


def _plane_covariances(covariances: FloatArray | None, rows: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return (K, 3) xx, xy, yy of the nodes' positions; empty if unknown."""
    if covariances is None or not len(rows):
        return np.zeros((0, 3), np.float32)
    chosen = covariances[rows]
    return np.column_stack([chosen[:, 0, 0], chosen[:, 0, 1], chosen[:, 1, 1]]).astype(np.float32)


def _edges(factors: Sequence[SavedFactor], planar: bool) -> dict[str, Any]:
    """Return the graph's edges."""
    edges = [factor.edge for factor in factors]
    kinds = sorted({str(edge.kind) for edge in edges})
    return {
        "source": np.array([edge.source for edge in edges], np.int32),
        "target": np.array([edge.target for edge in edges], np.int32),
        "kind": np.array([kinds.index(str(edge.kind)) for edge in edges], np.uint8),
        "kinds": kinds,
        "kept": np.array([factor.kept for factor in factors], np.uint8),
        "trusted": np.array([edge.trusted for edge in edges], np.uint8),
        "loop": np.array([-1 if edge.loop is None else edge.loop for edge in edges], np.int32),
        "measured": _rows_of([edge.T_source_target for edge in edges], planar),
        "covariance": _triangles([edge.covariance for edge in edges], planar),
    }


def _loops(loops: Sequence[LoopCandidate], factors: Sequence[SavedFactor], planar: bool) -> dict[str, Any]:
    """Return every loop candidate; NaN without a match."""
    reasons = sorted({loop.reason for loop in loops})
    numbers = {reason: number for number, reason in enumerate(reasons)}
    edges = np.full(len(loops), -1, np.int32)
    for number, factor in enumerate(factors):
        if factor.edge.loop is not None and factor.edge.loop < len(loops):
            edges[factor.edge.loop] = number
    matched = [number for number, loop in enumerate(loops) if loop.motion is not None]
    motions = [loop.motion for loop in loops if loop.motion is not None]
    return {
        "place": np.array([loop.place for loop in loops], np.int32),
        "keyframe": np.array([loop.keyframe for loop in loops], np.int32),
        "accepted": np.array([loop.accepted for loop in loops], np.uint8),
        "score": _of_loops(loops, "inlier_share"),
        "search": np.array([loop.score for loop in loops], np.float32),
        "residual_m": _of_loops(loops, "residual_m"),
        "half_width_m": np.array([loop.half_width_m for loop in loops], np.float32),
        "reason": np.array([numbers[loop.reason] for loop in loops], np.uint16),
        "reasons": reasons,
        "edge": edges,
        # Of matched candidates: index, pose of the keyframe relative to the place, covariance.
        "matched": np.array(matched, np.int32),
        "measured": _rows_of([motion.T_reference_base for motion in motions], planar),
        "covariance": _triangles([motion.covariance for motion in motions], planar),
    }


def _of_loops(loops: Sequence[LoopCandidate], name: str) -> NDArray[np.float32]:
    """Return a number of the loops' matches; NaN if there is none."""
    values = [np.nan if loop.motion is None else getattr(loop.motion, name) for loop in loops]
    return np.array(values, np.float32)


def _rows_of(poses: Sequence[Pose], planar: bool) -> FloatArray:
    """Return `pose_rows`, with the correct width if empty."""
    return pose_rows(poses).reshape(-1, 3 if planar else 7)


def _triangles(covariances: Sequence[FloatArray], planar: bool) -> FloatArray:
    """Return (N, 6) or (N, 21) upper triangles."""
    size = 3 if planar else 6
    return upper_triangles(np.array(covariances, np.float64).reshape(-1, size, size))


def _scans(scans: Sequence[LaserScan | None], count: int) -> tuple[dict[str, Any], list[str]]:
    """Return thinned points of the keyframes' scans, base frame, and a line about it."""
    total = sum(scan.ranges_m.size for scan in scans if scan is not None)
    step = max(1, -(-total // _SCAN_POINTS))
    parts = [
        np.zeros((0, 2), np.int16) if scan is None else _centimetres(_points_base(scan)[::step])
        for scan in scans or [None] * count
    ]
    limits = [] if step == 1 else [f"Scans: one point in {step}."]
    return _stacked(parts), limits


def _repairs(saved: MapContents) -> dict[str, Any]:
    """Return the changes of the scans by fusion, base frame: kind 0 new, 1 moved, 2 old position."""
    parts, kinds = [], []
    total = sum(scan.ranges_m.size for scan in saved.keyframe_scans if scan is not None)
    step = max(1, -(-total // _SCAN_POINTS))
    for before, after in zip(saved.measured_scans, saved.keyframe_scans, strict=False):
        if before is None or after is None or before is after:
            parts.append(np.zeros((0, 2), np.int16))
            continue
        was, now = np.isfinite(before.ranges_m), np.isfinite(after.ranges_m) & (after.ranges_m > 0.0)
        changed = now & (after.ranges_m != before.ranges_m)
        chosen = [(after, changed & ~was), (after, changed & was), (before, changed & was)]
        rows = [_centimetres(_points_base(scan, which)[::step]) for scan, which in chosen]
        parts.append(np.vstack(rows))
        kinds.append(np.repeat(np.arange(3, dtype=np.uint8), [len(row) for row in rows]))
    stacked = _stacked(parts)
    return {**stacked, "kind": np.concatenate(kinds) if kinds else np.zeros(0, np.uint8)}


def _points_base(scan: LaserScan, which: NDArray[np.bool_] | None = None) -> FloatArray:
    """Return (N, 2) points of a scan, or of some of its beams, base frame."""
    if which is not None:
        scan = replace(scan, ranges_m=np.where(which, scan.ranges_m, np.float32(np.nan)))
    return transform_points(scan.points_laser(), row_from_pose2(scan.T_base_laser))


def _centimetres(points: FloatArray) -> NDArray[np.int16]:
    """Round to centimetres; points are clipped at 327 m."""
    return np.clip(np.rint(_CM_A_METRE * points), -_FARTHEST_CM, _FARTHEST_CM).astype(np.int16)


def _stacked(parts: Sequence[NDArray[np.int16]]) -> dict[str, Any]:
    """Return points of all keyframes, and the start index of each."""
    first = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int32)
    return {"first": first, "points": np.vstack(parts) if parts else np.zeros((0, 2), np.int16)}
