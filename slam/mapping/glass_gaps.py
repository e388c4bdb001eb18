"""Detect glass that no beam hit at a right angle: wall gaps in which beams to objects behind are lost.

At a slant, a pane returns no beam: a part goes through, the rest is lost (Foster et al. 2013; Koch et al.
2017). A doorway loses none. But beams are also lost for other reasons: the object behind may be dark, or
beyond the range of the lidar. So only beams towards a known object count, and they are compared with how
often this object loses beams that do not come through the gap. An object is whatever stands in one square of
the floor, because behind a pane only single points of a wall are seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from fusion.bayes import evidence_steps
from fusion.estimation import CONFIDENCE, FEWEST
from slam.config import Config
from slam.mapping.doors import crossed
from slam.mapping.glass_panes import SHORTEST_M
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.occupancy_grid import OccupancyGrid, looked_up
from slam.mapping.wall_gaps import THICKEST_WALL_M, wall_gaps
from slam.mapping.wall_segments import Segment, wall_points, wall_segments
from slam.measurements import BoolArray, FloatArray, LaserScan, pose2_from_row


class _Beams(NamedTuple):
    """Beams that hit an object, and those that should have.

    Attributes
    ----------
    from_m, along
        (N, 2) origin of each in the map, and its direction.
    end_m
        (N,) range of each, or its expected range.
    thing, scan
        (N,) number of the object, and of the scan.
    lost
        (N,) no return.
    """

    from_m: FloatArray
    along: FloatArray
    end_m: FloatArray
    thing: NDArray[np.int64]
    scan: NDArray[np.int64]
    lost: BoolArray

    def chosen(self, which: BoolArray) -> _Beams:
        """Return some of the beams."""
        from_m, along, end_m, thing, scan, lost = self
        return _Beams(from_m[which], along[which], end_m[which], thing[which], scan[which], lost[which])


def with_glass(
    grid: OccupancyGrid, scans: Sequence[LaserScan | None], poses: FloatArray, config: Config
) -> OccupancyGrid:
    """Return the grid with its glass gaps closed.

    Parameters
    ----------
    scans
        Of a 2D lidar, in which ``inf`` is no return.
    poses
        (K, 3) map frame.
    """
    gaps = glass_gaps(grid, scans, poses, config)
    if not gaps:
        return grid
    cells = np.concatenate([grid.cells_of(gap.points(0.5 * grid.resolution_m)) for gap in gaps])
    cells = cells[((cells >= 0) & (cells < grid.shape)).all(axis=1)]
    steps = grid.steps.copy()
    steps[tuple(cells.T)] = evidence_steps(layer_settings(config).p_max)
    return OccupancyGrid(steps, grid.resolution_m, grid.T_map_grid)


def glass_gaps(
    grid: OccupancyGrid, scans: Sequence[LaserScan | None], poses: FloatArray, config: Config
) -> list[Segment]:
    """Find gaps in walls that contain glass; see `with_glass`.

    Gaps that the robot drove through, or that are shorter than the smallest pane, are excluded.
    """
    # By the model of the grid, no more beams than this pass an object in the gap.
    least = 1.0 - config.grid.miss_probability / (1.0 - config.grid.miss_probability)
    scan, cell_m = config.scan, grid.resolution_m
    beams = _beams(grid, scans, poses)
    if not beams.lost.any():
        return []
    things = beams.thing.max() + 1
    every, lost = (np.bincount(beams.thing[own], minlength=things) for own in (slice(None), beams.lost))
    points = wall_points(scans, poses, (scan.range_min_m, scan.range_max_m), scan.neighbours)
    segments = wall_segments(points, cell_m, 3 * cell_m)
    gaps = [gap for gap in wall_gaps(segments, grid)[0] if gap.length_m >= SHORTEST_M]
    return [
        gap
        for gap in gaps
        if not crossed(gap.begin_m, gap.end_m, poses[:, :2])
        and _loss(gap, beams, every, lost, cell_m) >= least
    ]


def _loss(
    gap: Segment, beams: _Beams, every: NDArray[np.int64], lost: NDArray[np.int64], cell_m: float
) -> float:
    """The share of beams lost in a gap but not by the objects behind it; 0 if it is not certain.

    By the likelihood ratio of glass, which has its own share of losses, to no glass. A scan has
    one vote per cell, because neighbouring beams are correlated. The result must be certain without the
    object with the most evidence, which may be dark. No part of the gap, half as long as the shortest pane,
    may decide alone, and the evidence of parts against glass must not be certain.

    Parameters
    ----------
    every, lost
        (T,) number of all beams to each object, and how many of them are lost.
    """
    share, _ = _crossings(gap, beams.chosen(beams.lost))
    if not ((share > 0.0) & (share < 1.0)).any():
        return 0.0
    share, hit_beams = _crossings(gap, beams)
    things = beams.thing[hit_beams]
    elsewhere = every - np.bincount(things, minlength=len(every))
    lost_there = lost - np.bincount(things[beams.lost[hit_beams]], minlength=len(every))
    usual = (FEWEST * lost.sum() / every.sum() + lost_there) / (FEWEST + elsewhere)
    through = (share > 0.0) & (share < 1.0)
    share, beams = share[through], beams.chosen(through)
    cells = math.ceil(gap.length_m / cell_m)
    vote = beams.scan * cells + (share * cells).astype(np.int64)
    _, vote, beams_a_vote = np.unique(vote, return_inverse=True, return_counts=True)
    weight = 1.0 / beams_a_vote[vote.ravel()]
    loss = float(np.average(beams.lost, weights=weight))
    without = usual[beams.thing]
    with_glass = np.maximum(without, loss)
    nats = weight * np.log(np.where(beams.lost, with_glass / without, (1.0 - with_glass) / (1.0 - without)))
    parts = np.bincount((share * math.ceil(2.0 * gap.length_m / SHORTEST_M)).astype(np.int64), nats)
    against, limit = float(parts[parts < 0.0].sum()), -math.log(1.0 - CONFIDENCE)
    least = max(limit + float(np.bincount(beams.thing, nats).max()), float(parts.max()))
    return loss if nats.sum() > least and against > -limit else 0.0


def _crossings(gap: Segment, beams: _Beams) -> tuple[FloatArray, BoolArray]:
    """Find where beams that end half a wall's thickness behind a gap cross it, and which pass the wall.

    Returns
    -------
    (N,) share of the gap, ``nan`` without a crossing; (N,) whether it passes everything within the thickness
    of a wall behind the gap: the other side of the wall, and objects in it.
    """
    along_x, along_y = ((gap.end_m - gap.begin_m) / gap.length_m).tolist()
    x, y = beams.from_m[:, 0] - gap.begin_m[0], beams.from_m[:, 1] - gap.begin_m[1]
    across = along_x * beams.along[:, 1] - along_y * beams.along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        at_m = (along_y * x - along_x * y) / across
        slope = (along_x * beams.along[:, 0] + along_y * beams.along[:, 1]) / across
        middle = along_x * x + along_y * y + at_m * slope * across
    middle[~((at_m > 0.0) & (beams.end_m - at_m > 0.5 * THICKEST_WALL_M))] = np.nan
    half = THICKEST_WALL_M * np.abs(slope)
    return middle / gap.length_m, (middle + half > 0.0) & (middle - half < gap.length_m)


def _beams(grid: OccupancyGrid, scans: Sequence[LaserScan | None], poses: FloatArray) -> _Beams:
    """Return all beams that hit an object, and all that are lost although one is in their path.

    An object is all obstacles in a square as wide as the smallest pane.
    """
    parts = []
    for scan_number, (scan, pose) in enumerate(zip(scans, poses, strict=True)):
        if scan is None:
            continue
        laser = pose2_from_row(pose).compose(scan.T_base_laser)
        angles = laser.theta() + scan.start_angle_rad + scan.step_rad * np.arange(scan.ranges_m.size)
        from_m = np.broadcast_to((laser.x(), laser.y()), (angles.size, 2))
        along = np.column_stack([np.cos(angles), np.sin(angles)])
        parts.append((from_m, along, scan.ranges_m, np.full(angles.size, scan_number)))
    from_m, along, ranges_m, number = (np.concatenate(column) for column in zip(*parts, strict=True))
    hit, lost = np.isfinite(ranges_m) & (ranges_m > 0.0), np.isposinf(ranges_m)
    # Beyond the range of nearly all returns, none is expected.
    reach_m = float(np.quantile(ranges_m[hit], CONFIDENCE)) if hit.any() else 0.0
    end_m = np.where(hit, ranges_m, 0.0).astype(np.float64)
    end_m[lost] = _first_met(grid, from_m[lost], along[lost], reach_m)
    cells = grid.cells_of(from_m + end_m[:, None] * along)
    near_wall = scipy.ndimage.binary_dilation(grid.steps > 0, iterations=2)
    known = (end_m > 0.0) & (looked_up(near_wall, cells) > 0)
    squares = cells // round(SHORTEST_M / grid.resolution_m) @ np.array([grid.shape[1], 1])
    _, thing = np.unique(squares, return_inverse=True)
    return _Beams(from_m, along, end_m, thing, number, lost).chosen(known)


def _first_met(grid: OccupancyGrid, from_m: FloatArray, along: FloatArray, reach_m: float) -> FloatArray:
    """Return (N,) the range of the first obstacle on each beam; 0 if there is none."""
    obstacle, step_m = grid.steps > 0, 0.5 * grid.resolution_m
    distance_m, open_beams = np.zeros(len(from_m)), np.arange(len(from_m))
    for at_m in np.arange(step_m, reach_m, step_m):
        hit = looked_up(obstacle, grid.cells_of(from_m[open_beams] + at_m * along[open_beams])) > 0
        distance_m[open_beams[hit]] = at_m
        open_beams = open_beams[~hit]
    return distance_m
