"""Estimates the rotation of a spinning lidar without point times from the distortion by its own motion.

A point measured ``t`` after the middle of a revolution is displaced by ``t (v + w x p)``, with the lidar's
velocities v and w. By its bearing, ``t`` is ``turn_s`` times (its share of the circle from the start of a
revolution, minus one half). Two clouds from different places see the same walls at different bearings: their
distances from each other's planes are linear in the pose, as in the alignment, and in ``turn_s``. Its sign is
the direction of rotation, and the start that explains most is the cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from typing import TypeAlias, TypeVar

import gtsam
import numpy as np

from fusion.estimation import FEWEST, ROUNDS, TINY, gate
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.datasets.corrections_in_space import bearings_rad, retimed, turn_times
from slam.doctor.finding import Finding, Remedy
from slam.doctor.imu import clock_findings
from slam.doctor.scan_motion import track_stretches
from slam.doctor.stretches import LASTS_S, MOST
from slam.matching.cloud_alignment import place_cloud
from slam.matching.cloud_points import SLICES, base_points, voxel_of
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray, LaserScan, PointCloud, pose2_from_row
from slam.odometry.cloud_tracker import CloudTracker

T = TypeVar("T")
# At least one of this many revolutions is recorded; thickness of planes in distorted clouds, in voxels.
_TURNS, _THICKNESS = 5, 0.2
_CUTS_RAD = np.arange(SLICES) * math.tau / SLICES


@dataclass(frozen=True, slots=True)
class Turn:
    """The rotation of a lidar.

    Attributes
    ----------
    turn_s, sigma_s
        Duration of a revolution, < 0 clockwise seen from above.
    cut_rad
        Bearing of its start and end.
    """

    turn_s: float
    sigma_s: float
    cut_rad: float

    def clock_sigma_s(self, imu_sigma_s: float) -> float:
        """Standard deviation of stamps that count as the middle of a revolution.

        Its start, middle and end are equally likely, if no IMU determines the clock better (``imu_sigma_s``).
        The estimated start is off by three slices (28 simulated logs: at most seven).
        """
        turn_s = abs(self.turn_s)
        return math.hypot(min(imu_sigma_s, 6**-0.5 * turn_s), 3 / SLICES * turn_s)

    def finding(self, kind: str, name: str, clock_sigma_s: float = 0.0) -> Finding:
        """The finding for a lidar; ``kind`` is its type in a calibration file."""
        sense, turn_s = "clockwise" if self.turn_s < 0.0 else "counter-clockwise", round(self.turn_s, 4)
        cut_deg = round(math.degrees(math.remainder(self.cut_rad, math.tau)), 1)
        entry = {"turn_s": turn_s, "cut_deg": cut_deg}
        within = ""
        if clock_sigma_s:
            entry["clock_sigma_s"] = round(clock_sigma_s, 4)
            within = f" to {clock_sigma_s:.3f} s (sigma)"
        return Finding(
            name,
            "turn",
            f"its points were measured in a revolution of {abs(turn_s):.3f} s, {sense}, that "
            f"begins at {cut_deg:.0f} degrees; stamps count as its middle{within}",
            "walls are distorted by the robot's own motion",
            ({kind: {name: entry}},),
            sure=True,
            value=turn_s,
        )

    def timed(self, cloud: PointCloud) -> PointCloud:
        """The cloud with point times, and the stamp in the middle of its revolution."""
        return replace(cloud, times_s=turn_times(cloud.points_lidar, self.turn_s, self.cut_rad))


def stamped(clock: Finding, lidar: str, turn_s: float, *, timed: bool) -> list[Finding]:
    """Explain an IMU's clock offset by the stamps of the lidar, if they are nearer to one end of a sweep.

    Drivers stamp the beginning of a sweep or its end; points without times are assigned to its middle, those
    with times to the beginning. What remains is the offset of the IMU's clock, which times leave none for.
    """
    ahead_s, off_s = clock.value or 0.0, turn_s if timed else 0.5 * turn_s
    if clock.kind != "clock" or clock.interval is None or abs(ahead_s) < 0.5 * off_s:
        return [clock]
    off_s = math.copysign(off_s, ahead_s)
    rest = clock_findings(clock.sensor, ahead_s - off_s, 0.5 * (clock.interval[1] - clock.interval[0]))
    if timed and (rest or ahead_s > 0.0):
        return [clock]
    text = f"its stamps are of the {'beginning' if off_s > 0.0 else 'end'} of a sweep, by the IMU"
    effect = f"poses are off by {abs(off_s):.3g} s in time"
    remedy: Remedy = {"lidars_3d": {lidar: {"clock_offset_s": round(-off_s, 4)}}}
    return [Finding(lidar, clock.kind, text, effect, (remedy,), sure=True, value=-off_s), *rest]


@dataclass(frozen=True, slots=True)
class _Moving:
    """A cloud, its pose, and the (6,) twist of the lidar."""

    cloud: PointCloud
    pose: gtsam.Pose3
    twist: FloatArray


_Pair: TypeAlias = tuple[_Moving, _Moving, float]
_Sums: TypeAlias = tuple[FloatArray, FloatArray]  # weights and sums (C,) of each cut
_Timed: TypeAlias = Callable[[PointCloud], PointCloud]


def turn_of(
    stretches: Sequence[Sequence[PointCloud]],
    interval_s: float,
    config: Config,
    by_scans: Iterable[Sequence[_Pair]] | None = None,
) -> Turn | None:
    """Rotation of a lidar without point times; None if nothing is distorted, or if it is not determined.

    Parameters
    ----------
    stretches
        Consecutive thinned clouds in the lidar's frame; as many stretches are used as needed.
    interval_s
        Interval of clouds: a whole number of revolutions.
    by_scans
        For a 2D lidar, see `_pairs_of_scans`: in most logs it is soon clear that nothing is distorted.
    """
    if interval_s <= 0.0 or not stretches:
        return None
    if by_scans is not None and not (_sees_around(stretches[0]) and _bends(by_scans, interval_s, config)):
        return None
    while len(stretches) < 4 and len(stretches[0]) >= FEWEST:  # for a short log
        stretches = [half for one in stretches for half in (one[: len(one) // 2], one[len(one) // 2 :])]
    bends = _bends((_pairs(clouds, config) for clouds in _spread_out(stretches)), interval_s, config)
    return _settled(*bends, interval_s, config, by_scans is not None) if bends else None


def unit_of(span_s: float, interval_s: float) -> float:
    """Power of ten by which the times of a cloud's points exceed the time between clouds; 1 if none fits.

    From a thousand on, nearly: that is a unit of time. Below, clouds may come seldom, so within a twentieth.
    """
    ratio = math.log10(max(span_s, TINY) / max(interval_s, TINY))
    thousands, tens = 3 * round(ratio / 3), round(ratio)
    if thousands and abs(ratio - thousands) < 0.5:
        return 10.0**thousands
    return 10.0**tens if abs(10 ** (ratio - tens) - 1.0) < 1.0 / FEWEST else 1.0


def times_scale(
    stretches: Sequence[Sequence[PointCloud]], turn_s: float, interval_s: float, config: Config
) -> float:
    """Return the factor on the times of points: of another unit, of half the rate, or reversed (-1).

    Revolutions do not last longer than the time between clouds. Shorter ones by less than a thousand, and
    reversed times, count only if clouds of four stretches fit better, by twice what chance may do.
    """
    unit = unit_of(turn_s, interval_s)
    if unit > 1.0 or unit < 1.0 / 500:
        return 1.0 / unit
    if interval_s and abs(turn_s / interval_s / 2.0 - 1.0) < 1.0 / FEWEST:
        return 0.5
    pairs = [pair for clouds in islice(_spread_out(stretches), 5) for pair in _pairs(clouds, config)]
    told = _agreed(pairs, lambda cloud: cloud, config) if len(pairs) > 9 else []
    for scale in [-1.0, *([1.0 / unit] if unit < 1.0 else [])] if told else []:
        if _gain(_agreed(pairs, partial(retimed, scale=scale), config), told) > 2:
            return scale
    return 1.0


def turn_in_the_plane(
    stretches: Sequence[Sequence[LaserScan]], interval_s: float, config: Config
) -> Turn | None:
    """Like `turn_of`, for a 2D lidar."""
    short = _short(stretches)
    walls = [[_extruded(scan) for scan in scans] for scans in short]
    by_scans = (_pairs_of_scans(scans, config) for scans in _spread_out(short))
    return turn_of(walls, interval_s, config, by_scans)


def turn_by_beam_times(stretches: Sequence[Sequence[LaserScan]], config: Config) -> Turn | None:
    """The rotation of a 2D lidar with ``beam_s``, if visible; drivers often have the wrong direction."""
    scan = stretches[0][0]
    turn_s = abs(scan.beam_s / scan.step_rad) * math.tau if scan.step_rad else 0.0
    if not 0.0 < turn_s <= GAP_S:
        return None
    cut_rad = math.pi + 0.5 * (scan.start_angle_rad + float(scan.bearings_rad()[-1]))
    pairs = [pair for scans in _short(stretches) for pair in _pairs_of_scans(scans, config)]
    directions = [Turn(sign * turn_s, 0.0, cut_rad) for sign in (1.0, -1.0)]
    tried = [(turn, _agreed(pairs, turn.timed, config)) for turn in directions]
    return _bent(pairs, *max(tried, key=lambda trial: sum(trial[1])), config)


def _short(stretches: Sequence[Sequence[LaserScan]]) -> list[list[LaserScan]]:
    """The first seconds of stretches spread over a log."""
    return [
        [scan for scan in scans if scan.stamp_s - scans[0].stamp_s <= LASTS_S]
        for scans in stretches[:: -(-len(stretches) // MOST)]
    ]


def _extruded(scan: LaserScan) -> PointCloud:
    """A planar scan as a cloud: walls extended by half a metre up and down, with a floor in front."""
    walls, shares = scan.points_laser(), np.arange(1, 5) / 4
    heights_m = np.linspace(-0.5, 0.5, 5)
    rows = [np.column_stack([walls, np.full(len(walls), height_m)]) for height_m in heights_m]
    rows += [np.column_stack([share * walls, np.full(len(walls), heights_m[0])]) for share in shares]
    return PointCloud(scan.stamp_s, np.vstack(rows).astype(np.float32), None, sensor=scan.sensor)


def _bends(
    stretches: Iterable[Sequence[_Pair]], interval_s: float, config: Config
) -> tuple[list[_Pair], Turn] | None:
    """Pairs of as many stretches as needed, and the rotation from distorted clouds; None without one."""
    pairs, sums, bent, fit, number = list[_Pair](), list[_Sums](), Turn(0.0, 0.0, 0.0), None, 0
    for number, new in enumerate(stretches, 1):
        pairs += new
        sums += _all_sums(new, bent, config, _CUTS_RAD)
        fit = _fit(sums, _CUTS_RAD) if number > 1 else None
        if fit is None:
            continue
        within_s = math.sqrt(gate()) * fit.sigma_s
        # Planes of distorted clouds bias the estimate: at first, the duration appears half as long.
        if abs(fit.turn_s) + within_s < 0.5 * interval_s / (_TURNS + 0.5):
            return None
        if abs(fit.turn_s) > within_s and number > 3:
            break
    return (pairs, fit) if fit is not None and number > 3 else None


def _settled(pairs: Sequence[_Pair], fit: Turn, interval_s: float, config: Config, flat: bool) -> Turn | None:
    """The duration after deskewing (a whole fraction of the interval), and the best cut."""
    own = np.array([fit.cut_rad])  # after partial deskewing, another cut may explain the rest wrongly
    for _ in range(ROUNDS):
        before, fit = fit, _fit(_all_sums(pairs, fit, config, own), own) or fit
        if abs(fit.turn_s - before.turn_s) <= fit.sigma_s:
            break
    # The estimate is certain only after deskewing, so start with half the duration.
    if abs(fit.turn_s) < max(interval_s / (_TURNS + 0.5), 2 * math.sqrt(gate()) * fit.sigma_s):
        return None
    shares = [math.copysign(interval_s / turns, fit.turn_s) for turns in range(1, _TURNS + 1)]
    shares = sorted(shares, key=lambda share: abs(math.log(share / fit.turn_s)))[:3]  # the nearest
    refits = [_fit(_all_sums(pairs, replace(fit, turn_s=share), config, own), own) or fit for share in shares]
    # If deskewing is right, the clouds give the same estimate again. A share nearly as good: ambiguous.
    errors = [abs(one.turn_s / share - 1.0) for one, share in zip(refits, shares, strict=True)]
    if 2.0 * min(errors) > sorted(errors)[1]:
        return None
    chosen, turn_s = refits[int(np.argmin(errors))], shares[int(np.argmin(errors))]
    best = replace(chosen, turn_s=turn_s)
    agreed = _agreed(pairs, best.timed, config)
    for slices in (4, 2, 1):
        aside = [replace(best, cut_rad=best.cut_rad + by * math.tau / SLICES) for by in (-slices, slices)]
        tried = [(best, agreed), *((turn, _agreed(pairs, turn.timed, config)) for turn in aside)]
        best, agreed = max(tried, key=lambda trial: sum(trial[1]))
    # Planes seen from a tilted lidar confirm any duration, but points do not fit better with a wrong one.
    return _bent(pairs, best, agreed, config, reverse=not flat)


def _bent(
    pairs: Sequence[_Pair], turn: Turn, agreed: Sequence[float], config: Config, *, reverse: bool = False
) -> Turn | None:
    """The rotation, if points fit better with it than without one, or than with none or the reverse."""
    others = [replace(turn, turn_s=one_s) for one_s in ((TINY, -turn.turn_s) if reverse else (TINY,))]
    gains = [_gain(agreed, _agreed(pairs, other.timed, config)) for other in others]
    return turn if sum(gains) > 2 else None


def _gain(agreed: Sequence[float], others: Sequence[float]) -> float:
    """Additional share of fitting points with one timing compared with another, beyond chance."""
    gains = np.subtract(agreed, others)
    return float(gains.mean() / max(gains.std() / math.sqrt(len(gains)), TINY)) if len(gains) else 0.0


def _agreed(pairs: Sequence[_Pair], timed: _Timed, config: Config) -> list[float]:
    """For each pair, the share of a cloud's points on planes of the other, both deskewed."""
    found, ways = list[float](), config.cloud_odometry
    for first, second, voxel_m in pairs:
        known, seen = (base_points(timed(one.cloud), one.twist, ways) for one in (first, second))
        planes = PlaneVoxels.build(known, voxel_m, ways.thickness_m)
        placed = place_cloud(seen[::4], planes, first.pose.between(second.pose), ROUNDS, 0.5 * voxel_m)
        found.append(0.0 if placed is None else placed.agreement)
    return found


def _fit(sums_of_pairs: Sequence[_Sums], cuts_rad: FloatArray) -> Turn | None:
    """The rotation that explains most, from the sums of all pairs for each cut; sigma from their scatter."""
    if not sums_of_pairs:
        return None
    weights, sums = (np.array(one) for one in zip(*sums_of_pairs, strict=True))
    # In a sharp turn, points leave their planes, so limit the weight of a pair to that of others.
    most = 1.0 / (1.0 + weights / np.maximum(np.median(weights, axis=0), TINY))
    weights, sums = weights * most, sums * most
    totals = np.maximum(weights.sum(axis=0), TINY)
    best = int(np.argmax(sums.sum(axis=0) ** 2 / totals))
    turn_s = float(sums[:, best].sum() / totals[best])
    residuals = sums[:, best] - turn_s * weights[:, best]
    return Turn(turn_s, float(np.linalg.norm(residuals) / totals[best]), float(cuts_rad[best]))


def _all_sums(pairs: Sequence[_Pair], now: Turn, config: Config, cuts_rad: FloatArray) -> list[_Sums]:
    """The sums of each pair after deskewing, for pairs with information."""
    found = (_sums(*pair, now, config, cuts_rad) for pair in pairs)
    return [one for one in found if one is not None]


def _sums(
    first: _Moving, second: _Moving, voxel_m: float, now: Turn, config: Config, cuts_rad: FloatArray
) -> _Sums | None:
    """Least squares of the rotation for each cut (C,), with free relative pose."""
    ways = config.cloud_odometry
    known, seen = (base_points(now.timed(one.cloud), one.twist, ways) for one in (first, second))
    planes = PlaneVoxels.build(known, voxel_m, _THICKNESS * voxel_m)
    seen = seen[::4]
    found = place_cloud(seen, planes, first.pose.between(second.pose), ROUNDS, 0.5 * voxel_m)
    if found is None:
        return None
    turned = found.pose.rotation().matrix()
    placed = seen @ turned.T + found.pose.translation()
    paired = planes.pairs(placed)
    own, there, normals = seen[paired.found], placed[paired.found], paired.normals
    off_m = np.sum(normals * (there - paired.centers), axis=1)
    weights = 1.0 / ((_THICKNESS * voxel_m) ** 2 + off_m**2)  # Cauchy
    slopes = np.hstack([np.cross(own, normals @ turned), normals @ turned])
    # Displacement of a point perpendicular to the plane per second of the revolution, and the plane itself.
    moved, moves = (
        np.sum(normals * (one[3:] + np.cross(one[:3], points)) @ rotation.T, axis=1)
        for one, points, rotation in ((second.twist, own, turned), (first.twist, there, np.eye(3)))
    )
    cuts = np.append(cuts_rad, now.cut_rad)[None, :] / math.tau
    turns, turns_there = (bearings_rad(points)[:, None] / math.tau - cuts for points in (own, there))
    shares, shares_there = turns - np.floor(turns) - 0.5, turns_there - np.floor(turns_there) - 0.5
    slope = moved[:, None] * shares - moves[:, None] * shares_there
    left = off_m - now.turn_s * slope[:, -1]
    hessian = slopes.T @ (weights[:, None] * slopes) + TINY * np.eye(6)
    explained = np.linalg.solve(hessian, (slopes * weights[:, None]).T)
    slope = slope[:, :-1] - slopes @ (explained @ slope[:, :-1])
    left = left - slopes @ (explained @ left)
    return np.asarray(weights @ slope**2), np.asarray(-(weights * left) @ slope)


def _pairs(clouds: Sequence[PointCloud], config: Config) -> list[_Pair]:
    """The `_ends` of a stretch, from a separate tracker."""
    tracker, tracked = CloudTracker(config, None), list[tuple[PointCloud, gtsam.Pose3]]()
    for cloud in clouds:
        found = tracker.follow(cloud)
        if found.motion is not None or not tracked:
            tracked.append((cloud, found.pose))
    return _ends(tracked, tracker.voxel_m)


def _pairs_of_scans(scans: Sequence[LaserScan], config: Config) -> list[_Pair]:
    """Like `_pairs`, for the longest part of a stretch matched in the plane: ten times as fast."""
    motion = max(track_stretches([scans], config), key=lambda one: len(one.stamps_s), default=None)
    if motion is None:
        return []
    at, poses = {scan.stamp_s: scan for scan in scans}, map(pose2_from_row, motion.poses)
    walls = [_extruded(at[stamp_s]) for stamp_s in motion.stamps_s.tolist()]
    points = base_points(walls[0], np.zeros(6), config.cloud_odometry)
    voxel_m = voxel_of(points, config.cloud_odometry)
    return _ends(list(zip(walls, map(gtsam.Pose3, poses), strict=True)), voxel_m)


def _ends(tracked: Sequence[tuple[PointCloud, gtsam.Pose3]], voxel_m: float) -> list[_Pair]:
    """Pairs of start, middle and end of a stretch, with the voxel size of their planes."""
    if len(tracked) < 3 or any(one[0].stamp_s >= other[0].stamp_s for one, other in pairwise(tracked)):
        return []
    chosen = []
    for number in (0, len(tracked) // 2, len(tracked) - 1):
        before, after = tracked[max(number - 1, 0)], tracked[min(number + 1, len(tracked) - 1)]
        way = gtsam.Pose3.Logmap(before[1].between(after[1]))
        chosen.append(_Moving(*tracked[number], way / (after[0].stamp_s - before[0].stamp_s)))
    return [(one, other, voxel_m) for one, other in [*pairwise(chosen), (chosen[0], chosen[2])]]


def _sees_around(walls: Sequence[PointCloud]) -> bool:
    """Whether a 2D lidar sees more than half a circle; otherwise it may not spin."""
    bearings = [bearings_rad(one.points_lidar) for one in walls]
    slices = np.floor(np.concatenate([*bearings, np.zeros(1)]) / math.tau * SLICES)
    return len(np.unique(slices[np.isfinite(slices)])) > SLICES // 2 + 1  # a half circle touches one more


def _spread_out(stretches: Sequence[T]) -> Iterator[T]:
    """Every fourth stretch first, then those between."""
    for begin in (0, 2, 1, 3):
        yield from stretches[begin::4]
