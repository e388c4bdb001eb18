"""The doctor: mistakes that people make are named with what mends them, and a sound drive has none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np
import pytest
from flat_worlds import corridor, sweep

from slam.config import Config
from slam.config.calibration import Calibration
from slam.datasets import open_dataset
from slam.datasets.corrections import corrected
from slam.doctor.diagnosis import diagnose, examine
from slam.doctor.finding import Finding, remedied
from slam.doctor.own_body import blocked_beams
from slam.doctor.relation import relate
from slam.doctor.wheel_steps import Reading, WheelSteps
from slam.doctor.wheels_and_lidar import fits_as_read
from slam.mapper.pipeline import settled
from slam.measurements import LaserScan, Measurement, WheelOdometry, pose2_from_row
from slam.simulation.synthetic_log import write_synthetic_log
from tools.sensor_mistakes import MISTAKES, Log, right_remedy


@cache
def sound() -> Log:
    with TemporaryDirectory() as folder:
        return list(open_dataset(write_synthetic_log(Path(folder), seed=1, duration_s=40.0).log_path))


def test_a_sound_drive_has_no_finding() -> None:
    assert diagnose(sound()) == []


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_with_what_mends_it(name: str) -> None:
    mistake = MISTAKES[name]
    size = mistake.sizes[0]
    wrong = mistake.make(sound(), size)
    findings = diagnose(wrong)
    assert [finding.kind for finding in findings] == [mistake.kind]
    assert right_remedy(findings[0], mistake.remedy(size), sound())
    if name == "wheels left for right" or not findings[0].remedies:
        return  # nothing mends it, or nobody can show which of two does
    mended = remedied(Calibration(), findings, only_sure=False)
    assert diagnose(corrected(wrong, mended)) == []


@pytest.mark.parametrize("late", ["FRONT", "FLASER"])
def test_of_two_lidars_the_one_that_the_wheels_contradict_has_the_wrong_clock(late: str) -> None:
    """Until then the wheel odometry was moved, and half of the poses were wrong without a word."""
    front = [replace(one, sensor="FRONT") for one in sound() if isinstance(one, LaserScan)]
    both = sorted([*sound(), *front], key=lambda one: one.stamp_s)
    (finding,) = diagnose(
        [replace(one, stamp_s=one.stamp_s + 0.4) if one.sensor == late else one for one in both]
    )
    assert finding.kind == "clock" and finding.sensor == late and finding.sure
    ((kind, entries),) = finding.remedies[0].items()
    assert kind == "lidars" and entries[late]["clock_offset_s"] == pytest.approx(0.4, abs=0.06)
    low, high = finding.interval or (0.0, 0.0)
    assert low < 0.4 < high


@pytest.mark.parametrize("later_s", [0.0, 0.05])
@pytest.mark.parametrize("other", [np.s_[::-1], np.s_[::2]], ids=["looks back", "fewer beams"])
def test_two_scanners_of_one_name_are_reported(other: slice, later_s: float) -> None:
    """Half of the scans were placed in a mirrored building, and nothing was reported."""
    mixed = list[Measurement]()
    for one in sound():
        mixed.append(one)
        if isinstance(one, LaserScan):
            mixed.append(replace(one, stamp_s=one.stamp_s + later_s, ranges_m=one.ranges_m[other]))
    found = [one for one in diagnose(mixed) if one.kind == "two scanners"]
    assert len(found) == 1 and not found[0].sure and found[0].remedies == ()


@pytest.mark.parametrize(("until_s", "kinds"), [(1025.0, ["repeated scans"]), (1020.3, [])])
def test_scans_that_hang_are_reported_where_the_wheels_drive_on(until_s: float, kinds: list[str]) -> None:
    last = next(one for one in sound() if isinstance(one, LaserScan) and one.stamp_s > 1020.0)
    hangs = [
        replace(one, ranges_m=last.ranges_m)
        if isinstance(one, LaserScan) and last.stamp_s < one.stamp_s < until_s
        else one
        for one in sound()
    ]
    assert [one.kind for one in diagnose(hangs)] == kinds


@pytest.mark.parametrize("jump_rad", [0.6, 2.4, -3.04])
def test_a_heading_that_jumps_a_few_times_is_no_mistake_of_units(jump_rad: float) -> None:
    """Once, a campus was mapped with the rotations of its wheels divided by 7690."""
    jumps_s, stated = [1004.15, 1011.65, 1019.15], list[LaserScan | WheelOdometry]()
    for one in sound():
        if isinstance(one, WheelOdometry):
            turned = gtsam.Pose2(0.0, 0.0, jump_rad * sum(one.stamp_s > at_s for at_s in jumps_s))
            one = replace(one, T_odom_base=turned.compose(one.T_odom_base))
        stated.append(one)
    assert diagnose(stated) == []


def longer(log: Log, factor: float) -> Log:
    """Ranges and wheels."""
    return MISTAKES["odometry scaled"].make(MISTAKES["ranges in mm or cm"].make(log, factor), factor)


def seated(log: Log, x_m: float) -> Log:
    """A lidar that is stated to sit ahead of where wheels turn by so much."""
    mount = gtsam.Pose2(x_m, 0.0, 0.0)
    return [replace(one, T_base_laser=mount) if isinstance(one, LaserScan) else one for one in log]


@pytest.mark.parametrize("unit", [1e-3, 1e-2])
def test_ranges_and_wheels_in_one_wrong_unit_are_both_named(unit: float) -> None:
    found = diagnose(longer(sound(), 1.0 / unit))
    assert [(one.kind, one.value, one.sure) for one in found] == [
        ("range scale", unit, True),
        ("scale", unit, True),
    ]
    mended = remedied(Calibration(), found, only_sure=True)
    assert diagnose(corrected(longer(sound(), 1.0 / unit), mended)) == []


def test_without_a_lever_only_what_no_lidar_reaches_is_reported_and_as_perhaps() -> None:
    at_once = seated(sound(), 0.0)
    found = diagnose(longer(at_once, 1e3))
    assert [(one.kind, one.sure) for one in found[:2]] == [("range scale", False), ("scale", False)]


@pytest.mark.parametrize("unit", [1000.0, 100.0])
def test_without_wheels_ranges_that_no_lidar_sees_are_named(unit: float) -> None:
    wrong = MISTAKES["ranges in mm or cm"].make(sound(), unit)
    found = diagnose([one for one in wrong if isinstance(one, LaserScan)])
    assert [(one.kind, one.remedies[0]["lidars"], one.sure) for one in found] == [
        ("range scale", {one.sensor: {"range_scale": 1.0 / unit} for one in found}, True)
    ]


def test_wide_places_are_no_wrong_unit() -> None:
    lever_m = next(one for one in sound() if isinstance(one, LaserScan)).T_base_laser.x()
    assert diagnose(seated(longer(sound(), 20.0), 20.0 * lever_m)) == []


@pytest.mark.parametrize(
    ("stamp_s", "sure"),
    [
        (lambda one_s: 1e3 * one_s, False),
        (lambda one_s: 1e6 * one_s, False),
        (lambda one_s: 0.0, True),
        (lambda one_s: np.floor(one_s), True),
    ],
)
def test_stamps_that_show_no_time_are_named(stamp_s: Callable[[float], float], sure: bool) -> None:
    found = diagnose([replace(one, stamp_s=float(stamp_s(one.stamp_s))) for one in sound()])
    assert [(one.kind, one.sure) for one in found] == [("stamps", sure)]


def test_what_two_sensors_cannot_distinguish_is_not_sure_and_names_both() -> None:
    for name in ("lidar upside down", "wheels left for right"):
        (finding,) = diagnose(MISTAKES[name].make(sound(), 0.0))
        assert not finding.sure
        assert [kind for remedy in finding.remedies for kind in remedy] == ["lidars", "wheels"]
        assert " or " in finding.line and "perhaps" in finding.line


def test_the_mapper_takes_only_what_is_sure_and_leaves_what_a_person_says() -> None:
    sure = Finding("odometry", "scale", "", "", ({"wheels": {"odometry": {"scale": 0.001}}},), sure=True)
    doubtful = Finding("FLASER", "mirrored", "", "", ({"lidars": {"FLASER": {"upside_down": True}}},))
    found = settled(Config(), [sure, doubtful]).sensors.calibration
    assert found.plain() == {"wheels": {"odometry": {"scale": 0.001}}}
    said = found.merged({"wheels": {"odometry": {"scale": 0.5, "mirrored": True}}})
    assert said.plain() == {"wheels": {"odometry": {"scale": 0.001, "mirrored": True}}}


def test_a_finding_is_one_line_and_comes_back_from_plain_values() -> None:
    for finding in diagnose(MISTAKES["lidar yaw"].make(sound(), 10.0)):
        assert "\n" not in finding.line
        assert Finding.from_plain(finding.plain()) == finding
        assert finding.value is not None and finding.interval is not None
        assert finding.interval[0] < finding.value < finding.interval[1]


def test_a_drive_without_turns_leaves_open_what_turns_show() -> None:
    straight = [
        one
        for n in range(120)
        for one in (
            WheelOdometry(0.1 * n, pose2_from_row([0.05 * n, 0.0, 0.0])),
            sweep(corridor(4.0), [0.05 * n - 3.0, 0.0, 0.0], sigma_m=0.005, seed=n, stamp_s=0.1 * n),
        )
    ]
    diagnosis = examine(straight)
    assert diagnosis.findings == []
    assert len(diagnosis.open) == 1


def test_a_log_that_shows_little_has_no_finding() -> None:
    for log in ([], sound()[:30], [one for one in sound() if isinstance(one, LaserScan)]):
        assert diagnose(log) == []


def test_lidars_without_a_return_have_no_finding() -> None:
    blind = [
        replace(one, ranges_m=np.full_like(one.ranges_m, np.inf)) if isinstance(one, LaserScan) else one
        for one in sound()
    ]
    assert diagnose(blind) == []


def test_the_relation_is_found_among_outliers_and_its_interval_holds_the_truth() -> None:
    # Many draws: the 95 % interval of the angle and of the lever hold the truth about as often as they say.
    rng, held = np.random.default_rng(0), []
    alpha, beta = 0.98 * np.exp(-0.2j), 0.2 - 0.1j
    for _ in range(200):
        wheels = rng.uniform(0.1, 0.4, 80) + 0j
        turns = rng.normal(0.0, 0.3, 80)
        noise = rng.normal(0.0, 0.003, 80) + 1j * rng.normal(0.0, 0.003, 80)
        noise[::10] += rng.normal(0.0, 0.5, 8)
        found = relate(
            alpha * wheels + beta * (np.exp(1j * turns) - 1.0) + noise, turns, wheels, np.arange(80) // 4
        )
        assert found is not None
        held.append(
            [
                abs(found.yaw_rad - 0.2) < 1.96 * found.sigma_alpha,
                abs(found.beta - beta) < 2.45 * found.sigma_beta,
            ]
        )
    shares = np.mean(held, axis=0)
    assert (shares > 0.93).all()


@pytest.mark.parametrize(("lost_m", "fits"), [(0.0, True), (0.2, False)])
def test_short_steps_of_turns_in_place_fit_as_well_as_matches_are(lost_m: float, fits: bool) -> None:
    """Two steps in three are a turn in place that swings the lidar 5 cm, by matches that are off 4 mm."""
    rng = np.random.default_rng(1)
    turns = rng.choice([-0.25, 0.25], 90)
    stated = np.where(np.arange(90) % 3, 0.005, 0.22) + 0j
    lidar = stated + 0.2 * (np.exp(1j * turns) - 1.0) + rng.normal(0.0, 0.004, (90, 2)) @ [1.0, 1.0j]
    stated = stated + lost_m * rng.normal(0.0, 1.0, (90, 2)) @ [1.0, 1.0j]
    places, headings = np.stack([0.0 * stated, stated], axis=1), np.zeros((90, 2))
    wheels = WheelSteps(lidar, turns, np.arange(90) // 6, places, headings)
    found = wheels.related(Reading())
    assert found is not None and fits_as_read(wheels, Reading(), found, Config()) == fits


def test_a_short_drive_reports_blocked_beams() -> None:
    """Eight stretches of 2 s have 16 ends, and more than 20 places."""
    rng = np.random.default_rng(1)
    stretches = [
        [
            LaserScan(10.0 * n + 0.1 * k, np.r_[np.full(30, 0.4), rng.uniform(1.0, 5.0, 90)], -1.5, 0.02, 8.0)
            for k in range(20)
        ]
        for n in range(8)
    ]
    blocked = blocked_beams(stretches, Config())
    assert blocked is not None and np.flatnonzero(blocked).tolist() == list(range(30))
    assert blocked_beams(stretches[:3], Config()) is None


def tilted(log: Log, at_m: float, bearing_rad: float) -> Log:
    """A lidar that sees the floor on a line, to 1 %."""
    rng = np.random.default_rng(1)

    def seen(scan: LaserScan) -> LaserScan:
        ahead = np.cos(scan.bearings_rad() - bearing_rad)
        floor_m = np.where(ahead > 0.05, at_m * rng.normal(1.0, 0.01) / np.maximum(ahead, 0.05), np.inf)
        return replace(scan, ranges_m=np.fmin(scan.ranges_m, floor_m).astype(np.float32))

    return [seen(one) if isinstance(one, LaserScan) else one for one in log]


@pytest.mark.parametrize("wheels", [True, False])
def test_the_floor_that_a_tilted_lidar_sees_is_reported_and_left_out(wheels: bool) -> None:
    log = [one for one in tilted(sound(), 2.5, 0.2) if wheels or isinstance(one, LaserScan)]
    (found,) = diagnose(log)
    assert (found.kind, found.sure) == ("floor", True)
    (line,) = [one["floor"] for one in found.remedies[0]["lidars"].values()]
    assert line["from_m"] == pytest.approx(0.9 * 2.5, rel=0.05)
    assert line["bearing_deg"] == pytest.approx(math.degrees(0.2), abs=6.0)
    assert diagnose(corrected(log, remedied(Calibration(), [found], only_sure=True))) == []


def test_a_clock_that_is_set_back_is_no_mistake_of_the_sensors() -> None:
    half = sound()[len(sound()) // 2].stamp_s
    back = [replace(one, stamp_s=one.stamp_s - (25.0 if one.stamp_s > half else 0.0)) for one in sound()]
    assert diagnose(back) == []
