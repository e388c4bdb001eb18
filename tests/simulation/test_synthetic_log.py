"""The synthetic log: exact rays, a drive that keeps clear of walls, and files that show the truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from flat_worlds import clearance_m

from slam.datasets import open_dataset
from slam.errors import ConfigError
from slam.measurements import LaserScan, WheelOdometry, row_from_pose2
from slam.simulation.floor_plan import TOUR_M, cast_rays, walls
from slam.simulation.synthetic_log import SyntheticLogConfig, drive_tour, wheel_odometry, write_synthetic_log

CONFIG = SyntheticLogConfig()


def rotated(points: np.ndarray, yaw_rad: float, offset: np.ndarray) -> np.ndarray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return points @ np.array([[c, s], [-s, c]]) + offset


@pytest.mark.parametrize(("yaw_rad", "offset"), [(0.0, [0.0, 0.0]), (0.7, [3.0, -8.0]), (-2.9, [-40.0, 5.0])])
def test_rays_in_a_box_have_their_closed_form(yaw_rad: float, offset: list[float]) -> None:
    corners = np.array([[-2.0, -1.0], [3.0, -1.0], [3.0, 1.0], [-2.0, 1.0], [-2.0, -1.0]])
    moved = rotated(corners, yaw_rad, np.array(offset))
    segments = np.hstack([moved[:-1], moved[1:]])[:3]  # the west side is open
    bearings = np.array([0.0, 0.5 * math.pi, -0.5 * math.pi, math.pi, math.atan2(1.0, 2.0)])
    ranges = cast_rays(segments, np.array(offset), bearings + yaw_rad)
    np.testing.assert_allclose(ranges, [3.0, 1.0, 1.0, np.inf, math.sqrt(5.0)], rtol=1e-12)


def test_the_nearest_wall_hides_the_farther() -> None:
    segments = np.array([[5.0, -1.0, 5.0, 1.0], [2.0, -1.0, 2.0, 1.0], [-1.0, -1.0, -1.0, 1.0]])
    assert cast_rays(segments, np.zeros(2), np.zeros(1))[0] == pytest.approx(2.0)


def test_clearance_of_a_segment() -> None:
    points = np.array([[0.5, 2.0], [4.0, 4.0], [-3.0, 0.0]])
    np.testing.assert_allclose(clearance_m(np.array([[0.0, 0.0, 1.0, 0.0]]), points), [2.0, 5.0, 3.0])


def test_the_drive_is_smooth_clear_of_walls_and_returns_twice() -> None:
    poses = drive_tour(CONFIG, CONFIG.duration_s)
    assert clearance_m(walls(), poses[:, :2]).min() > 0.4
    step = np.diff(poses, axis=0)
    speed = np.hypot(step[:, 0], step[:, 1]) * CONFIG.odometry_rate_hz
    turn = np.arctan2(np.sin(step[:, 2]), np.cos(step[:, 2])) * CONFIG.odometry_rate_hz
    assert speed.max() <= CONFIG.speed_m_s + 1e-9
    assert np.abs(turn).max() <= CONFIG.turn_rate_rad_s + 1e-9
    limit = CONFIG.acceleration_m_s2 / CONFIG.odometry_rate_hz
    assert np.abs(np.diff(speed)).max() <= 1.5 * limit
    near = np.hypot(*(poses[:, :2] - TOUR_M[0]).T) < 0.5
    assert np.count_nonzero(np.diff(near.astype(int)) == 1) >= 2
    rooms = [(9, 7), (3, 7), (10, 1.5), (6, 1.4), (2, 1.5)]
    assert all(np.hypot(*(poses[:, :2] - room).T).min() < 0.5 for room in rooms)


def test_perfect_wheels_show_the_truth_and_real_ones_drift() -> None:
    poses = drive_tour(CONFIG, 60.0)
    perfect = SyntheticLogConfig(
        wheel_scale_left=1.0, wheel_scale_right=1.0, wheel_sigma=0.0, slips_per_s=0.0
    )
    reported = wheel_odometry(perfect, poses, np.random.default_rng(0))
    in_map = rotated(reported[:, :2], poses[0, 2], poses[0, :2])
    # Arcs are taken as chords within one reading, so a little is lost.
    np.testing.assert_allclose(in_map, poses[:, :2], atol=0.02)
    drifted = wheel_odometry(CONFIG, poses, np.random.default_rng(0))
    assert np.hypot(*(drifted[-1, :2] - reported[-1, :2])) > 0.5


def test_the_reader_finds_what_was_written(tmp_path: Path) -> None:
    log = write_synthetic_log(tmp_path / "new", duration_s=20.0)
    dataset = open_dataset(log.log_path, strict=True)
    measurements = list(dataset)
    scans = [m for m in measurements if isinstance(m, LaserScan)]
    odometry = [m for m in measurements if isinstance(m, WheelOdometry)]
    assert (len(scans), len(odometry)) == (log.scan_count, log.odometry_count) == (101, 201)
    assert not dataset.report.notes
    assert dataset.report.odometry_jumps.count == 0
    truth = np.loadtxt(log.truth_path)
    np.testing.assert_array_equal(truth[:, 0], [m.stamp_s for m in odometry])
    np.testing.assert_array_equal(truth[:, 1:4], log.truth.positions_m)
    np.testing.assert_array_equal(truth[:, 4:], log.truth.quaternions_xyzw)


def test_scans_placed_by_the_truth_lie_on_the_walls(tmp_path: Path) -> None:
    log = write_synthetic_log(tmp_path, seed=4, duration_s=45.0)
    truth = dict(zip(log.truth.stamps_s.round(6), log.truth.to_planar(), strict=True))
    segments = walls()
    errors, no_returns, beams = [], 0, 0
    for scan in open_dataset(log.log_path):
        if not isinstance(scan, LaserScan):
            continue
        x, y, yaw = truth[round(scan.stamp_s, 6)]
        mount = row_from_pose2(scan.T_base_laser)
        origin = rotated(mount[:2], yaw, np.array([x, y]))
        exact = cast_rays(segments, origin, scan.bearings_rad() + yaw + mount[2])
        hit = np.isfinite(scan.ranges_m)
        errors.append(scan.ranges_m[hit] - exact[hit])
        no_returns += np.count_nonzero(np.isinf(scan.ranges_m))
        beams += hit.size
        assert scan.range_max_m == CONFIG.range_max_m
        assert np.isinf(exact[~hit]).sum() >= np.count_nonzero(~hit) - 8  # the rest are dropouts
    error = np.concatenate(errors)
    assert abs(error.mean()) < 2e-4
    assert error.std() == pytest.approx(CONFIG.range_sigma_m, rel=0.03)
    assert 0.01 < no_returns / beams < 0.2


def test_the_seed_decides_every_byte(tmp_path: Path) -> None:
    first, again, other = (
        write_synthetic_log(tmp_path / name, seed=seed, duration_s=12.0)
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    assert first.log_path.read_bytes() == again.log_path.read_bytes()
    assert first.truth_path.read_bytes() == again.truth_path.read_bytes() == other.truth_path.read_bytes()
    assert first.log_path.read_bytes() != other.log_path.read_bytes()
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["groundtruth.txt", "scans.log"]


@pytest.mark.parametrize("duration_s", [0.0, -1.0, math.nan, math.inf])
def test_a_useless_duration_is_refused(tmp_path: Path, duration_s: float) -> None:
    with pytest.raises(ConfigError, match="duration_s"):
        write_synthetic_log(tmp_path, duration_s=duration_s)
