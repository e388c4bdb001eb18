"""Compares wheels with a lidar: which of them is interpreted, mounted or scaled wrongly, and how."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from fusion.estimation import FEWEST, gate, median_to_sigma
from slam.config import Config
from slam.doctor.finding import Finding
from slam.doctor.pair import IN_ORDER, Pair, interval
from slam.doctor.relation import Linear, Relation
from slam.doctor.scan_motion import ScanMotion, Steps
from slam.doctor.time_and_view import angle_scale, clock_finding
from slam.doctor.wheel_steps import Reading, WheelSteps
from slam.matching.planar import wrap
from slam.measurements import FloatArray

# Factors of lengths caused by wrong units: millimetres, centimetres, feet, inches, doubled.
_UNITS = (1e-3, 1e-2, 0.3048, 0.0254, 0.5, 2.0)
_QUARTERS = ("x y", "-y x", "-x -y", "y -x")
_FLIPPED_QUARTERS = ("x -y", "y x", "-x y", "-y -x")
_GARBLED = "each step of the wheels has a wrong direction, so they cannot be used"


def compare(pair: Pair, tracked: list[ScanMotion], config: Config) -> tuple[list[Finding], list[str]]:
    """Contradictions between wheels and a lidar, and undetermined questions."""
    steps = Steps.of(tracked, config)
    if len(steps) < FEWEST:
        return [], [f"{pair.lidar}: the scans do not determine its motion (corridors, or it stands)"]
    if not len(pair.rows) or not np.ptp(pair.rows[:, 1:], axis=0).any():
        return [_frozen(pair)], []
    ahead_s, findings = clock_finding(pair, tracked, steps, config)
    wheels = WheelSteps.of(steps, pair.rows, ahead_s)
    if view := angle_scale(pair, tracked, wheels, ahead_s, config):
        wheels = WheelSteps.of(Steps.of(view[1], config), pair.rows, ahead_s)
        findings.append(view[0])
    turn = wheels.turn_scale()
    if len(wheels) >= FEWEST and not _explains(turn, wheels.lidar_turns_rad):
        return [*findings, _unfit(pair)], []
    if turn is None or turn.values[0] ** 2 < gate() * turn.covariance[0, 0]:
        return findings, [f"{pair.lidar} and {pair.wheels}: signs, mounting and clock, for lack of rotations"]
    scale = float(turn.values[0])
    sign = math.copysign(1.0, scale)
    readings = [Reading(sign, sign < 0.0), Reading(sign, sign > 0.0)]
    if abs(math.log(abs(scale))) > config.wheels.turn_share:
        size = abs(scale)
        in_degrees = abs(math.log(math.degrees(size))) < config.wheels.turn_share
        unit = sign * (math.radians(1.0) if in_degrees else _unit(size) or size)
        readings += [Reading(unit, sign < 0.0), Reading(unit, sign > 0.0)]
    found = wheels.best(readings)
    if found is None and not np.ptp(wheels.places, axis=1).any():
        return [*findings, _unfit(pair)], []
    if found is None:
        return findings, [f"{pair.lidar} and {pair.wheels}: how they belong together"]
    reading, relation = found
    if not fits_as_read(wheels, reading, relation, config):
        return [*findings, _unfit(pair)], []
    relation = relation.of_ranges_scaled(pair.range_scale)
    if pair.range_scale != 1.0 and _in_order(relation):
        both, relation = _both_lengths(pair, relation)
        findings += both
    axes, relation, forward = _axes(pair, wheels, reading, relation)
    findings += axes + _mounting(pair, relation, forward, config)
    findings += _lengths(pair, relation)
    turn_scale = scale / reading.heading_scale
    if abs(math.log(turn_scale)) > config.wheels.turn_share:
        findings.append(_turns(pair, turn_scale, math.sqrt(turn.covariance[0, 0]) * turn_scale / abs(scale)))
    return findings, []


def _frozen(pair: Pair) -> Finding:
    """Wheels that never report any motion."""
    return Finding(
        pair.wheels,
        "frozen wheels",
        "reports no motion although the lidar's scans show some",
        "the map is made from the scans alone, and is wrong where these do not determine the motion",
        sure=True,
    )


def _explains(turn: Linear | None, turns_rad: FloatArray) -> bool:
    """Whether written rotations explain most of the lidar's; true if it hardly turns."""
    scatter_rad = float(np.std(turns_rad))
    if scatter_rad < IN_ORDER:
        return True
    return turn is not None and 2.0 * turn.sigma < scatter_rad and turn.values[0] != 0.0


def fits_as_read(wheels: WheelSteps, reading: Reading, relation: Relation, config: Config) -> bool:
    """Whether half of the distance is as accurate as usual for wheels: to a share of distance and rotation.

    A robot that mostly turns on the spot has steps so short that errors of matches are a large part.
    """
    path_m = np.abs(wheels.lidar)
    allowed_m = IN_ORDER * path_m + config.wheels.swing_m_per_rad * np.abs(wheels.lidar_turns_rad)
    off = wheels.misfits(reading, relation) / allowed_m
    order = np.argsort(off)
    half = np.searchsorted(np.cumsum(path_m[order]), 0.5 * path_m.sum())
    return median_to_sigma(2) * float(off[order[half]]) < 1.0


def _unfit(pair: Pair) -> Finding:
    """Wheels that do not fit the scans under any interpretation."""
    return Finding(
        pair.wheels,
        "no agreement",
        f"it fits {pair.lidar} for no unit, sign, axis or clock: part of it is frozen, noisy or lost",
        "the wheels mislead wherever the scans alone do not determine the map",
    )


def _axes(
    pair: Pair, wheels: WheelSteps, reading: Reading, relation: Relation
) -> tuple[list[Finding], Relation, bool]:
    """Findings about signs and axes; the corrected relation; whether the wheels roll along their x axis."""
    findings = list[Finding]()
    steps = wheels.steps(reading)
    entries: dict[str, Any] = {}
    if reading.heading_scale < 0.0 and reading.flipped:
        findings.append(_mirrored(pair, relation))
        steps = steps.conj()
        relation = relation.mirrored()
        entries["heading_scale"] = -reading.heading_scale
    elif reading.heading_scale != 1.0:
        entries["heading_scale"] = reading.heading_scale
    if entries.get("heading_scale", 1.0) != 1.0:
        findings.append(_heading(pair, entries["heading_scale"]))
    # Robots mostly drive forward, which is their x axis.
    heading = float(np.angle((steps * np.abs(steps)).sum()))
    off_rad = wrap(relation.yaw_rad - pair.mounting.theta())
    names = _QUARTERS
    quarter = round(off_rad / (0.5 * math.pi)) % 4
    if reading.flipped and reading.heading_scale > 0.0:
        names = _FLIPPED_QUARTERS
        # Of the four corrections of a mirrored axis, use the one that keeps the lidar at its stated pose.
        quarter = -quarter % 4
    elif quarter and 2.0 * abs(wrap(heading - off_rad)) > 0.5 * math.pi:
        quarter = 0
    else:
        quarter = -quarter % 4
    if names[quarter] != _QUARTERS[0]:
        axes = names[quarter]
        findings.append(_surely(pair, "axes", f"its x y are {axes}", _GARBLED, axes=axes))
        turned = complex(0.0, 1.0) ** quarter
        steps = steps * turned
        relation = relation.with_wheels_turned(turned)
    elif not reading.flipped and abs(off_rad) > IN_ORDER and abs(wrap(heading - off_rad)) < IN_ORDER:
        findings.append(_crab(pair, heading))
        turned = complex(np.exp(-1j * heading))
        steps = steps * turned
        relation = relation.with_wheels_turned(turned)
    ahead = abs(np.angle((steps * np.abs(steps)).sum())) < IN_ORDER
    return findings, relation, bool(ahead and 2.0 * np.abs(steps.imag).sum() < np.abs(steps.real).sum())


def _mirrored(pair: Pair, relation: Relation) -> Finding:
    """A lidar that consistently turns opposite to the wheels."""
    of_lidar, of_wheels = pair.of_lidar(upside_down=True), pair.of_wheels(mirrored=True)
    stated = complex(pair.mounting.x(), pair.mounting.y())
    # The wrong remedy would mirror a lateral or rotated mounting. Most lidars point straight ahead.
    misses = [
        abs(candidate.position() - stated) ** 2 / candidate.sigma_beta**2
        + wrap(candidate.yaw_rad - pair.mounting.theta()) ** 2 / (candidate.sigma_alpha + IN_ORDER) ** 2
        for candidate in (relation.mirrored(), relation)
    ]
    sure = abs(misses[0] - misses[1]) > gate() and min(misses) < gate(3)
    by_lidar = misses[0] <= misses[1] + gate()
    if not sure and pair.handed:
        sure, by_lidar = True, pair.handed < 0.0
    remedies = (of_lidar, of_wheels) if by_lidar else (of_wheels, of_lidar)
    cause = "it is mounted upside down" if remedies[0] is of_lidar else "the wheels swap left and right"
    other = "" if sure else ", or the wheels swap left and right: these two cannot tell which"
    return Finding(
        pair.lidar,
        "mirrored",
        f"rotates opposite to {pair.wheels} but moves the same way: {cause}{other}",
        "the map is mirrored, or the wheels cannot be used",
        remedies[:1] if sure else remedies,
        sure=bool(sure),
    )


def _heading(pair: Pair, scale: float) -> Finding:
    """A heading in other units, or with the opposite sign."""
    in_degrees = math.isclose(abs(scale), math.radians(1.0))
    what = (
        "in degrees" if in_degrees else "" if abs(scale) == 1.0 else f"{1.0 / abs(scale):.3g} times too large"
    )
    sign = "of the wrong sign" if scale < 0.0 else ""
    text = f"its heading is {' and '.join(part for part in (what, sign) if part)}"
    return _surely(pair, "heading", text, _GARBLED, scale, heading_scale=round(scale, 7))


def _crab(pair: Pair, heading_rad: float) -> Finding:
    """A heading with a constant offset: the robot seems to move sideways, which wheels cannot do."""
    turned_deg = math.degrees(heading_rad)
    text = f"its heading is off by {-turned_deg:.1f} degrees: it moves sideways, and the lidar does not"
    offset_deg = round(turned_deg, 2)
    return _surely(pair, "heading offset", text, _GARBLED, -heading_rad, heading_offset_deg=offset_deg)


def _mounting(pair: Pair, relation: Relation, forward: bool, config: Config) -> list[Finding]:
    """Yaw and position of the lidar."""
    stated, yaw_rad = pair.mounting, relation.yaw_rad
    off_rad = wrap(yaw_rad - stated.theta())
    turned = abs(off_rad) > IN_ORDER + math.sqrt(gate()) * relation.sigma_alpha
    # The lever arm is scaled like the lidar's ranges; if lengths are in doubt, see `_lengths`.
    place = relation.position(1.0 if _in_order(relation) else 1.0 / abs(relation.alpha))
    shift = place - complex(stated.x(), stated.y())
    least_m = config.wheels.swing_m_per_rad + math.sqrt(gate(2)) * relation.sigma_beta
    shifted = abs(shift) > least_m and abs(relation.position() - complex(stated.x(), stated.y())) > least_m
    if not (turned or shifted):
        return []
    x, y = (place.real, place.imag) if shifted else (stated.x(), stated.y())
    mended = {
        "x_m": round(x, 3),
        "y_m": round(y, 3),
        "yaw_deg": round(math.degrees(yaw_rad if turned else stated.theta()), 2),
    }
    remedy = pair.of_lidar(T_base_laser=mended)
    findings = list[Finding]()
    if turned:
        low, high = (math.degrees(one) for one in interval(yaw_rad, relation.sigma_alpha))
        findings.append(
            Finding(
                pair.lidar,
                "yaw",
                f"is turned by {math.degrees(yaw_rad):.1f} degrees (95 %: {low:.1f} to {high:.1f}), "
                f"the log says {math.degrees(stated.theta()):.1f}",
                "the robot's poses are rotated by as much, and wheels and lidar contradict each other",
                (remedy,),
                sure=forward,
                value=yaw_rad,
                interval=interval(yaw_rad, relation.sigma_alpha),
            )
        )
    if shifted:
        findings.append(
            Finding(
                pair.lidar,
                "offset",
                f"sits at x {x:.3f} m, y {y:.3f} m (95 %: +- {interval(0.0, relation.sigma_beta)[1]:.3f}), "
                f"the log says {stated.x():.3f} and {stated.y():.3f}",
                f"during rotations the robot's poses are off by up to {abs(shift):.2f} m",
                (remedy,),
                sure=True,
                value=abs(shift),
                interval=interval(abs(shift), relation.sigma_beta),
            )
        )
    return findings


def _in_order(relation: Relation) -> bool:
    """Whether lengths of wheels and lidar agree as well as those of correct sensors."""
    off = abs(math.log(abs(relation.alpha)))
    return off < IN_ORDER + math.sqrt(gate()) * relation.sigma_alpha


def _lengths(pair: Pair, relation: Relation) -> list[Finding]:
    """Different lengths of wheels and lidar, and which are wrong, if it can be determined."""
    if _in_order(relation):
        return []
    scale = abs(relation.alpha)
    low, high = interval(scale, scale * relation.sigma_alpha)
    of_wheels, of_ranges = _unit(scale), _unit(1.0 / scale)
    wheels = pair.of_wheels(scale=float(f"{of_wheels or scale:.4g}"))
    ranges = pair.of_lidar(range_scale=float(f"{of_ranges or 1.0 / scale:.4g}"))
    # The lidar's lever arm is known in metres: in rotations, its ranges are compared with it.
    stated = complex(pair.mounting.x(), pair.mounting.y())
    by_wheels, by_ranges = (
        abs(relation.position(one) - stated) ** 2 / (one * relation.sigma_beta) ** 2
        for one in (1.0, 1.0 / scale)
    )
    # No unit makes lengths larger by 3.28 in the wheels, or smaller in the lidar.
    hint = (of_ranges is not None and of_ranges < 0.5) - (of_wheels is not None and of_wheels < 0.5)
    # One lever arm agrees with the stated one within the noise, and the other is at least twice as far away.
    nearer, farther = sorted((by_wheels, by_ranges))
    sure = bool(hint or (farther - nearer > gate() and farther > 2.0 * 2.0 * nearer))
    of_lidar = hint > 0 or (hint == 0 and sure and by_ranges < by_wheels)
    longer = f"{1.0 / scale:.4g}" if not of_lidar else f"{scale:.4g}"
    name = pair.lidar if of_lidar else pair.wheels
    kind = ("range scale" if of_lidar else "scale") if sure else "lengths"
    return [
        Finding(
            name,
            kind,
            f"its lengths are {longer} times those of {pair.wheels if of_lidar else pair.lidar} "
            f"(as a scale of the wheels {scale:.4g}, 95 %: {low:.4g} to {high:.4g})",
            "the map has the wrong size" if of_lidar else "the wheels contradict every match",
            (ranges, wheels)[:: 1 if of_lidar else -1][: 1 if sure else 2],
            sure=sure,
            value=scale,
            interval=(low, high),
        )
    ]


def _both_lengths(pair: Pair, relation: Relation) -> tuple[list[Finding], Relation]:
    """Ranges too large for rooms, wheels with the same scale: both in one unit; the relation in metres.

    The lidar's lever arm, known in metres, determines the unit; without one, only ranges beyond any lidar do.
    """
    lever_m = abs(complex(pair.mounting.x(), pair.mounting.y()))
    known_unit = _unit(lever_m / abs(relation.beta)) if lever_m and relation.beta else None
    if known_unit is None and pair.range_scale > _UNITS[0]:
        return [], relation
    unit = known_unit or _UNITS[0]
    text = f"its lengths are {1.0 / unit:g} times too long, as are those of"
    effect, sure = "the map has the wrong size, or there is none", known_unit is not None
    of_lidar, of_wheels = pair.of_lidar(range_scale=unit), pair.of_wheels(scale=unit)
    findings = [
        Finding(pair.lidar, "range scale", f"{text} {pair.wheels}", effect, (of_lidar,), sure, unit),
        Finding(pair.wheels, "scale", f"{text} {pair.lidar}", effect, (of_wheels,), sure, unit),
    ]
    return findings, relation.with_lever_scaled(unit)


def _unit(scale: float) -> float | None:
    """The unit that a scale corresponds to, or None."""
    return next((unit for unit in _UNITS if abs(math.log(scale / unit)) < IN_ORDER), None)


def _turns(pair: Pair, scale: float, sigma: float) -> Finding:
    """Rotations of the wheels that are too large or too small."""
    low, high = interval(scale, sigma)
    text = f"it rotates {1.0 / scale:.3f} times as far as the lidar (scale, 95 %: {low:.3f} to {high:.3f})"
    found = _surely(
        pair,
        "turn scale",
        text,
        "during rotations the wheels contradict the matches",
        scale,
        turn_scale=round(scale, 4),
    )
    return replace(found, interval=(low, high))


def _surely(
    pair: Pair, kind: str, text: str, effect: str, value: float | None = None, **mended: object
) -> Finding:
    """A certain error of the wheels, with a remedy for their calibration."""
    return Finding(pair.wheels, kind, text, effect, (pair.of_wheels(**mended),), sure=True, value=value)
