"""Track moving objects from scan to scan of a 2D lidar, and remove their beams from the keyframe scans.

Keyframes alone cannot distinguish a person who stands still for a while from a chair. But the person came and
went: the space was seen free shortly before or shortly after.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel
from fusion.time_alignment import GAP_S
from slam.matching.object_evidence import GAP_M, LONGEST_M
from slam.matching.planar import compose
from slam.measurements import BoolArray, FloatArray, LaserScan, row_from_pose2
from slam.spool import ArraySpool


class _Sweep(NamedTuple):
    """The small objects of a scan.

    Attributes
    ----------
    scan, laser, reach_m
        The scan, (3,) pose of its laser in the odometry frame, and its range.
    beams, points, begun
        (M,) the beams that hit them, (M, 2) their ends, odometry frame, and (T + 1,) first beam of each.
    moves
        (2, T) by the scans before and by those after: 2 if it moves, 1 if only this scan shows that it
        moves, else 0.
    """

    scan: LaserScan
    laser: FloatArray
    reach_m: float
    beams: NDArray[np.int32]
    points: FloatArray
    begun: NDArray[np.int32]
    moves: NDArray[np.int8]

    @classmethod
    def of(cls, scan: LaserScan, pose: FloatArray, reach_m: float) -> _Sweep:
        """Create it from a scan with the base at a pose (3,)."""
        laser, size = compose(pose, row_from_pose2(scan.T_base_laser)), scan.ranges_m.size
        beams, points, begun = np.empty(size, np.int32), np.empty((size, 2)), np.zeros(size + 1, np.int32)
        beams_of = scan.ranges_m, scan.start_angle_rad, scan.step_rad, reach_m
        things = _small_things(laser, *beams_of, GAP_M, LONGEST_M, beams, points, begun)
        count, moves = begun[things], np.zeros((2, things), np.int8)
        small = beams[:count].copy(), points[:count].copy(), begun[: things + 1].copy()
        return cls(scan, laser, reach_m, *small, moves)

    def free_in(self, other: _Sweep, free: BoolArray) -> bool:
        """Clear ``free`` (M,) where another scan did not see free space; return whether any is left."""
        scan = other.scan
        beams = scan.ranges_m, scan.start_angle_rad, scan.step_rad, other.reach_m
        return bool(_seen_free(self.points, other.laser, *beams, GAP_M / 2, free))

    def follow(self, other: _Sweep, side: int, free: BoolArray | None = None) -> bool:
        """Mark moving objects, by those of an adjacent scan and ``free`` (M,); return whether any is new."""
        free = np.zeros(len(self.beams), np.bool_) if free is None else free
        theirs = other.points, other.begun, other.moves[side]
        return bool(_follow(self.points, self.begun, free, *theirs, GAP_M, self.moves[side]))


class MovingThings:
    """Tracks moving objects in the scans of a run.

    An object is a small connected set of points. It moves if a third of it was seen free at both of two
    moments before, or after, and so was the object there in the previous scan; or if that object moves: a
    person who stands still is followed. An object that moves away is followed back over the keyframes. A beam
    without a return is no evidence, because dark surfaces return none either.

    Parameters
    ----------
    range_max_m
        Longer readings are ignored.
    """

    def __init__(self, range_max_m: float) -> None:
        self._range_max_m = range_max_m
        # Those of two moments; so many of them are judged.
        self._sweeps, self._stamps_s = list[_Sweep](), list[float]()
        self._next_judged = 0
        self._keyframes: list[_Sweep | None] = []
        self._spool = ArraySpool()

    def add(self, scan: LaserScan, pose: FloatArray) -> None:
        """Add the next scan, with the base at a pose (3,) in the odometry frame."""
        if self._sweeps and not 0.0 < scan.stamp_s - self._stamps_s[-1] <= GAP_S:
            self.lose()
        self._sweeps.append(_Sweep.of(scan, pose, min(self._range_max_m, scan.range_max_m)))
        self._stamps_s.append(scan.stamp_s)
        while scan.stamp_s - self._stamps_s[self._next_judged] >= 2 * GAP_S:
            self._judge()
        old = max(bisect_right(self._stamps_s, self._stamps_s[self._next_judged] - 2 * GAP_S) - 1, 0)
        del self._sweeps[:old], self._stamps_s[:old]
        self._next_judged -= old

    def lose(self) -> None:
        """Restart: the pose of the next scan relative to the previous ones is unknown."""
        while self._next_judged < len(self._sweeps):
            self._judge()
        self._sweeps, self._stamps_s, self._next_judged = [], [], 0

    def keep(self, scan: LaserScan | None) -> None:
        """Mark the newest scan as a keyframe; for another scan, nothing is known."""
        newest = self._sweeps[-1] if self._sweeps else None
        if newest is None or newest.scan is not scan:
            self._keyframes.append(None)
            return
        keep = self._spool.keep
        self._sweeps[-1] = newest._replace(
            beams=keep(newest.beams),
            points=keep(newest.points),
            begun=keep(newest.begun),
            moves=keep(newest.moves),
        )
        self._keyframes.append(self._sweeps[-1])

    def taken_from(self, scans: Sequence[LaserScan | None]) -> list[LaserScan | None]:
        """Return the keyframe scans, repaired or not; the beams of moving objects become negative."""
        self.lose()
        remaining = list(scans)
        for key, (scan, sweep) in enumerate(zip(scans, self._keyframes, strict=True)):
            moves = sweep is not None and (sweep.moves == 2).any(axis=0)
            if scan is not None and sweep is not None and np.any(moves):
                beams = sweep.beams[np.repeat(moves, np.diff(sweep.begun))]
                ranges_m = scan.ranges_m.copy()
                ranges_m[beams] = -np.abs(ranges_m[beams])
                remaining[key] = replace(scan, ranges_m=ranges_m)
        return remaining

    def _judge(self) -> None:
        """Find the moving objects in the next scan that is not judged yet."""
        sweeps, number = self._sweeps, self._next_judged
        sweep, now_s = sweeps[number], self._stamps_s[number]
        self._next_judged += 1
        adjacent = sweeps[max(number - 1, 0)]
        # A walking person leaves the old place completely in the longer time, partly in the shorter one.
        away_s = GAP_S, 2 * GAP_S
        before = [bisect_right(self._stamps_s, now_s - ago_s) - 1 for ago_s in away_s]
        after = [bisect_left(self._stamps_s, now_s + in_s) for in_s in away_s]
        for side, others in enumerate((before, after)):
            some = min(others) >= 0 and max(others) < len(sweeps)
            free = (np.ones if some else np.zeros)(len(sweep.beams), np.bool_)
            for other in others:
                some = some and sweep.free_in(sweeps[other], free)
            if some or np.count_nonzero(adjacent.moves[side]):
                sweep.follow(adjacent, side, free)
        follower = sweep
        for keyframe in reversed(self._keyframes):
            if keyframe is None:
                break
            if keyframe.scan.stamp_s < now_s:
                if not keyframe.follow(follower, 1):
                    break
                follower = keyframe


@kernel
def _small_things(  # type: ignore[no-untyped-def]
    laser, ranges_m, start_rad, step_rad, reach_m, apart_m, widest_m, beams, points, begun
):
    """Write the beams, points and starts of the small objects of `_Sweep`; return their number."""
    things, count, small = ZERO, ZERO, True
    cos, sin = math.cos(laser[2] + start_rad), math.sin(laser[2] + start_rad)
    turn_cos, turn_sin = math.cos(step_rad), math.sin(step_rad)
    for beam in range(ranges_m.size + 1):
        range_m = 0.0
        x = math.inf
        y = math.inf
        if beam < ranges_m.size:
            range_m = np.float64(ranges_m[beam])
            x = laser[0] + range_m * cos
            y = laser[1] + range_m * sin
            cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
            if not 0.0 < range_m <= reach_m:
                continue
        first = np.int64(begun[things])
        if count > first and (x - points[count - 1, 0]) ** 2 + (y - points[count - 1, 1]) ** 2 > apart_m**2:
            if small and count - first > 2:
                things += 1
                begun[things] = count
                first = count
            count, small = first, True
        if beam < ranges_m.size:
            beams[count] = beam
            points[count, 0] = x
            points[count, 1] = y
            small = small and (x - points[first, 0]) ** 2 + (y - points[first, 1]) ** 2 <= widest_m**2
            count += 1
    return things


@kernel
def _seen_free(  # type: ignore[no-untyped-def]
    points, laser, ranges_m, start_rad, step_rad, reach_m, margin_m, free
):
    """Clear ``free`` for points (M, 2) that a scan, by its beams there and beside, did not see as free.

    Returns whether any is left.
    """
    some = False
    cos, sin = math.cos(laser[2]), math.sin(laser[2])
    turn = abs(2.0 * math.pi / step_rad)
    for i in range(free.size):
        if free[i]:
            dx = points[i, 0] - laser[0]
            dy = points[i, 1] - laser[1]
            far_m = math.sqrt(dx * dx + dy * dy) + margin_m
            bearing_rad = math.atan2(cos * dy - sin * dx, cos * dx + sin * dy)
            beam = math.floor((bearing_rad - start_rad) / step_rad % turn + 0.5)
            aside = math.ceil(margin_m / abs(far_m * step_rad))
            for other in range(beam - aside, beam + aside + 1):
                free[i] = free[i] and 0 <= other < ranges_m.size and far_m < ranges_m[other] <= reach_m
            some = some or free[i]
    return some


@kernel
def _follow(  # type: ignore[no-untyped-def]
    points, begun, free, others, others_begun, others_move, apart_m, moves
):
    """Write `_Sweep.moves`, by which points (M, 2) were free, and the objects of an adjacent scan."""
    new = False
    for thing in range(moves.size):
        first, last = begun[thing], begun[thing + 1]
        size = last - first
        free_count = ZERO
        x = 0.0
        y = 0.0
        for i in range(first, last):
            free_count += free[i]
            x += points[i, 0] / size
            y += points[i, 1] / size
        motion = ZERO
        if 3 * free_count >= size and free_count > 2:
            motion += 1
        adjacent = ZERO
        for other in range(others_move.size):
            if others_move[other] > adjacent:
                begin, end = others_begun[other], others_begun[other + 1]
                dx = x
                dy = y
                for j in range(begin, end):
                    dx -= others[j, 0] / (end - begin)
                    dy -= others[j, 1] / (end - begin)
                if math.sqrt(dx * dx + dy * dy) < apart_m:
                    adjacent = np.int64(others_move[other])
        if motion + adjacent > 1:
            motion = 2
        new = new or motion > moves[thing]
        moves[thing] = max(moves[thing], motion)
    return new
