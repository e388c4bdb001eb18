"""Rebuild a finished map: solve its graph and draw its evidence again, with edits and other settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from fusion.estimation import gate
from slam.config import Config, leaves, with_settings
from slam.edits.evidence import scans_without
from slam.edits.keyframes import bases_of
from slam.edits.loops import edited_loops
from slam.errors import ConfigError
from slam.graph.edge import Edge
from slam.graph.held_graph import held_graph
from slam.graph.loop_candidate import judged
from slam.graph.pose_covariances import pose_covariances
from slam.graph.pose_graph import PoseGraph
from slam.mapper.lidar3d import band_scans
from slam.mapper.map_result import drawn
from slam.mapping.elevation import elevation
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.mapping.polygons import cells_inside
from slam.measurements import BoolArray, FloatArray, LaserScan, Pose, spatial
from slam.storage.map_contents import MapContents, SavedFactor, parts_of
from slam.storage.map_edits import CLOUD, FRAME, MEASURED, REPAIRED, AppliedEdits, erased_bits, regions_of
from slam.storage.map_sessions import MapSession
from slam.trajectory.poses import Poses
from slam.trajectory.resettled import resettled

# Settings of drawing and output of keyframes, and settings that only later commands use.
_FREE = ("grid.", "layers.", "dense_map.", "cloud_map.", "localization.", "cloud_localization.")
# Settings of the graph that decide which loops are used.
_LOOPS = frozenset({"loops.enabled", "loops.inlier_probability", "loops.least_inlier_share"})
_FUSION = "fusion.enabled"


def remade_config(before: Config, entries: Sequence[AppliedEdits]) -> Config:
    """Return the settings of a map with edits.

    Raises
    ------
    ConfigError
        If a key is unknown, a value is invalid, or a setting needs the log.
    """
    changed = with_settings(before, [setting for entry in entries for setting in entry.settings])
    old, new = (dict(leaves(config.model_dump(mode="json"))) for config in (before, changed))
    for name in sorted({*old, *new}):
        if old.get(name) == new.get(name) or name.startswith(_FREE) or name in _LOOPS:
            continue
        if name == _FUSION and not new[name]:
            continue
        why = (
            "the map holds what each keyframe saw, not the images that repaired it"
            if name.startswith("fusion.")
            else "it was decided when the log was read"
        )
        raise ConfigError(
            f"{name} = {new.get(name)} takes the log: {why}; 'scanweave map LOG -s {name}={new.get(name)}'"
        )
    return changed


def turned_by(entries: Sequence[AppliedEdits]) -> gtsam.Pose2:
    """Return ``T_new_old`` of all edits together."""
    total = gtsam.Pose2()
    for entry in entries:
        total = total if entry.turned is None else entry.turned.compose(total)
    return total


def remade(
    base: MapContents, entries: Sequence[AppliedEdits], before: Config, sessions: Sequence[MapSession]
) -> tuple[MapContents, list[str]]:
    """Rebuild a map with edits.

    Unchanged data stay equal to the bit: without edits the result is the unedited map.

    Parameters
    ----------
    base, before
        The unedited map and its settings.

    Returns
    -------
    The map, and one line for each item that cannot be drawn.

    Raises
    ------
    ScanweaveError
        If an edit does not fit, or a setting needs the log.
    """
    config = remade_config(before, entries)
    contents = replace(settled(base, entries, before, config, sessions), edits=list(entries))
    contents = _seen(contents, base, entries, before, config)
    contents, warnings = drawn(contents, config)
    for crop in regions_of(entries, "crop"):
        corners = crop.points(contents.keyframe_poses)
        grids = {name: _cropped(grid, corners) for name, grid in contents.grids.items()}
        contents = replace(contents, grids={name: grid for name, grid in grids.items() if grid is not None})
    return contents, warnings


def settled(
    base: MapContents,
    entries: Sequence[AppliedEdits],
    before: Config,
    config: Config,
    sessions: Sequence[MapSession],
) -> MapContents:
    """Return a map with its graph solved and rotated; scans, images and grids are unchanged."""
    factors, loops = edited_loops(base, entries, before, config)
    poses = base.node_poses
    # Edges are compared by their source.
    if list(map(id, factors)) != list(map(id, base.factors)) or config.loops != before.loops:
        factors, poses = solved(base.node_poses, factors, before, config)
        edges = [factor.edge for factor in factors]
        loops = judged(loops, edges, [factor.kept for factor in factors])
    T_new_old = turned_by(entries)
    if not T_new_old.equals(gtsam.Pose2(), 0.0):
        poses = [_moved(pose, T_new_old) for pose in poses]
    if poses is base.node_poses:
        return replace(base, factors=factors, loops=loops)
    found = with_nodes(base, poses, factors, config, sessions)
    # Both remain in the file: the pose of the first node.
    return replace(found, loops=loops, georeference=None, places=None)


def with_nodes(
    base: MapContents,
    poses: Sequence[Pose],
    factors: Sequence[SavedFactor],
    config: Config,
    sessions: Sequence[MapSession],
) -> MapContents:
    """Return a map with its nodes at other poses; trajectory and covariances follow, nothing is drawn."""
    edges, kept = [factor.edge for factor in factors], [factor.kept for factor in factors]
    bases = bases_of(base, poses)
    trajectory, covariances = resettled(
        base.trajectory,
        base.stamps_s,
        Poses.of(bases_of(base, base.node_poses)),
        Poses.of(bases),
        parts_of(base, sessions),
        pose_covariances(poses, bases, edges, kept, config),
    )
    return replace(
        base, node_poses=list(poses), trajectory=trajectory, factors=factors, covariances=covariances
    )


def solved(
    poses: Sequence[Pose], factors: Sequence[SavedFactor], before: Config, config: Config
) -> tuple[list[SavedFactor], list[Pose]]:
    """Solve a graph again, starting from its poses and the edges kept then.

    Edges rejected or kept because of a changed edge may now be decided differently: if an edge newly
    contradicts its decision, all are decided again until nothing changes. Old contradictions are kept.
    """
    kept = np.array([factor.kept for factor in factors], np.bool_)
    certain = [replace(factor.edge, trusted=True) for factor in factors if factor.kept]
    graph = graph_of(poses, certain)
    graph.optimize()
    solution, edges = poses_of(graph), [factor.edge for factor in factors]
    old_probability, probability = before.loops.inlier_probability, config.loops.inlier_probability
    if _misfits(solution, edges, kept, probability) <= _misfits(poses, edges, kept, old_probability):
        return list(factors), solution
    graph = graph_of(solution, edges)
    graph.begin_with(kept)
    seen_decisions = set[bytes]()
    while kept.tobytes() not in seen_decisions:
        seen_decisions.add(kept.tobytes())
        kept = graph.optimize(probability).kept
    decided = [replace(factor, kept=bool(keep)) for factor, keep in zip(factors, kept, strict=True)]
    return decided, poses_of(graph)


def graph_of(poses: Sequence[Pose], edges: Sequence[Edge]) -> PoseGraph:
    """Build a graph of the nodes at their poses, and the edges."""
    graph = PoseGraph(poses[0])
    for pose in poses[1:]:
        graph.add_node(pose)
    for edge in edges:
        graph.add_edge(edge)
    return graph


def poses_of(graph: PoseGraph) -> list[Pose]:
    """Return the poses of its nodes."""
    return [graph.pose(node) for node in range(len(graph))]


def _misfits(poses: Sequence[Pose], edges: Sequence[Edge], kept: BoolArray, probability: float) -> set[int]:
    """Return untrusted edges that are on the other side of the gate than their decision."""
    graph, values = held_graph(poses, edges)
    limit = 0.5 * gate(len(edges[0].covariance), probability)
    return {
        number
        for number, edge in enumerate(edges)
        if not edge.trusted and (graph.at(number + 1).error(values) <= limit) != kept[number]
    }


def _moved(pose: Pose, T_new_old: gtsam.Pose2) -> Pose:
    """Return a pose in the rotated map."""
    if isinstance(pose, gtsam.Pose2):
        return T_new_old.compose(pose)
    return gtsam.Pose3(T_new_old).compose(pose)


def _unrepaired(measured: LaserScan | None, mended: LaserScan | None) -> LaserScan | None:
    """Return a scan as measured, without the readings removed from the repaired one as moving."""
    if measured is None or mended is None or not (mended.ranges_m < 0.0).any():
        return measured
    return replace(
        measured, ranges_m=np.where(mended.ranges_m < 0.0, -np.abs(measured.ranges_m), measured.ranges_m)
    )


def _seen(
    contents: MapContents, base: MapContents, entries: Sequence[AppliedEdits], before: Config, config: Config
) -> MapContents:
    """Return the map with the evidence that remains after edits and settings."""
    frames = base.frames and base.frames.without(erased_bits(entries, FRAME))
    clouds = base.clouds and base.clouds.without(erased_bits(entries, CLOUD))
    measured, mended = base.measured_scans, base.keyframe_scans
    repaired = any(one is not other for one, other in zip(measured, mended, strict=True))
    if config.fusion.enabled < before.fusion.enabled:
        mended, repaired = [_unrepaired(*both) for both in zip(measured, mended, strict=True)], False
    band = (config.layers.robot_height_m, config.layers.climb_m, config.cloud_map)
    if clouds is not None and band != (before.layers.robot_height_m, before.layers.climb_m, before.cloud_map):
        if repaired or base.ground_m is None:
            raise ConfigError(
                "layers.robot_height_m, layers.climb_m and cloud_map take the log where the fusion has "
                "repaired scans; 'fusion.enabled=false' beside them makes the map without it"
            )
        poses = [spatial(pose) for pose in base.node_poses]
        ground = elevation(clouds, poses, base.ground_m, config.cloud_map.plan_range_m)
        measured = mended = band_scans(clouds, poses, base.ground_m, ground, config)
    else:
        same = mended is measured
        uncut = scans_without(mended, erased_bits(entries, REPAIRED))
        alone = scans_without(measured, erased_bits(entries, MEASURED))
        # An unrepaired scan remains the same object.
        both = zip(measured, mended, alone, uncut, strict=True)
        mended = [one if same or scan is other else two for scan, other, one, two in both]
        measured = alone
    return replace(contents, frames=frames, clouds=clouds, measured_scans=measured, keyframe_scans=mended)


def _cropped(grid: OccupancyGrid, polygon: FloatArray) -> OccupancyGrid | None:
    """Return the cells of a grid with their centre in a polygon, without unknown borders; None if empty."""
    within = cells_inside(polygon, grid.steps.shape, grid.resolution_m, grid.T_map_grid)
    (at_rows,), (at_cols,) = np.nonzero(within.any(axis=1)), np.nonzero(within.any(axis=0))
    if not len(at_rows):
        return None
    box = slice(at_rows[0], at_rows[-1] + 1), slice(at_cols[0], at_cols[-1] + 1)
    steps = np.where(within, grid.steps, np.int16(0))[box]
    corner = np.array([at_cols[0], at_rows[0]]) * grid.resolution_m
    T_map_grid = grid.T_map_grid.compose(gtsam.Pose2(float(corner[0]), float(corner[1]), 0.0))
    return OccupancyGrid(np.ascontiguousarray(steps), grid.resolution_m, T_map_grid)
