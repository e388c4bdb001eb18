"""Finds errors of cameras and 3D lidars, alone and compared with the motion of the robot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from fusion.estimation import gate
from slam.config.clouds import CloudOdometryConfig
from slam.datasets.frame_pairs import TOLERANCE_S
from slam.datasets.laser_geometry import DEFAULT_NO_RETURN_M
from slam.doctor.camera_samples import SPREAD, CameraSamples
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.finding import Finding, Remedy, mounting_entry
from slam.doctor.floor import ANGLE_RAD, LEVER_M, floor_below_m
from slam.doctor.imu import ImuSamples, clock_sigma_s
from slam.doctor.lens_fit import lens_fit
from slam.doctor.own_body import body_finding
from slam.doctor.pair import interval
from slam.doctor.paired_motions import JOINED, BaseTrack, clock_of, joined, runs_of, turns_of
from slam.doctor.planar_hand_eye import PlanarHandEye, planar_hand_eye
from slam.measurements import FloatArray
from slam.vision.camera_frame import T_BODY_CAMERA

# Largest clock offset to search for, and those that mapping estimates itself from rotations.
_MOST_S, _LEARNED_S = 0.7, 0.15
# Smaller differences are normal for sensors on robots: shares.
_SHARE = 0.06
# What a depth camera sees.
_DEPTHS_M = (0.1, 30.0)
# Ratios of the unit of depth files to the assumed one.
_UNITS = (1000.0, 0.001, 5.0, 0.2, 10.0, 0.1, 100.0, 0.01)


@dataclass(frozen=True, slots=True)
class Base:
    """Motion of the base, and whether it is confirmed by more than the wheels."""

    wheels: str
    track: BaseTrack
    certain: bool


@dataclass(slots=True)
class Seen:
    """A camera or 3D lidar, and the robot's motion as seen by it.

    Attributes
    ----------
    kind, name
        Type of sensor in a calibration file, and its name.
    R_base_sensor, told_m
        Stated pose: rotation (3, 3), translation (3,); None if there is none.
    clock_s, clock_sigma_s
        How far its clock is ahead; 0 and infinite if unknown.
    fit
        None if its motions do not determine it.
    floor_m
        Height of the sensor above the floor that it sees, in its own units; None if it sees none.
    """

    kind: str
    name: str
    R_base_sensor: FloatArray | None
    told_m: FloatArray | None
    clock_s: float = 0.0
    clock_sigma_s: float = math.inf
    fit: PlanarHandEye | None = None
    floor_m: float | None = None
    upside_down: bool | None = None

    @property
    def off(self) -> float:
        """Ratio of its translations to the base's; one if that is nearly right or unknown."""
        if self.fit is None or _within(self.fit.scale - 1.0, self.fit.sigmas[1], _SHARE):
            return 1.0
        return self.fit.scale


def camera_findings(name: str, samples: CameraSamples, rows: FloatArray) -> list[Finding]:
    """Findings about a camera alone, and compared with the (N, 4) rows of the wheels."""
    hangs = samples.repeats.driven(rows)
    found = samples.repeats.findings("cameras", name, samples.count, "frames", enough=hangs)
    if samples.points and (depths_m := np.concatenate(samples.points)[:, 2]).size:
        # Between near and far, because the median depends more on where the camera looks.
        middle_m = float(np.sqrt(np.percentile(depths_m, (2, 98)).prod()))
        found += unit_finding("cameras", name, middle_m, _DEPTHS_M)
    late = late_depth(name, samples.lag.estimate())
    return found + (late or lens_findings(name, samples))


def late_depth(name: str, lag: tuple[float, float] | None) -> list[Finding]:
    """Check whether depth images are of another time than the colour images, given their delay and sigma."""
    if lag is None or _within(*lag, TOLERANCE_S):
        return []
    order = "later" if lag[0] > 0 else "earlier"
    text = f"its depth images are {1000 * abs(lag[0]):.0f} ms {order} than its colour images, by their edges"
    remedy: Remedy = {"cameras": {name: {"depth_clock_offset_s": round(lag[0], 3)}}}
    effect, span = "while it turns, depths are of other places", interval(*lag)
    return [Finding(name, "depth clock", text, effect, (remedy,), sure=True, value=lag[0], interval=span)]


def unit_finding(
    group: str, name: str, seen_m: float | None, limits_m: tuple[float, float] = (0.0, DEFAULT_NO_RETURN_M)
) -> list[Finding]:
    """Find a wrong unit of length of a sensor: implausible distances, of which ``seen_m`` is the middle."""
    if not seen_m or seen_m < 0:
        return []
    what, seen_by = ("depth", "camera") if group == "cameras" else ("range", "lidar")
    middle_m = math.sqrt(max(_DEPTHS_M[0], limits_m[0]) * _DEPTHS_M[1])  # geometric mean of what they see
    unit = min(_UNITS, key=lambda one: abs(math.log(seen_m / one / middle_m)))
    sure = not limits_m[0] <= seen_m <= limits_m[1]
    # Nearly as far from it as TUM's unit is from millimetres, because some cameras have such depths.
    if not sure and (what == "range" or max(seen_m / middle_m, middle_m / seen_m) < 4):
        return []
    seldom = "no" if sure else "hardly a"
    text = f"its {what}s are about {seen_m:.3g} m, which {seldom} {seen_by} sees: {unit:g} times too large"
    remedy = {group: {name: {f"{what}_scale": 1.0 / unit}}}
    return [
        Finding(name, f"{what} scale", text, "the map is of another size", (remedy,), sure=sure, value=unit)
    ]


def lens_findings(name: str, samples: CameraSamples) -> list[Finding]:
    """Check whether the shape of the scene requires other intrinsics."""
    stated = samples.intrinsics
    fit = None if stated is None else lens_fit(samples.pairs, stated)
    if stated is None or fit is None:
        return []
    off_px = fit.center_px - (stated.cx, stated.cy)
    limits_px = _SHARE * 0.5 * np.array([stated.width, stated.height])
    focal = not _within(fit.focal_gain - 1.0, float(fit.sigmas[0]), _SHARE)
    center = [not _within(*row) for row in zip(off_px, fit.sigmas[1:], limits_px, strict=True)]
    if not (focal or any(center)):
        return []
    gain = fit.focal_gain if focal else 1.0
    cx, cy = np.where(center, fit.center_px, (stated.cx, stated.cy)).tolist()
    lens = {"fx": stated.fx * gain, "fy": stated.fy * gain, "cx": cx, "cy": cy}
    lens = {key: round(value, 2) for key, value in lens.items()}
    return [
        Finding(
            name,
            "lens",
            f"the geometry of the scene implies f = {stated.fx * fit.focal_gain:.0f} px and the centre at "
            f"{fit.center_px[0]:.0f}, {fit.center_px[1]:.0f}, not {stated.fx:.0f} at {stated.cx:.0f}, "
            f"{stated.cy:.0f}",
            "rotations and walls are distorted",
            ({"cameras": {name: {"intrinsics": lens}}},),
            value=fit.focal_gain,
            interval=interval(fit.focal_gain, float(fit.sigmas[0])),
        )
    ]


def seen_by(
    kind: str,
    name: str,
    samples: CameraSamples | CloudSamples,
    T_base_sensor: gtsam.Pose3 | None,
    base: Base | None,
) -> Seen:
    """The robot's motion as seen by a sensor; without a base nothing of it is known."""
    R = None if T_base_sensor is None else np.asarray(T_base_sensor.rotation().matrix())
    seen = Seen(kind, name, R, None if T_base_sensor is None else np.asarray(T_base_sensor.translation()))
    runs = runs_of(samples.steps)
    steps = joined(runs, JOINED)
    if base is None or not steps:
        return seen
    clock = clock_of(runs, base.track, _MOST_S)
    if clock is not None:
        seen.clock_s, seen.clock_sigma_s = clock.offset_s, clock.sigma_s
    begun, ended = (
        np.array([getattr(step, at) for step in steps]) - seen.clock_s for at in ("begun_s", "ended_s")
    )
    moved = base.track.steps(begun, ended)
    known = np.isfinite(moved).all(axis=1)
    shifts = np.array([step.motion.translation() for step in steps])
    fit = planar_hand_eye(turns_of(steps)[known], shifts[known], moved[known])
    # With such a residual, the motion of the sensor is unreliable, whatever its covariance.
    seen.fit = fit if fit is not None and fit.spread < SPREAD else None
    if seen.fit is not None:
        up = seen.fit.up if R is None else R.T[:, 2]
        points = np.concatenate(samples.points) if samples.points else np.zeros((0, 3))
        seen.floor_m = floor_below_m(points, up)
        over_m = floor_below_m(points, -up)
        if seen.floor_m is not None or over_m is not None:
            # Of floor and ceiling, the nearer one is the floor, because robots are low.
            seen.upside_down = (over_m or math.inf) < (seen.floor_m or math.inf)
    return seen


def findings_against(base: Base, sensors: Sequence[Seen], doubtful: frozenset[str]) -> list[Finding]:
    """Findings about sensors that contradict the base, except what depends on ``doubtful`` intrinsics."""
    found: list[Finding] = []
    fitted = [seen for seen in sensors if seen.fit is not None]
    for seen in sensors:
        found += _clock(base, seen, [other for other in sensors if other is not seen])
    for seen in fitted:
        if seen.name in doubtful:
            continue
        others = [other for other in fitted if other is not seen and other.name not in doubtful]
        found += _scale(base, seen, others)
        found += _mounting(base, seen, others)
    first = dict[tuple[str, str], Finding]()  # report errors of the wheels once, not for each sensor
    for finding in found:
        first.setdefault((finding.sensor, finding.kind), finding)
    return list(first.values())


def _clock(base: Base, seen: Seen, others: Sequence[Seen]) -> list[Finding]:
    """A larger clock offset than mapping estimates itself."""
    if _within(seen.clock_s, seen.clock_sigma_s, _LEARNED_S):
        return []
    as_much = [one for one in others if abs(one.clock_s - seen.clock_s) < 0.5 * _LEARNED_S]
    ahead_s = round(seen.clock_s, 3)
    own: Remedy = {seen.kind: {seen.name: {"clock_offset_s": ahead_s}}}
    wheels: Remedy = {"wheels": {base.wheels: {"clock_offset_s": -ahead_s}}}
    blame = bool(as_much) and not base.certain
    sure = base.certain or blame or any(_within(one.clock_s, one.clock_sigma_s, _LEARNED_S) for one in others)
    return [
        Finding(
            base.wheels if blame else seen.name,
            "clock",
            f"its stamps are {abs(ahead_s):.2f} s {'ahead of' if (ahead_s > 0) != blame else 'behind'} "
            f"those of {'cameras and lidars' if blame else base.wheels}, by when both turn",
            "rotations are used at the wrong time, and walls are doubled",
            (wheels,) if blame else (own,) if sure else (own, wheels),
            sure=sure,
            value=ahead_s,
            interval=interval(ahead_s, seen.clock_sigma_s),
        )
    ]


def _scale(base: Base, seen: Seen, others: Sequence[Seen]) -> list[Finding]:
    """A scale error relative to the wheels."""
    scale, fit = seen.off, seen.fit
    if scale == 1.0 or fit is None:
        return []
    factor = round(1.0 / scale, 4)
    key = "depth_scale" if seen.kind == "cameras" else "range_scale"
    own: Remedy = {seen.kind: {seen.name: {key: factor}}}
    wheels: Remedy = {"wheels": {base.wheels: {"scale": round(scale, 4)}}}
    mine = yours = False
    if seen.told_m is not None and seen.floor_m is not None and seen.told_m[2] > LEVER_M:
        floor = seen.floor_m / seen.told_m[2]
        mine, yours = (abs(math.log(floor / one)) < 0.5 * abs(math.log(scale)) for one in (scale, 1.0))
    if base.certain and yours and not mine:
        return []  # the floor is where it should be, so the motions are unreliable
    if not base.certain:
        as_much = [one for one in others if abs(one.off / scale - 1.0) < _SHARE]
        yours = bool(as_much) or (yours and not mine)
    mine = base.certain or mine or any(one.off == 1.0 for one in others)
    blame = yours and not mine
    what = "depth" if seen.kind == "cameras" else "range"
    text = f"its {what}s are {scale:.3g} times what the path of {base.wheels} implies"
    if blame:
        text = f"its path is {1.0 / scale:.3g} times what {seen.name} measures"
    return [
        Finding(
            base.wheels if blame else seen.name,
            "way scale" if blame else f"{what} scale",
            text,
            "the map is of another size",
            (wheels,) if blame else (own,) if mine else (own, wheels),
            sure=blame or mine,
            value=scale,
            interval=interval(scale, float(fit.sigmas[1])),
        )
    ]


def _mounting(base: Base, seen: Seen, others: Sequence[Seen]) -> list[Finding]:
    """A stated pose that contradicts the motion of the sensor."""
    fit, R_stated = seen.fit, seen.R_base_sensor
    if fit is None or R_stated is None or seen.told_m is None:
        return []
    ahead, up = R_stated @ fit.ahead, R_stated @ fit.up
    tilt_rad = math.acos(float(np.clip(up[2], -1.0, 1.0)))
    # Heading of the sensor's estimated forward direction with the stated pose: its yaw error.
    yaw_rad = -math.atan2(float(ahead[1]), float(ahead[0]))
    lever_m = fit.lever_m - seen.told_m[:2]
    turned = not _within(yaw_rad, float(fit.sigmas[2]), ANGLE_RAD)
    tilted = not _within(tilt_rad, fit.tilt_sigma_rad, ANGLE_RAD)
    moved = not all(_within(off, sigma, LEVER_M) for off, sigma in zip(lever_m, fit.sigmas[3:], strict=True))
    if not (turned or tilted or moved):
        return []
    sure = base.certain or any(_sits(one) for one in others)
    rotation = np.stack([fit.ahead, np.cross(fit.up, fit.ahead), fit.up])
    place = [*fit.lever_m, seen.told_m[2]]
    remedy: Remedy = {seen.kind: {seen.name: _entry(seen.kind, rotation, place)}}
    text = ", ".join(
        part
        for part, use in (
            (f"yaw by {math.degrees(yaw_rad):+.1f} degrees", turned),
            (f"roll or pitch by {math.degrees(tilt_rad):.1f} degrees", tilted),
            (f"x, y by {lever_m[0]:+.2f}, {lever_m[1]:+.2f} m", moved),
        )
        if use
    )
    finding = Finding(
        seen.name,
        "mounting",
        f"its motion implies another mounting: {text} (x, y +- {float(fit.sigmas[3:].max()):.2f} m)",
        "what it sees is placed wrongly",
        (remedy,),
        sure=sure,
        value=math.degrees(tilt_rad if tilted else yaw_rad),
    )
    if math.pi - tilt_rad > 2.0 * ANGLE_RAD or turned:
        return [finding]
    mirrored: Remedy = {seen.kind: {seen.name: {"mirrored": True}}}
    if seen.kind != "cameras" or seen.upside_down:
        return [finding]
    # A mirrored and an upside-down camera turn alike; the floor distinguishes them.
    text = "it rotates in the opposite direction: its images are mirrored, or it is mounted upside down"
    known = seen.upside_down is False
    remedies = (mirrored,) if known else (mirrored, remedy)
    return [replace(finding, kind="mirrored", text=text, remedies=remedies, sure=sure and known)]


def _sits(seen: Seen) -> bool:
    """Whether the motion of a sensor agrees with its stated pose."""
    if seen.fit is None or seen.R_base_sensor is None:
        return False
    along = (seen.R_base_sensor @ seen.fit.ahead)[0], (seen.R_base_sensor @ seen.fit.up)[2]
    return bool(min(along) > math.cos(ANGLE_RAD))


def _entry(kind: str, R_base_sensor: FloatArray, place_m: Sequence[float]) -> dict[str, Any]:
    """A pose in the form of a calibration file."""
    rotation = gtsam.Rot3(R_base_sensor)
    if kind == "cameras":
        rotation = rotation.compose(T_BODY_CAMERA.rotation().inverse())
    key = "T_base_camera" if kind == "cameras" else "T_base_lidar"
    return {key: mounting_entry(rotation, place_m)}


def cloud_findings(name: str, samples: CloudSamples, imus: Iterable[ImuSamples] = ()) -> list[Finding]:
    """Findings about a 3D lidar alone; IMUs show how well its stamps are known."""
    # A lidar has noise even at rest, so one identical cloud is already an error.
    found = samples.repeats.findings("lidars_3d", name, samples.count, "clouds", enough=True)
    if samples.points:
        median_m = float(np.median(np.linalg.norm(np.concatenate(samples.points), axis=1)))
        ways = CloudOdometryConfig()  # nothing can be mapped beyond its limits
        found += unit_finding("lidars_3d", name, median_m, (ways.range_min_m, ways.range_max_m))
    if samples.reach_m:
        found.append(body_finding(name, samples.reach_m))
    if samples.turn is not None:
        steps = [step for stretch in samples.steps for step in stretch]
        imu_sigma_s = min((clock_sigma_s(imu, steps) for imu in imus), default=math.inf)
        found.append(samples.turn.finding("lidars_3d", name, samples.turn.clock_sigma_s(imu_sigma_s)))
    interval_s, turn_s = samples.interval_s.median(), samples.turn_s.median()
    if not interval_s or not turn_s:
        return found
    if (scale := samples.times_scale) != 1.0:
        how = "run backward"
        if scale > 0.0:
            how = f"span {turn_s:.3g} s, clouds come every {interval_s:.3g} s"
        effect, text = "clouds are not deskewed correctly", f"the times of a cloud's points {how}"
        remedy: Remedy = {"lidars_3d": {name: {"times_scale": scale}}}
        found.append(Finding(name, "times of points", text, effect, (remedy,), sure=True, value=scale))
    # A lidar whose revolution ends before the next one starts does not overlap itself.
    if 4 * samples.between > samples.count and turn_s < (1.0 + _SHARE) * interval_s:
        text = f"{samples.between} of {samples.count} clouds begin during the revolution of the one before"
        why = "they are from another lidar with the same name, and match nothing"
        remedy = {"lidars_3d": {name: {"drop_repeated": True}}}
        found.append(Finding(name, "several lidars", text, why, (remedy,), sure=True))
    return found


def _within(off: float, sigma: float, limit: float) -> bool:
    """Whether a difference may be below a limit."""
    return not abs(off) > limit + gate() ** 0.5 * sigma
