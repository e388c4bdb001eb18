"""Checks what must be right before steps can be compared: clocks and the angular step of beams."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fusion.estimation import FEWEST, gate
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.doctor.finding import Finding
from slam.doctor.pair import IN_ORDER, Pair, interval
from slam.doctor.scan_motion import ScanMotion, Steps, track_stretches
from slam.doctor.wheel_steps import WheelSteps, clock_of


def clock_finding(
    pair: Pair, tracked: list[ScanMotion], steps: Steps, config: Config
) -> tuple[float, list[Finding]]:
    """How far the wheels' clock is ahead, if it matters, and the finding."""
    offsets = [clock_of(tracked, pair.rows, sign) for sign in (1.0, -1.0)]
    found = max((one for one in offsets if one is not None), key=lambda one: one.correlation, default=None)
    if found is None:
        return 0.0, []
    # Repeat around the first estimate, with steps long enough to average errors of matches.
    around_s = np.linspace(-0.5 * GAP_S, 0.5 * GAP_S, FEWEST + 1)
    tried_s = [0.0, *(found.offset_s + around_s).tolist()]
    misfits = [_misfit(WheelSteps.of(steps, pair.rows, ahead_s)) for ahead_s in tried_s]
    best = int(np.argmin(misfits))
    offset_s = tried_s[best]
    turned = steps.motions[:, 2] / (steps.spans_s[:, 1] - steps.spans_s[:, 0])
    wrong_rad = 2.0 * abs(offset_s) * float(turned.std())
    # An offset within the wheels' tolerance for a keyframe's rotation, or with little effect, is no error.
    allowed_rad = config.wheels.turn_share * config.keyframes.angle_rad + config.wheels.floor_rad
    if wrong_rad < allowed_rad or 2.0 * misfits[best] > misfits[0]:
        return 0.0, []
    sigma_s = max(found.sigma_s, float(np.diff(around_s).max()))
    low, high = interval(offset_s, sigma_s)
    finding = Finding(
        pair.wheels,
        "clock",
        f"its clock is ahead of the lidar's by {offset_s:+.2f} s (95 %: {low:+.2f} to {high:+.2f})",
        f"during rotations the wheels are wrong by up to {math.degrees(wrong_rad):.0f} degrees",
        (
            pair.of_wheels(clock_offset_s=round(offset_s, 3)),
            pair.of_lidar(clock_offset_s=round(-offset_s, 3)),
        ),
        sure=True,
        value=offset_s,
        interval=(low, high),
    )
    return offset_s, [finding]


def _misfit(wheels: WheelSteps) -> float:
    """Mean misfit of rotations in radians, independent of scale; infinite for too few."""
    turn = wheels.turn_scale()
    if turn is None:
        return math.inf
    return float(np.abs(wheels.lidar_turns_rad - turn.values[0] * wheels.turns_rad).mean())


def angle_scale(
    pair: Pair, tracked: list[ScanMotion], wheels: WheelSteps, ahead_s: float, config: Config
) -> tuple[Finding, list[ScanMotion]] | None:
    """Whether the angular step of beams differs from the stated one, and the motion with the right one.

    A stretched field of view scales every rotation, like a wrong wheel base; but it also bends walls, so that
    scans from two places do not fit.
    """
    scale, better = 1.0, tracked
    turn = wheels.turn_scale()
    for _ in range(3):
        if turn is None or turn.values[0] == 0.0:
            return None
        # A larger factor is an error of units, not of the field of view.
        scale = float(np.clip(scale / abs(turn.values[0]), 1.0 / math.pi, math.pi))
        if abs(math.log(scale)) < 0.5 * IN_ORDER:
            return None
        better = track_stretches(pair.stretches, config, scale)
        wheels = WheelSteps.of(Steps.of(better, config), pair.rows, ahead_s)
        turn = wheels.turn_scale()
        if turn is None or not _fits_better(better, tracked):
            return None
        if abs(math.log(abs(turn.values[0]))) < 0.5 * IN_ORDER:
            break
    assert turn is not None
    scale /= abs(turn.values[0])
    scan = pair.stretches[0][0]
    beams = scan.ranges_m.size
    stated_deg = math.degrees(scan.step_rad) * (beams - 1)
    # Wheels have errors of a percent; fields of view are tens of degrees: use the best fit of scans.
    near_deg = [stated_deg * scale, *(round(stated_deg * scale + shift, -1) for shift in (-5, 5))]
    views = [
        (deg, track_stretches(pair.stretches, config, deg / stated_deg))
        for deg in near_deg
        if abs(math.log(max(deg, 1.0) / near_deg[0])) < 0.5 * IN_ORDER
    ]
    seen_deg, better = max(
        views, key=lambda view: float(np.concatenate([one.fits for one in view[1]]).mean())
    )
    sigma = scale * math.sqrt(turn.covariance[0, 0])
    middle_deg = math.degrees(scan.start_angle_rad) + 0.5 * stated_deg
    low, high = interval(seen_deg, seen_deg * sigma)
    finding = Finding(
        pair.lidar,
        "field of view",
        f"its beams span {seen_deg:.0f} degrees (95 %: {low:.0f} to {high:.0f}), "
        f"the log says {stated_deg:.0f}",
        "walls are distorted, and rotations have the wrong size",
        (
            pair.of_lidar(
                start_angle_deg=round(middle_deg - 0.5 * seen_deg, 4),
                step_deg=round(seen_deg / (beams - 1), 6),
            ),
        ),
        sure=True,
        value=seen_deg,
        interval=(low, high),
    )
    return finding, better


def _fits_better(tracked: Sequence[ScanMotion], other: Sequence[ScanMotion]) -> bool:
    """Whether scans fit significantly better than in another attempt, and not fewer of them."""
    fits = [
        {stamp_s: fit for one in tries for stamp_s, fit in zip(one.stamps_s[1:], one.fits, strict=True)}
        for tries in (tracked, other)
    ]
    both = sorted(fits[0].keys() & fits[1].keys())
    if len(both) < 2 * FEWEST or 2 * len(fits[0]) < len(fits[1]):
        return False
    # Scans of one place are not independent.
    parts = np.array_split([fits[0][stamp_s] - fits[1][stamp_s] for stamp_s in both], FEWEST)
    gains = [float(part.mean()) for part in parts]
    return float(np.mean(gains)) > math.sqrt(gate()) * float(np.std(gains)) / math.sqrt(len(gains))
