"""A small synthetic CARMEN log with its exact ground truth, for the demo and the tests.

A differential-drive robot tours the building of `slam.simulation.floor_plan` with a SICK-like lidar;
its wheels slip. The same seed gives the same bytes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.errors import ConfigError
from slam.estimates import Trajectory
from slam.measurements import FloatArray
from slam.simulation.floor_plan import TOUR_M, cast_rays, walls
from slam.simulation.steering import limited
from slam.storage.files import write_lines
from slam.storage.tum import write_tum


@dataclass(frozen=True, slots=True)
class SyntheticLogConfig:
    """The robot, its sensors and their faults.

    Attributes
    ----------
    duration_s
        Duration of the drive; each of the tour's two loops takes about 40 s.
    speed_m_s, turn_rate_rad_s
        Largest speed and turn rate.
    acceleration_m_s2, turn_acceleration_rad_s2
        Largest change of them.
    lookahead_m
        Lookahead distance of the steering.
    odometry_rate_hz, scan_every
        Wheel readings per second, and number of them per scan.
    beams, fov_rad
        Number of beams and field of view, including both edges.
    range_max_m, range_sigma_m, dropout_share
        Beams beyond the maximum, and this share of the others, have no return.
    laser_offset_m
        Forward offset of the laser from the robot's centre.
    wheel_base_m
        Distance between the wheels.
    wheel_scale_left, wheel_scale_right
        Distance that a wheel reports per metre of true travel, for unevenly worn tyres.
    wheel_sigma
        Noise of a wheel, metres per square root of a metre.
    slips_per_s, slip_duration_s, slip_share
        Rate, duration and excess of wheel slip while driving.
    first_stamp_s
        Stamp of the first reading.
    """

    duration_s: float = 120.0
    speed_m_s: float = 0.6
    turn_rate_rad_s: float = 1.0
    acceleration_m_s2: float = 0.6
    turn_acceleration_rad_s2: float = 3.0
    lookahead_m: float = 0.5
    odometry_rate_hz: float = 10.0
    scan_every: int = 2
    beams: int = 361
    fov_rad: float = math.pi
    range_max_m: float = 30.0
    range_sigma_m: float = 0.01
    dropout_share: float = 0.002
    laser_offset_m: float = 0.1
    wheel_base_m: float = 0.4
    wheel_scale_left: float = 1.01
    wheel_scale_right: float = 0.995
    wheel_sigma: float = 0.01
    slips_per_s: float = 0.05
    slip_duration_s: float = 0.5
    slip_share: float = 0.3
    first_stamp_s: float = 1000.0


@dataclass(frozen=True, slots=True)
class SyntheticLog:
    """The written files.

    Attributes
    ----------
    log_path, truth_path
        ``scans.log`` (CARMEN) and ``groundtruth.txt`` (TUM, the robot in the map frame).
    truth
        The true pose at every odometry stamp, map frame; it starts at the tour's first point.
    scan_count, odometry_count
        Number of FLASER and ODOM lines.
    """

    log_path: Path
    truth_path: Path
    truth: Trajectory
    scan_count: int
    odometry_count: int


_CONTROL_STEPS = 5  # steering steps between two odometry readings
_SHORTEST_S = 10.0  # a drive that still leaves its start


def write_synthetic_log(
    directory: Path | str,
    *,
    seed: int = 0,
    duration_s: float | None = None,
    config: SyntheticLogConfig | None = None,
) -> SyntheticLog:
    """Drive the tour and write the log and its ground truth.

    Parameters
    ----------
    directory
        Folder of the two files; created if missing, files of the same name are replaced.
    seed
        Seed of all noise.
    duration_s
        Overrides the configured duration. The robot repeats the tour until the time is up.
    config
        The robot and its sensors.

    Raises
    ------
    ConfigError
        A duration below 10 s.
    """
    config = config or SyntheticLogConfig()
    duration = config.duration_s if duration_s is None else duration_s
    if not _SHORTEST_S <= duration < math.inf:
        raise ConfigError(f"duration_s is {duration}; give {_SHORTEST_S:.0f} s or more")
    rng = np.random.default_rng(seed)
    poses = drive_tour(config, duration)
    stamps_s = config.first_stamp_s + np.arange(len(poses)) / config.odometry_rate_hz
    odometry = wheel_odometry(config, poses, rng)
    truth = Trajectory.from_planar(stamps_s, poses)
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    log_path, truth_path = directory / "scans.log", directory / "groundtruth.txt"
    write_lines(log_path, _log_lines(config, stamps_s, poses, odometry, rng))
    write_tum(truth_path, truth)
    return SyntheticLog(
        log_path=log_path,
        truth_path=truth_path,
        truth=truth,
        scan_count=len(range(0, len(poses), config.scan_every)),
        odometry_count=len(poses),
    )


def drive_tour(config: SyntheticLogConfig, duration_s: float) -> FloatArray:
    """True poses at the odometry rate, (N, 3) rows of x, y, yaw in the map frame, steered by pure pursuit."""
    step_s = 1.0 / (config.odometry_rate_hz * _CONTROL_STEPS)
    count = math.floor(duration_s * config.odometry_rate_hz + 1e-9) + 1
    path = _dense_tour(0.05)
    x, y, yaw = float(path[0, 0]), float(path[0, 1]), 0.0
    speed, turn, at = 0.0, 0.0, 0
    poses = np.empty((count, 3))
    for step in range((count - 1) * _CONTROL_STEPS + 1):
        if step % _CONTROL_STEPS == 0:
            poses[step // _CONTROL_STEPS] = x, y, yaw
        at = _advance(path, at, x, y, config.lookahead_m)
        goal_x, goal_y = path[at]
        bearing = math.remainder(math.atan2(goal_y - y, goal_x - x) - yaw, 2.0 * math.pi)
        # With a large heading error, the robot slows down to turn on the spot, so that it does not hit a
        # wall.
        wanted_speed = config.speed_m_s * max(0.0, 1.0 - abs(bearing) / 1.0)
        wanted_turn = float(np.clip(2.5 * bearing, -config.turn_rate_rad_s, config.turn_rate_rad_s))
        speed += limited(wanted_speed - speed, config.acceleration_m_s2 * step_s)
        turn += limited(wanted_turn - turn, config.turn_acceleration_rad_s2 * step_s)
        x += speed * step_s * math.cos(yaw + 0.5 * turn * step_s)
        y += speed * step_s * math.sin(yaw + 0.5 * turn * step_s)
        yaw = math.remainder(yaw + turn * step_s, 2.0 * math.pi)
    return poses


def _dense_tour(spacing_m: float) -> FloatArray:
    """The tour as closely spaced points, (N, 2), without the last one, which equals the first."""
    pieces = []
    for start, end in itertools.pairwise(TOUR_M):
        count = max(1, round(float(np.linalg.norm(end - start)) / spacing_m))
        pieces.append(start + (end - start) * (np.arange(count) / count)[:, None])
    return np.concatenate(pieces)


def _advance(path: FloatArray, at: int, x: float, y: float, lookahead_m: float) -> int:
    """Index of the next point of the closed tour at the lookahead distance."""
    while math.hypot(path[at, 0] - x, path[at, 1] - y) < lookahead_m:
        at = (at + 1) % len(path)
    return at


def wheel_odometry(config: SyntheticLogConfig, poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Simulate the wheel odometry of a drive, (N, 3) rows of x, y, yaw in the odom frame, from zero.

    Each wheel's true travel is scaled by its tyre, with noise proportional to the square root of the
    distance, and with excess while it slips.
    """
    step = np.diff(poses, axis=0)
    turned = np.arctan2(np.sin(step[:, 2]), np.cos(step[:, 2]))
    middle = poses[:-1, 2] + 0.5 * turned
    ahead = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    travel = np.column_stack([ahead, ahead]) + 0.5 * config.wheel_base_m * np.column_stack([-turned, turned])
    noise = config.wheel_sigma * np.sqrt(np.abs(travel)) * rng.standard_normal(travel.shape)
    scale = np.array([config.wheel_scale_left, config.wheel_scale_right])
    reported = travel * scale * (1.0 + config.slip_share * _slipping(config, len(travel), rng)) + noise
    reported_ahead = reported.mean(axis=1)
    reported_turn = (reported[:, 1] - reported[:, 0]) / config.wheel_base_m
    yaw = np.concatenate([[0.0], np.cumsum(reported_turn)])
    heading = yaw[:-1] + 0.5 * reported_turn
    odometry = np.zeros((len(poses), 3))
    odometry[1:, 0] = np.cumsum(reported_ahead * np.cos(heading))
    odometry[1:, 1] = np.cumsum(reported_ahead * np.sin(heading))
    odometry[:, 2] = np.arctan2(np.sin(yaw), np.cos(yaw))
    return odometry


def _slipping(config: SyntheticLogConfig, count: int, rng: np.random.Generator) -> FloatArray:
    """1 if a wheel slips, (count, 2) for left and right."""
    chance = config.slips_per_s / config.odometry_rate_hz
    length = max(1, round(config.slip_duration_s * config.odometry_rate_hz))
    begins = rng.random(count) < chance
    wheel = rng.integers(0, 2, count)
    slips = np.zeros((count, 2))
    for index in np.flatnonzero(begins):
        slips[index : index + length, wheel[index]] = 1.0
    return slips


def _log_lines(
    config: SyntheticLogConfig,
    stamps_s: FloatArray,
    poses: FloatArray,
    odometry: FloatArray,
    rng: np.random.Generator,
) -> Iterator[str]:
    """The lines of the CARMEN log."""
    yield "# CARMEN Logfile, synthetic"
    yield "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp"
    tail = f"{stamps_s[0]:.6f} synthetic 0.000000"
    yield f"PARAM robot_frontlaser_offset {config.laser_offset_m:.3f} {tail}"
    step_deg = math.degrees(config.fov_rad) / (config.beams - 1)
    yield f"PARAM laser_front_laser_resolution {step_deg:.6f} {tail}"
    yield f"PARAM laser_front_laser_fov {math.degrees(config.fov_rad):.6f} {tail}"
    yield f"PARAM robot_front_laser_max {config.range_max_m:.2f} {tail}"
    segments = walls()
    for index, (stamp_s, pose, wheels) in enumerate(zip(stamps_s, poses, odometry, strict=True)):
        tail = f"{stamp_s:.6f} synthetic {stamp_s - stamps_s[0]:.6f}"
        yield f"ODOM {_row_text(wheels)} 0 0 0 {tail}"
        if index % config.scan_every == 0:
            ranges = simulate_scan(config, segments, pose, rng)
            readings = " ".join(f"{reading:.3f}" for reading in ranges)
            laser = _row_text(_laser_pose(config, wheels))
            yield f"FLASER {config.beams} {readings} {laser} {_row_text(wheels)} {tail}"


def simulate_scan(
    config: SyntheticLogConfig, segments: FloatArray, pose: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Simulate a scan from a robot pose (x, y, yaw) in the map, (beams,) metres; no return is the maximum."""
    laser = _laser_pose(config, pose)
    bearings = laser[2] + np.linspace(-0.5 * config.fov_rad, 0.5 * config.fov_rad, config.beams)
    ranges = cast_rays(segments, laser[:2], bearings)
    ranges += config.range_sigma_m * rng.standard_normal(config.beams)
    lost = rng.random(config.beams) < config.dropout_share
    return np.where(lost | (ranges >= config.range_max_m), config.range_max_m, np.maximum(ranges, 0.001))


def _laser_pose(config: SyntheticLogConfig, robot: FloatArray) -> FloatArray:
    """x, y, yaw of the laser for a pose of the robot."""
    ahead = config.laser_offset_m * np.array([math.cos(robot[2]), math.sin(robot[2]), 0.0])
    return np.asarray(robot + ahead)


def _row_text(row: FloatArray) -> str:
    """x, y, yaw as CARMEN writes them."""
    return f"{row[0]:.6f} {row[1]:.6f} {row[2]:.6f}"
