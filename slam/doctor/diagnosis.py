"""``scanweave doctor``: examine a log and report what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np

from fusion.estimation import FEWEST
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.config.calibration import Calibration
from slam.datasets.corrections import corrected
from slam.datasets.opening import open_dataset
from slam.datasets.recording import fewer_frames
from slam.datasets.spinning_scans import middle_s
from slam.doctor import in_space
from slam.doctor.finding import Finding, remedied
from slam.doctor.imu import handed, imu_findings
from slam.doctor.lost_sign import lost_sign
from slam.doctor.own_body import blocked_beams, blocked_finding, without
from slam.doctor.pair import Pair
from slam.doctor.paired_motions import BaseTrack, mended_rows
from slam.doctor.registration_pairs import registrations_of
from slam.doctor.samples import Samples, WheelSamples
from slam.doctor.scan_motion import ScanMotion, Steps, track_stretches
from slam.doctor.seen_floor import floor_findings
from slam.doctor.stretches import Stretches
from slam.doctor.tilt import stood_up
from slam.doctor.turning import Turn, stamped, turn_by_beam_times, turn_in_the_plane
from slam.doctor.wheels_and_lidar import compare
from slam.measurements import LaserScan, Measurement
from slam.vision.color_registration import ColorRegistration

# Findings that are only right if colour is registered to depth.
_REGISTERED = ("lens", "depth clock")
# Returns the poses of colour cameras by name.
Registrations: TypeAlias = Callable[[Sequence[str]], dict[str, ColorRegistration]]


def diagnose(
    log: Iterable[Measurement] | Path | str, registrations: Registrations | None = None
) -> list[Finding]:
    """Find contradictions between the sensors of a log.

    A limited number of stretches, spread over the log, is matched.

    Parameters
    ----------
    log
        A dataset or its path, or a list of measurements in their order.
    registrations
        Returns the poses of colour cameras, to reuse known ones; None: `registrations_of` the log.

    Returns
    -------
    The findings; none for a good log.

    Raises
    ------
    DatasetError
        If the log cannot be read.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> slam.diagnose(slam.open_dataset(write_synthetic_log("monday", duration_s=20.0).log_path))
    []
    """
    if isinstance(log, str | Path) or not isinstance(log, Iterable):
        log = open_dataset(log)
    return examine(log, registrations).findings


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Findings, and undetermined questions, one line each."""

    findings: list[Finding]
    open: list[str]


def examine(log: Iterable[Measurement], registrations: Registrations | None = None) -> Diagnosis:
    """Like `diagnose`, with what could not be determined."""
    config = Config()
    with fewer_frames(log, lambda _, stamps_s: Stretches().choose(stamps_s)):
        samples = Samples.of(log)
    findings, unknown = _stamps(samples), list[str]()
    vouched_for = False  # the IMUs, by a 2D lidar
    agrees = False  # the wheel odometry, with one of several 2D lidars
    wheels = max(samples.wheels.items(), key=lambda item: item[1].count, default=None)
    for name, lidar in samples.lidars.items():
        findings += lidar.mixed(name)
        hangs = wheels is not None and lidar.repeats.driven(wheels[1].rows())
        findings += lidar.repeats.findings("lidars", name, lidar.count, "scans", enough=hangs)
        if not lidar.stretches:
            continue
        alone = _alone(name, lidar.stretches, config, with_wheels=wheels is not None)
        findings += alone.findings
        by_imus = None if vouched_for else _by_imus(samples, alone.tracked, config)
        vouched_for = vouched_for or by_imus is not None
        if wheels is None:
            findings += [_or_upside_down(one, name) for one in by_imus or []]
            continue
        side = 0.0 if by_imus is None else handed(by_imus)
        pair = Pair(wheels[0], name, wheels[1].rows(), alone.stretches, alone.scale, side)
        found, left_open = _beside_wheels(log, pair, alone, lidar.interval_s.median() or 0.0, config)
        agrees = agrees or not (found or left_open)
        findings += found
        unknown += left_open
        own = [
            one for one in found if one.kind in ("mirrored", "field of view") and "lidars" in one.remedies[0]
        ]
        if by_imus and own:
            # The lidar's error may cause the contradiction with the IMU: compare again after correction.
            by_imus = _by_imus(samples, track_stretches(_mended(alone.stretches, own), config), config)
        findings += by_imus or []
    if agrees:
        findings = [_of_the_lidar(one) for one in findings]
    vouched = any(lidar.stretches for lidar in samples.lidars.values()) and not unknown
    findings += _in_space(samples, wheels, findings, vouched=vouched)
    doubtful = [one.sensor for one in findings if one.kind in _REGISTERED]
    found_apart = registrations(doubtful) if registrations else registrations_of(log, doubtful, config)
    apart = [name for name, one in found_apart.items() if one.accepted]
    findings = [one for one in findings if one.kind not in _REGISTERED or one.sensor not in apart]
    unknown += [
        f"{name}: its lens and the time of its depth, because its colour is not registered" for name in apart
    ]
    kinds = (samples.lidars, samples.cameras, samples.clouds)
    counts = {name: one.count for kind in kinds for name, one in kind.items()}
    few = [f"{name}: it has only {count} readings" for name, count in counts.items() if count < FEWEST]
    unknown += few if counts else [f"{name}: no other sensor is there to compare" for name in samples.wheels]
    return Diagnosis(findings, unknown)


@dataclass(frozen=True, slots=True)
class _Alone:
    """A 2D lidar alone: its corrected scans, and the motion from them.

    Attributes
    ----------
    scale
        Factor of the ranges.
    turn
        Its rotation, if scans contain beam times.
    floor, findings
        Finding that it sees the floor; all findings, including this.
    """

    stretches: list[list[LaserScan]]
    tracked: list[ScanMotion]
    scale: float
    turn: Turn | None
    floor: list[Finding]
    findings: list[Finding]


def _alone(name: str, stretches: list[list[LaserScan]], config: Config, *, with_wheels: bool) -> _Alone:
    """Examine scans without another sensor."""
    findings = list[Finding]()
    blocked = blocked_beams(stretches, config)
    if blocked is not None and (finding := blocked_finding(name, blocked)):
        findings.append(finding)
        stretches = [[without(scan, blocked) for scan in scans] for scans in stretches]
    middle_m = _median_m(stretches)
    if not with_wheels:
        findings += in_space.unit_finding("lidars", name, middle_m)
    stretches, scale = _within_reach(stretches, middle_m / config.scan.range_max_m)
    turn = turn_by_beam_times(stretches, config) if with_wheels else None
    if turn:
        stretches = [
            [replace(scan, stamp_s=scan.stamp_s + middle_s(scan)) for scan in scans] for scans in stretches
        ]
    tracked = track_stretches(stretches, config)
    floor = floor_findings(name, stretches, tracked, config) if scale == 1.0 else []
    if floor:
        stretches = _mended(stretches, floor)
        tracked = track_stretches(stretches, config)
    return _Alone(stretches, tracked, scale, turn, floor, findings + floor)


def _beside_wheels(
    log: Iterable[Measurement], pair: Pair, alone: _Alone, interval_s: float, config: Config
) -> tuple[list[Finding], list[str]]:
    """Contradictions between a lidar and wheel odometry, and undetermined questions."""
    found, left_open = compare(pair, alone.tracked, config)
    if not (found or left_open):
        with fewer_frames(log, None):
            mended = corrected(log, remedied(Calibration(), alone.floor, only_sure=True))
            lost = lost_sign(mended, pair.wheels, pair.lidar, pair.rows, config)
        found = [lost] if lost else []
    turn = alone.turn if found else alone.turn or turn_in_the_plane(alone.stretches, interval_s, config)
    if turn and all(one.kind == "clock" for one in found):
        found.append(turn.finding("lidars", pair.lidar))
    return found, left_open


def _in_space(
    samples: Samples, wheels: tuple[str, WheelSamples] | None, findings: list[Finding], *, vouched: bool
) -> list[Finding]:
    """Compare cameras and 3D lidars with the corrected wheel odometry, ``vouched`` for by a 2D lidar."""
    rows = np.empty((0, 4)) if wheels is None else wheels[1].rows()
    found = [one for camera in samples.cameras.items() for one in in_space.camera_findings(*camera, rows)]
    doubtful = frozenset(one.sensor for one in found if one.kind in _REGISTERED)
    known = None if wheels is None else mended_rows(wheels[0], rows, findings)
    base = None if wheels is None or known is None else in_space.Base(wheels[0], BaseTrack(known), vouched)
    imus = samples.imus.values()
    for lidar, clouds in samples.clouds.items():
        found += in_space.cloud_findings(lidar, clouds, imus)
        seen = in_space.seen_by("lidars_3d", lidar, clouds, clouds.T_base_lidar, base)
        found += stood_up(lidar, clouds, imus, seen.fit)
    for lidar, clouds in list(samples.clouds.items())[: 0 if samples.lidars else 1]:
        steps = [step for stretch in clouds.steps for step in stretch]
        for name, imu in samples.imus.items():
            new = imu_findings(name, imu, steps, clouds.T_base_lidar, clouds.untimed_s)
            span_s = abs((clouds.turn_s.median() or 0.0) * clouds.times_scale)
            turn_s, timed = (span_s, True) if clouds.turn is None else (abs(clouds.turn.turn_s), False)
            found += [same for one in new for same in stamped(one, lidar, turn_s, timed=timed)]
    if base is None:
        return found
    motions = [
        in_space.seen_by("cameras", name, camera, camera.T_base_camera, base)
        for name, camera in samples.cameras.items()
    ] + [
        in_space.seen_by("lidars_3d", name, clouds, clouds.T_base_lidar, base)
        for name, clouds in samples.clouds.items()
    ]
    units = {one.sensor for one in found if one.kind == "depth scale"}
    against = in_space.findings_against(base, motions, doubtful)
    # A measured depth scale is better than one of the usual units.
    measured = {one.sensor for one in against if one.kind == "depth scale" and one.sensor in units}
    found = [one for one in found if one.kind != "depth scale" or one.sensor not in measured]
    return found + [replace(one, sure=one.sure or one.sensor in measured) for one in against]


def _by_imus(samples: Samples, tracked: list[ScanMotion], config: Config) -> list[Finding] | None:
    """Findings about IMUs, compared with a 2D lidar; None without IMUs or without lidar motion."""
    steps = Steps.of(tracked, config).in_space()
    if not (steps and samples.imus):
        return None
    return [one for name, imu in samples.imus.items() for one in imu_findings(name, imu, steps, None)]


def _mended(stretches: list[list[LaserScan]], findings: list[Finding]) -> list[list[LaserScan]]:
    """Scans corrected by findings."""
    by = remedied(Calibration(), findings, only_sure=False)
    return [cast(list[LaserScan], list(corrected(scans, by))) for scans in stretches]


def _of_the_lidar(finding: Finding) -> Finding:
    """Blame the lidar for a clock offset to the wheels, if another lidar agrees with the wheels."""
    if finding.kind != "clock" or len(finding.remedies) < 2:
        return finding
    (name,) = finding.remedies[1]["lidars"]
    ahead_s, (low_s, high_s) = -(finding.value or 0.0), finding.interval or (0.0, 0.0)
    return replace(
        finding,
        sensor=name,
        text=f"its clock is ahead of {finding.sensor}'s by {ahead_s:+.2f} s (95 %: {-high_s:+.2f} to "
        f"{-low_s:+.2f}); another lidar agrees with {finding.sensor}",
        effect="its scans are placed where the robot was at another time",
        remedies=finding.remedies[1:],
        value=ahead_s,
        interval=(-high_s, -low_s),
    )


def _or_upside_down(finding: Finding, lidar: str) -> Finding:
    """Extend a finding about an IMU with only a lidar: either of them may be upside down."""
    if finding.kind != "turn rates" or (finding.value or 0.0) > 0.0:
        return finding
    remedies = (*finding.remedies, {"lidars": {lidar: {"upside_down": True}}})
    text = f"{finding.text}, or {lidar} is upside down"
    return replace(finding, text=text, remedies=remedies, sure=False)


def _median_m(stretches: list[list[LaserScan]]) -> float:
    """Median of the ranges of scans, 0 if there are none."""
    ranges_m = [one for scans in stretches for one in scans[0].ranges_m if math.isfinite(one)]
    return float(np.median(ranges_m)) if ranges_m else 0.0


def _within_reach(stretches: list[list[LaserScan]], far: float) -> tuple[list[list[LaserScan]], float]:
    """Scans and their factor: millimetres are scaled to ranges that can be matched."""
    if far < 0.5:
        return stretches, 1.0
    # To at most a twentieth of the matching range, as in rooms.
    scale = 10 ** -math.ceil(math.log10(FEWEST * far))
    return [
        [replace(scan, ranges_m=scan.ranges_m * np.float32(scale)) for scan in scans] for scans in stretches
    ], scale


def _stamps(samples: Samples) -> list[Finding]:
    """Find lidars whose stamps are not the measuring times."""
    found, wheels = list[Finding](), [np.diff(one.rows()[:, 0]) for one in samples.wheels.values()]
    for name, lidar in samples.lidars.items():
        count = lidar.count - lidar.repeats.count
        slow_s = [lidar.interval_s.median() or 0.0, *(float(np.median(one)) for one in wheels if one.size)]
        if undated := lidar.undated >= FEWEST and 2 * lidar.undated > count:
            text = f"{lidar.undated} of {count} scans have a stamp not later than the scan before"
        elif len(slow_s) > 1 and min(slow_s) > FEWEST * GAP_S:
            text = f"its scans come every {slow_s[0]:.4g} s, the wheels' readings every {slow_s[1]:.4g} s"
        else:
            continue
        effect = "if stamps are no seconds, clocks, speeds and all that was joined over time are wrong"
        found.append(Finding(name, "stamps", text, effect, sure=undated))
    return found
