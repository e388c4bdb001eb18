"""Compute the floor plan of a finished map."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from fusion.estimation import TINY
from slam.config import Config
from slam.errors import ScanweaveError
from slam.graph.pose_covariances import joint_covariance, used_edges
from slam.mapping.doors import find_doors
from slam.mapping.floor_plan import FloorPlan, Length, Room, Wall
from slam.mapping.room_outline import Outline, area_m2, corners_of, room_outlines, seen_from
from slam.mapping.rooms import segment_rooms
from slam.mapping.sure_walls import sides_of, sure_walls
from slam.mapping.wall_fits import WallFit, fit_wall, straightened
from slam.mapping.wall_segments import wall_points, wall_segments
from slam.measurements import FloatArray
from slam.storage.map_contents import MapContents


def floor_plan(contents: MapContents, config: Config) -> FloorPlan:
    """The rooms of a map of a floor.

    Raises
    ------
    ScanweaveError
        If the map has no scans of a 2D lidar.
    """
    grid = contents.grid
    if grid is None or not contents.planar or not any(scan is not None for scan in contents.measured_scans):
        raise ScanweaveError("a floor plan is made of a 2D lidar's scans, and this map holds none")
    poses, scan = contents.keyframe_poses, config.scan
    points = wall_points(
        contents.measured_scans, poses, (scan.range_min_m, scan.range_max_m), scan.neighbours
    )
    cell_m = grid.resolution_m
    path_m = contents.trajectory.positions_m[:, :2]
    segments = wall_segments(points, cell_m, 3 * cell_m)
    rooms = segment_rooms(grid, segments, path_m)
    entered, owners = set(rooms.at(path_m).tolist()), seen_from(rooms, points)
    labels = range(1, int(rooms.labels.max(initial=0)) + 1)
    own = {label: points.chosen((owners == label).any(axis=0)) for label in labels}
    outlines = room_outlines(rooms, own, entered)
    fits: list[list[WallFit | None]] = []
    for label, outline in outlines.items():
        fits.append(
            [
                fit_wall(face, outline.ends(edge), own[label], poses, cell_m) if face.seen else None
                for edge, face in enumerate(outline.faces)
            ]
        )
    is_sure = iter(sure_walls(sides_of(outlines, fits), segments, rooms))
    fits = [[fit if next(is_sure) else None for fit in ones] for ones in fits]
    covariance = _covariance([fit for ones in fits for fit in ones if fit], contents, config)
    built, first = list[Room](), 0
    for (label, outline), ones in zip(outlines.items(), fits, strict=True):
        last = first + 2 * sum(fit is not None for fit in ones)
        own_covariance = covariance[first:last, first:last]
        built.append(_room(len(built) + 1, outline, ones, own_covariance, label in entered, cell_m))
        first = last
    return FloorPlan(built, find_doors(built, grid, points, path_m))


def _covariance(fits: Sequence[WallFit], contents: MapContents, config: Config) -> FloatArray:
    """(2 m, 2 m) of offset and slope of all walls: by the poses together, and by the points of each.

    The graph gives the correlation of the errors of poses; the walls give their size.
    """
    if not fits:
        return np.zeros((0, 0))
    edges = [factor.edge for factor in contents.factors]
    edges_used = used_edges(contents.node_poses, edges, [factor.kept for factor in contents.factors], config)
    poses = [pose for pose in contents.node_poses if isinstance(pose, gtsam.Pose2)]
    drifts = np.array([fit.drift.jacobian for fit in fits])
    joint = joint_covariance(poses, edges_used, np.concatenate([*(fit.jacobian for fit in fits), drifts]))
    count = 2 * len(fits)
    by_poses = joint[:count, :count] * unit_variance(fits, np.diag(joint)[count:])
    return by_poses + np.diag(np.concatenate([fit.noise for fit in fits]))


def unit_variance(fits: Sequence[WallFit], variances: FloatArray) -> float:
    """How far earlier and later scans of walls differ, squared, in variances; the claim is one wall."""
    informed = variances > TINY
    values = np.array([fit.drift.value for fit in fits])[informed]
    return float(1.0 + np.sum(values**2 / variances[informed])) / (1 + len(values))


def _room(
    number: int,
    outline: Outline,
    fits: Sequence[WallFit | None],
    covariance: FloatArray,
    entered: bool,
    cell_m: float,
) -> Room:
    """A room by its fitted walls."""
    turned, covariance = straightened([fit for fit in fits if fit is not None], covariance)
    rest = iter(turned)
    new = [next(rest) if fit is not None else None for fit in fits]
    faces = tuple(face if fit is None else fit.line() for face, fit in zip(outline.faces, new, strict=True))
    corners = corners_of(faces)
    if area_m2(corners) < 0.5 * area_m2(outline.corners_m):
        corners, faces = outline.corners_m, outline.faces
    shape = Outline(corners, faces)
    count = len(faces)
    at = np.cumsum([0, *(2 * (fit is not None) for fit in new)])
    area = np.zeros(len(covariance))
    walls = []
    for edge, fit in enumerate(new):
        begin, end = corners[edge], corners[(edge + 1) % count]
        if fit is None:
            walls.append(Wall(begin, end, None, np.zeros((0, 2))))
            continue
        first, last = fit.places(begin, end)
        reach = fit.reach(0.5 * (first + last))
        own = slice(at[edge], at[edge] + 2)
        area[own] = -float(np.hypot(*(end - begin))) * reach
        sigma = float(np.sqrt(reach @ covariance[own, own] @ reach))
        walls.append(Wall(begin, end, sigma, fit.seen_m(first, last, cell_m)))
    complete = all(fit is not None for fit in new)
    area_sigma = float(np.sqrt(area @ covariance @ area)) if complete else None
    lengths = _lengths(shape, new, at, covariance)
    return Room(number, walls, area_m2(corners), area_sigma, lengths, entered)


def _lengths(
    outline: Outline, fits: Sequence[WallFit | None], at: FloatArray, covariance: FloatArray
) -> list[Length]:
    """Between the outermost walls that face each other: along the longest wall of the room, and across it."""
    corners, faces = outline.corners_m, outline.faces
    sizes = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    middles = 0.5 * (np.roll(corners, -1, axis=0) + corners)
    lengths: list[Length] = []
    for normal in (
        faces[int(np.argmax(sizes))].normal,
        faces[int(np.argmax(sizes))].normal @ [[0, 1], [-1, 0]],
    ):
        sides = []
        for sign in (1.0, -1.0):
            facing = [k for k, face in enumerate(faces) if sign * (face.normal @ normal) > np.cos(np.pi / 8)]
            facing.sort(key=lambda k: sign * (middles[k] @ normal))
            sides.append(facing[0] if facing else None)
        one, other = sides
        if one is None or other is None or fits[one] is None or fits[other] is None:
            continue
        length = _between(one, other, outline, normal, fits, at, covariance)
        if length is not None:
            lengths.append(length)
    return lengths


def _between(
    one: int,
    other: int,
    shape: Outline,
    normal: FloatArray,
    fits: Sequence[WallFit | None],
    at: FloatArray,
    covariance: FloatArray,
) -> Length | None:
    """The distance of two walls."""
    across = np.array([normal[1], -normal[0]])
    # A fifth from the end of what both walls have, aside from the middle of the room.
    spans = np.sort([np.array(shape.edge(edge)) @ across for edge in (one, other)], axis=1)
    low, high = spans[:, 0].max(), spans[:, 1].min()
    place = (4 * low + high) / 5 if low < high else float(spans.mean())
    ends, weights = [], np.zeros(len(covariance))
    for edge in (one, other):
        fit = fits[edge]
        assert fit is not None
        line = fit.line()
        # Where the line has that place across.
        ends.append(
            line.point_m + (place - line.point_m @ across) / float(line.tangent @ across) * line.tangent
        )
        weights[at[edge] : at[edge] + 2] = -fit.reach(*fit.places(ends[-1]))
    length = float((ends[1] - ends[0]) @ normal)
    sigma = float(np.sqrt(weights @ covariance @ weights))
    return Length(ends[0], ends[1], length, sigma) if length > 0.0 else None
