"""Parts of the mapper that work on plain arrays: match two scans, check a loop, build a grid.

The pose graph is `slam.graph.pose_graph.PoseGraph`; the fusion of lidar and depth is in package `fusion`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from slam.config import Config, config_of
from slam.errors import ScanweaveError
from slam.estimates import MotionEstimate
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import search_place
from slam.graph.submaps import Submap
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.scan_points import extract_points, orient_points
from slam.measurements import AnyFloatArray, LaserScan, numbers_of
from slam.storage.measurement_soundness import checked

Scan: TypeAlias = LaserScan | AnyFloatArray


def match_scans(
    reference: Scan | Sequence[Scan],
    scan: Scan,
    guess: ArrayLike = (0.0, 0.0, 0.0),
    *,
    reference_poses: ArrayLike | None = None,
    config: Config | None = None,
) -> MotionEstimate:
    """Match a scan to one or more scans by point-to-line alignment from a guess (metric of Censi 2008).

    It converges to the nearest match, within some 0.3 m and 0.3 rad of the guess; `check_loop` searches.

    Parameters
    ----------
    reference
        The scan to match to: a `slam.LaserScan`, or (N, 2) points of one sweep in metres, seen from the
        origin of their frame (x forward, y left); or a list of these.
    scan
        The scan to match, in its own base frame.
    guess
        (3,) x, y, yaw: the expected pose of the scan's base in the reference frame; metres, radians.
    reference_poses
        (K, 3) x, y, yaw of the bases of K references in one frame, the reference frame. None for a single
        reference: its base frame is then the reference frame.
    config
        `Config.scan` and `Config.match` are used; None for the defaults.

    Returns
    -------
    The pose of the scan's base in the reference frame, with its covariance, the share of inliers and whether
    a direction is degenerate (a corridor). Check ``inlier_share``: if it is low, there is no match.

    Raises
    ------
    ScanweaveError
        If an array has a wrong shape or is not finite, or the numbers of poses and references differ.

    Examples
    --------
    >>> import numpy as np, slam
    >>> bearings = np.linspace(-np.pi, np.pi, 361, endpoint=False)
    >>> def seen_from(x, y, yaw):  # (361, 2) points of the walls of a room of 6 m by 4 m
    ...     ways = np.column_stack([np.cos(bearings + yaw), np.sin(bearings + yaw)])
    ...     far = ((np.array([3.0, 2.0]) - np.sign(ways) * [x, y]) / np.abs(ways)).min(axis=1)
    ...     return far[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    >>> motion = slam.match_scans(seen_from(0, 0, 0), seen_from(0.2, 0.1, 0.05))
    >>> T = motion.T_reference_base
    >>> [round(value, 2) + 0.0 for value in (T.x(), T.y(), T.theta())]
    [0.2, 0.1, 0.05]
    >>> bool(motion.inlier_share > 0.9), motion.degenerate, motion.covariance.shape
    (True, False, (3, 3))
    """
    config = config_of(config)
    local_map = _local_map(reference, reference_poses, config)
    alignment = local_map.align(_oriented(scan, config), numbers_of(guess, (3,), "the guess"))
    return motion_from_alignment(alignment, config.match)


def check_loop(
    place: Scan | Sequence[Scan],
    scan: Scan,
    guess: ArrayLike = (0.0, 0.0, 0.0),
    *,
    place_poses: ArrayLike | None = None,
    half_width_m: float | None = None,
    half_yaw_rad: float | None = None,
    config: Config | None = None,
) -> LoopCandidate:
    """Check whether a scan was taken at a known place: search a window around a guess, refine, verify.

    The search is that of Olson 2009 by branch and bound (Hess 2016 Sec. V-B), as for the loops of a map. The
    result is refined as in `match_scans`.

    Parameters
    ----------
    place
        One or more scans of the known place, see `match_scans`.
    scan
        The scan that may have been taken there, in its own base frame.
    guess
        (3,) x, y, yaw: expected pose of the scan's base in the frame of the place; metres, radians.
    place_poses
        (K, 3) poses of K scans of the place, see `match_scans`.
    half_width_m, half_yaw_rad
        Half size of the search window in x and y, and in yaw. None uses ``0.5 * loops.reach_m`` and
        ``config.match.search_half_yaw_rad`` of the configuration.
    config
        `Config.loops`, `Config.scan` and `Config.match` are used; None for the defaults.

    Returns
    -------
    A candidate that is ``accepted``, or has a ``reason``. ``motion`` is the pose of the scan's base in the
    frame of the place, None if no pose in the window fits. The place is node 0, the scan node 1; set those of
    your graph with `dataclasses.replace`. A single scan can be ambiguous: add the loop as untrusted, and
    let `slam.PoseGraph.optimize` decide together with the other edges.

    Raises
    ------
    ScanweaveError
        If an array has a wrong shape or is not finite, the numbers of poses and scans differ, or the window
        is negative or not finite.

    Examples
    --------
    >>> import numpy as np, slam
    >>> bearings = np.linspace(-np.pi, np.pi, 361, endpoint=False)
    >>> def seen_from(x, y, yaw, width_m=4.0):  # (361, 2) points of the walls of a room 6 m long
    ...     ways = np.column_stack([np.cos(bearings + yaw), np.sin(bearings + yaw)])
    ...     far = ((np.array([3.0, width_m / 2]) - np.sign(ways) * [x, y]) / np.abs(ways)).min(axis=1)
    ...     return far[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    >>> loop = slam.check_loop(seen_from(0, 0, 0), seen_from(1.0, 0.5, 0.3))
    >>> T = loop.motion.T_reference_base
    >>> loop.accepted, [round(value, 2) for value in (T.x(), T.y(), T.theta())]
    (True, [1.0, 0.5, 0.3])
    >>> other = slam.check_loop(seen_from(0, 0, 0), seen_from(1.0, 0.5, 0.3, width_m=9.0))
    >>> other.accepted, other.reason
    (False, 'no pose in the window scores high enough')
    """
    config = config_of(config)
    loops = config.loops
    width = 0.5 * loops.reach_m if half_width_m is None else half_width_m
    yaw = config.match.search_half_yaw_rad if half_yaw_rad is None else half_yaw_rad
    width, yaw = numbers_of([width, yaw], (2,), "half_width_m, half_yaw_rad").tolist()
    if not (width >= 0.0 and 0.0 <= yaw <= np.pi):
        raise ScanweaveError(
            f"a window of half_width_m={width:g} half_yaw_rad={yaw:g} cannot be searched: give finite sizes "
            "from 0 on, yaw up to pi"
        )
    local_map = _local_map(place, place_poses, config)
    return search_place(
        LoopCandidate(0, 1, width, yaw, 1.0, None, False, ""),
        Submap(lambda: local_map, config.match.cell_m),
        _oriented(scan, config),
        numbers_of(guess, (3,), "the guess"),
        loops,
        config.match,
    )


def grid_of_scans(
    scans: Sequence[LaserScan], poses: ArrayLike, config: Config | None = None
) -> OccupancyGrid:
    """Build the occupancy grid of scans at known poses: Li2020 Eq. (1), (7), (8).

    Parameters
    ----------
    scans
        K sweeps.
    poses
        (K, 3) x, y, yaw of the robot's base at each, map frame; metres, radians.
    config
        `Config.grid` is used; None for the defaults.

    Returns
    -------
    A grid with cells of ``grid.resolution_m``; ``states()`` is (rows, cols) with 100 for occupied, 0 for free
    and -1 for unknown; row 0 has the lowest y.

    Raises
    ------
    ScanweaveError
        If there is no scan, the numbers of poses and scans differ, a pose is not finite, or the grid would
        have too many cells.

    Examples
    --------
    >>> import numpy as np, slam
    >>> bearings = np.linspace(-np.pi, np.pi, 361, endpoint=False)
    >>> def seen_from(x, y, yaw):  # the walls of a room of 6 m by 4 m
    ...     ways = np.column_stack([np.cos(bearings + yaw), np.sin(bearings + yaw)])
    ...     far = ((np.array([3.0, 2.0]) - np.sign(ways) * [x, y]) / np.abs(ways)).min(axis=1)
    ...     return slam.LaserScan(0.0, far.astype(np.float32), -np.pi, 2 * np.pi / 361, 20.0)
    >>> poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.3], [1.0, 0.4, 0.6]])
    >>> grid = slam.grid_of_scans([seen_from(*pose) for pose in poses], poses)
    >>> rows, columns = (grid.states() == 100).nonzero()
    >>> [round(np.ptp(cells) * grid.resolution_m) for cells in (columns, rows)]
    [6, 4]
    """
    config = config_of(config)
    if not isinstance(scans, Sequence) or not all(isinstance(scan, LaserScan) for scan in scans):
        raise ScanweaveError("a grid is built from a list of slam.LaserScan; its poses are a second list")
    scans = [checked(scan, f"scan {number}") for number, scan in enumerate(scans)]
    rows = numbers_of(poses, (len(scans), 3), f"the poses of {len(scans)} scans")
    grid = grid_of_keyframes(scans, rows, config)
    if grid is None:
        raise ScanweaveError("no scan was given to build a grid from")
    return grid


def _local_map(scans: Scan | Sequence[Scan], poses: ArrayLike | None, config: Config) -> LocalMap:
    """Build a local map of one scan in its own frame, or of several at their poses."""
    if not isinstance(scans, Sequence):
        scans = [scans]
    if poses is None and len(scans) == 1:
        poses = np.zeros((1, 3))
    if poses is None or not len(scans):
        raise ScanweaveError(f"{len(scans)} scans without poses make no place; give each its x, y, yaw")
    rows = numbers_of(poses, (len(scans), 3), f"the poses of {len(scans)} scans")
    parts = [_oriented(scan, config).moved(row) for scan, row in zip(scans, rows, strict=True)]
    return LocalMap.build(parts, config.match)


def _oriented(scan: Scan, config: Config) -> OrientedPoints:
    """Return the points of a scan that have a normal, base frame."""
    limits = config.scan.range_min_m, config.scan.range_max_m, config.scan.neighbours
    if isinstance(scan, LaserScan):
        return OrientedPoints.from_scan(extract_points(checked(scan, "the scan"), *limits))
    return OrientedPoints.from_scan(orient_points(numbers_of(scan, (None, 2), "a scan"), *limits))
