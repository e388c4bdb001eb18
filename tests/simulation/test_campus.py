"""A drive through a campus: its files, read by other means than they were written, against the truth."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.datasets import open_dataset
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.evaluation.relations import read_relations, score_relations
from slam.measurements import FloatArray, LaserScan, WheelOdometry, pose2_from_row
from slam.simulation.campus import CampusDrive, record_campus
from slam.simulation.campus_drive import scan_steps, travelled_m
from slam.simulation.campus_plan import generate_campus
from slam.simulation.campus_wheels import CAMPUS_FAULTS, CampusFaults, campus_wheels
from slam.simulation.steering import STEP_S
from slam.storage.tum import read_tum

HOME, SEED = 1, 5
CUT_S = 60.0
USUAL = CAMPUS_FAULTS["usual"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("campus") / "drive"


@pytest.fixture(scope="module")
def drive(folder: Path) -> CampusDrive:
    """A whole one."""
    return record_campus(HOME, SEED, folder, USUAL)


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its beginning."""
    folder = tmp_path_factory.mktemp("campus") / "cut"
    record_campus(HOME, SEED, folder, USUAL, CUT_S)
    return folder


@pytest.fixture(scope="module")
def truth(folder: Path, drive: CampusDrive) -> Trajectory:
    return read_tum(folder / "groundtruth.txt")


def scans_of(folder: Path) -> list[LaserScan]:
    return [reading for reading in open_dataset(folder) if isinstance(reading, LaserScan)]


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def plan_of(folder: Path) -> dict[str, FloatArray]:
    rows = [line.split() for line in (folder / "truth" / "plan.txt").read_text().splitlines()]
    return {
        kind: np.array([[float(value) for value in row[1:]] for row in rows if row[0] == kind])
        for kind in ("wall", "glass")
    }


def off_walls_m(points: FloatArray, segments: FloatArray) -> FloatArray:
    """Distance of each point (N, 2) to the nearest segment (S, 4)."""
    start, step = segments[:, :2], segments[:, 2:] - segments[:, :2]
    along = ((points[:, None] - start) * step).sum(axis=2) / np.maximum((step**2).sum(axis=1), 1e-12)
    nearest = start + np.clip(along, 0.0, 1.0)[..., None] * step
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1))


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(cut: Path, tmp_path: Path) -> None:
    record_campus(HOME, SEED, tmp_path / "again", USUAL, CUT_S)
    record_campus(HOME, SEED + 1, tmp_path / "other", USUAL, CUT_S)
    once, again, other = digests(cut), digests(tmp_path / "again"), digests(tmp_path / "other")
    assert once == again
    assert {name for name in once if once[name] == other[name]} == {"plan.txt"}


def test_a_drive_is_as_long_as_stated(drive: CampusDrive, truth: Trajectory) -> None:
    assert 1500.0 < drive.path_m < 3000.0
    assert 3200 < drive.scans < 4500
    assert len(truth) == drive.scans
    # Chords between scans are a little shorter than the way.
    assert 0.97 * drive.path_m < travelled_m(truth.to_planar())[-1] <= drive.path_m


def test_a_cut_drive_is_the_beginning_of_the_whole_one(folder: Path, drive: CampusDrive, cut: Path) -> None:
    begun = (cut / "scans.log").read_text()
    assert (folder / "scans.log").read_text().startswith(begun)
    facts = json.loads((cut / "truth" / "faults.json").read_text())
    assert facts["duration_s"] == CUT_S
    assert facts["scans"] == begun.count("FLASER") < drive.scans
    errors = [error for error in drive.gross_errors if error.first <= CUT_S * 10.0]
    assert [error["first"] for error in facts["gross_errors"]] == [error.first for error in errors]


def test_the_robot_keeps_off_the_walls(folder: Path, truth: Trajectory) -> None:
    walls = np.concatenate(list(plan_of(folder).values()))
    assert off_walls_m(truth.positions_m[::4, :2], walls).min() > 0.3


def test_beams_end_on_walls_where_the_truth_says_they_were_cast(folder: Path, truth: Trajectory) -> None:
    plan, poses = plan_of(folder), truth.to_planar()
    walls = np.concatenate([plan["wall"], plan["glass"]])
    ends, cast = [], 0
    for scan, stamp_s, row in list(zip(scans_of(folder), truth.stamps_s, poses, strict=True))[::80]:
        assert scan.stamp_s == pytest.approx(stamp_s, abs=1e-9)
        cast += scan.ranges_m.size
        laser = pose2_from_row(row) * scan.T_base_laser
        points = scan.points_laser() @ laser.rotation().matrix().T + laser.translation()
        ends.append(off_walls_m(points, walls))
    off_m = np.concatenate(ends)
    assert off_m.size > 0.95 * cast
    # The rest are people; noise is 1 cm along the beam.
    assert np.mean(off_m < 0.05) > 0.97
    assert np.mean(off_m < 0.05) < 1.0


def test_gaps_are_as_many_and_as_long_as_stated(drive: CampusDrive, truth: Trajectory) -> None:
    apart_s = np.diff(truth.stamps_s)
    gaps_s = apart_s[apart_s >= 5.0]
    assert len(gaps_s) == USUAL.gaps == len(drive.gaps_s)
    assert gaps_s.max() <= 28.0 + STEP_S
    assert apart_s[apart_s < 5.0].max() <= 4.0 + 1e-6


def test_the_log_shows_what_the_wheels_say(folder: Path, drive: CampusDrive, truth: Trajectory) -> None:
    stated = [reading for reading in open_dataset(folder) if isinstance(reading, WheelOdometry)]
    facts = json.loads((folder / "truth" / "faults.json").read_text())
    assert len(facts["gross_errors"]) == len(drive.gross_errors) == USUAL.gross_errors
    assert {error["kind"] for error in facts["gross_errors"]} == {"heading", "position", "standstill"}
    assert 0.05 <= drive.lag_s <= 0.15
    stamps_s = np.array([reading.stamp_s for reading in stated])
    assert np.all(np.diff(stamps_s) >= 0.0)
    headings = [
        error for error in facts["gross_errors"] if error["kind"] == "heading" and error["size"] > 1.0
    ]
    for error in headings:
        after = int(np.searchsorted(stamps_s, 1000.0 + error["first"] / 10.0 - 1e-6))
        swung = abs(stated[after - 1].T_odom_base.between(stated[after].T_odom_base).theta())
        assert swung == pytest.approx(error["size"], abs=0.15)
    assert len(headings) > 10


def test_relations_agree_with_the_truth_and_reach_back(folder: Path, truth: Trajectory) -> None:
    relations = read_relations(folder / "campus.relations")
    score = score_relations(truth, relations)
    assert score.skipped == 0
    assert score.all.translation_m.max < 1e-6
    assert score.all.rotation_rad.max < 1e-6
    back_s = relations.second_stamps_s - relations.first_stamps_s
    assert np.count_nonzero(back_s > 60.0) > 0.3 * len(truth)
    assert np.hypot(*relations.xyz_rpy[back_s > 60.0, :2].T).max() <= 2.0


def test_a_sign_turned_in_the_relations_is_seen(folder: Path, truth: Trajectory, tmp_path: Path) -> None:
    lines = (folder / "campus.relations").read_text().splitlines()
    fields: list[Any] = lines[len(lines) // 2].split()
    fields[2] = str(float(fields[2]) + 0.1)
    (tmp_path / "bad.relations").write_text(" ".join(fields))
    score = score_relations(truth, read_relations(tmp_path / "bad.relations"))
    assert score.all.translation_m.max == pytest.approx(0.1, abs=1e-6)


def test_without_faults_the_way_is_the_same_and_the_wheels_are_right(
    folder: Path, drive: CampusDrive, truth: Trajectory, tmp_path: Path
) -> None:
    clean = record_campus(HOME, SEED, tmp_path / "clean", CAMPUS_FAULTS["none"], CUT_S)
    assert (clean.lag_s, clean.gaps_s, clean.gross_errors) == (0.0, (), ())
    poses = read_tum(tmp_path / "clean" / "groundtruth.txt")
    # The faulty drive's scans outside its gaps are taken at the same places.
    same = np.isin(np.round(truth.stamps_s - drive.lag_s, 3), np.round(poses.stamps_s, 3))
    both = np.isin(np.round(poses.stamps_s, 3), np.round(truth.stamps_s - drive.lag_s, 3))
    assert np.count_nonzero(both) > 0.8 * len(poses)
    np.testing.assert_array_equal(poses.positions_m[both], truth.positions_m[same])
    # Each scan's line shows the wheels' pose at its stamp: between two readings, too.
    wheels = {
        reading.stamp_s: reading.T_odom_base
        for reading in open_dataset(tmp_path / "clean")
        if isinstance(reading, WheelOdometry)
    }
    stated = [wheels[stamp_s] for stamp_s in poses.stamps_s.tolist()]
    true = [pose2_from_row(row) for row in poses.to_planar()]
    for n in range(1, len(stated)):
        missed = true[n - 1].between(true[n]).between(stated[n - 1].between(stated[n]))
        assert math.hypot(missed.x(), missed.y()) < 0.01
        assert abs(missed.theta()) < 0.02


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(DatasetError, match="not an empty folder"):
        record_campus(HOME, SEED, tmp_path, USUAL, 10.0)
    assert (tmp_path / "mine.txt").read_text() == "kept"


def straight(length_m: float, rate_hz: float) -> FloatArray:
    """A metre a second along x."""
    x = np.arange(round(length_m * rate_hz) + 1) / rate_hz
    return np.column_stack([x, 0.0 * x, 0.0 * x])


@pytest.mark.parametrize("count", [0, 1, 40])
def test_between_gross_errors_the_wheels_count_rightly(count: int) -> None:
    faults = CampusFaults(gross_errors=count, wheels=CampusFaults().wheels)
    wheels = campus_wheels(faults, straight(400.0, 10.0), np.random.default_rng(2))
    assert len(wheels.errors) == count
    step = np.hypot(*np.diff(wheels.poses_xyt[:, :2], axis=0).T)
    turn = np.abs(np.angle(np.exp(1j * np.diff(wheels.poses_xyt[:, 2]))))
    wrong = np.zeros(len(step), dtype=bool)
    for error in wheels.errors:
        wrong[error.first - 1 : error.last] = True
        between = slice(error.first - 1, error.last)
        if error.kind == "position":
            assert step[between].max() > error.size - 0.2
        elif error.kind == "standstill":
            assert not wheels.is_logged[error.first : error.last].any()
            assert error.size == pytest.approx((error.last - error.first + 1) / 10.0)
    assert np.all(np.abs(step[~wrong] - 0.1) < 0.01)
    assert np.all(turn[~wrong] < 0.01)


def test_scans_are_due_by_turn_and_by_time_too() -> None:
    standing = np.zeros((1000, 3))
    turning = np.column_stack([np.zeros((1000, 2)), 0.01 * np.arange(1000)])
    driving = np.column_stack([100.0 + 0.02 * np.arange(100_000), np.zeros((100_000, 2))])
    steps = scan_steps(np.concatenate([standing, turning, driving]), 0, np.random.default_rng(1))
    apart = np.diff(steps)
    assert np.all(apart[steps[1:] < 1000] == 200)
    turned = apart[(steps[:-1] >= 1000) & (steps[1:] < 2000)]
    assert set(turned.tolist()) <= {35, 36}
    assert 3400 < np.count_nonzero(steps > 2000) < 3600


def test_buildings_have_two_patterns_rings_and_look_alike_wings() -> None:
    for seed in range(3):
        campus = generate_campus(seed)
        assert 100.0 < np.ptp(campus.walls_m, axis=0).max() < 320.0
        assert 700.0 < campus.corridor_m < 2000.0
        # A connected net with several rings: as many as corridors are more than a tree has.
        assert len(campus.corridors) - len(campus.junctions_m) + 1 >= 5
        wings = [corridor.style for corridor in campus.corridors if corridor.style[0] < 2]
        assert {wings.count(style) for style in wings} <= {2, 3}
