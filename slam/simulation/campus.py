"""Records a long drive through a campus: a CARMEN log, the ground truth, relations of revisited places."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy import spatial

from slam.estimates import Trajectory
from slam.measurements import FloatArray, WheelOdometry, pose2_from_row
from slam.simulation.campus_drive import IntArray, drive_route, plan_route, scan_steps, travelled_m
from slam.simulation.campus_lidar import CampusLidar
from slam.simulation.campus_plan import Campus, generate_campus
from slam.simulation.campus_wheels import RATE_HZ, CampusFaults, CampusWheels, GrossError, campus_wheels
from slam.simulation.carmen_writer import CarmenWriter
from slam.simulation.drive import FIRST_STAMP_S
from slam.simulation.record import Progress, appearing_whole
from slam.simulation.sensor_clock import generator
from slam.simulation.steering import STEP_S
from slam.storage.files import write_lines
from slam.storage.tum import write_tum

_SHORTEST_M, _LONGEST_M = 1800.0, 2900.0  # of the planned path; a drive is some metres longer
_STEPS_A_READING = round(1.0 / (RATE_HZ * STEP_S))
_NEAR_M, _WAY_BETWEEN_M = 2.0, 30.0  # distance of two scans at one place, and path length between visits


@dataclass(frozen=True, slots=True)
class CampusDrive:
    """Summary of a recording.

    Attributes
    ----------
    corridor_m
        Length of all corridors.
    path_m, duration_s
        Length of the drive.
    scans, readings
        Number of lidar and wheel readings.
    lag_s
        Delay of the lidar's stamps.
    gaps_s
        Gaps of the lidar of 5 s and more.
    gross_errors
        Gross errors of the wheels.
    """

    corridor_m: float
    path_m: float
    duration_s: float
    scans: int
    readings: int
    lag_s: float
    gaps_s: tuple[float, ...]
    gross_errors: tuple[GrossError, ...]

    @property
    def text(self) -> str:
        """Return the summary as one line."""
        return (
            f"{self.duration_s:.0f} s, {self.path_m:.1f} m through {self.corridor_m:.0f} m of corridors: "
            f"{self.readings} odometry, {self.scans} lidar, {len(self.gaps_s)} gaps, "
            f"{len(self.gross_errors)} gross errors of the wheels"
        )


def record_campus(
    home: int,
    seed: int,
    out_dir: Path,
    faults: CampusFaults,
    duration_s: float | None = None,
    progress: Progress | None = None,
) -> CampusDrive:
    """Drive through the campus of seed ``home`` and write the log with its ground truth.

    Parameters
    ----------
    out_dir
        Created atomically at the end; must not exist yet, or be empty. It contains ``scans.log`` (CARMEN);
        ``groundtruth.txt`` (TUM) and ``campus.relations`` (R. Kuemmerle's form), both of the base at the time
        of each scan, with the scan's stamp; ``truth/plan.txt`` and ``truth/faults.json``.
    duration_s
        End the drive there; the plan is unchanged, so it equals the start of the full drive.
    progress
        Called at each scan with the seconds done and their total.

    Raises
    ------
    DatasetError
        ``out_dir`` is not empty, or cannot be written.
    """
    campus = generate_campus(home)
    rng = generator(seed, "campus", home)
    length_m = float(np.clip(rng.uniform(1.5, 2.0) * campus.corridor_m, _SHORTEST_M, _LONGEST_M))
    poses = drive_route(campus, plan_route(campus, rng, length_m), rng)
    lidar = CampusLidar(campus, poses, faults.encounters_per_m, generator(seed, "campus lidar", home))
    wheels = campus_wheels(faults, poses[::_STEPS_A_READING], generator(seed, "campus wheels", home))
    clock = generator(seed, "campus clock", home)
    lag_s = round(faults.largest_lag_s * clock.uniform(1.0 / 3.0, 1.0), 3)
    steps = scan_steps(poses, faults.gaps, clock)
    end_s = min(duration_s or np.inf, (len(poses) - 1) * STEP_S)
    steps = steps[steps * STEP_S + lag_s <= end_s]
    readings = np.flatnonzero(wheels.is_logged & (np.arange(len(wheels.is_logged)) <= end_s * RATE_HZ))
    stamps_s = np.round(FIRST_STAMP_S + lag_s + steps * STEP_S, 6)
    apart_s = np.diff(stamps_s)
    drive = CampusDrive(
        corridor_m=campus.corridor_m,
        path_m=float(travelled_m(poses)[int(end_s / STEP_S)]),
        duration_s=end_s,
        scans=len(steps),
        readings=len(readings),
        lag_s=lag_s,
        gaps_s=tuple(apart_s[apart_s >= 5.0].tolist()),
        gross_errors=tuple(error for error in wheels.errors if error.first <= end_s * RATE_HZ),
    )
    with appearing_whole(out_dir) as folder:
        _write_log(folder / "scans.log", lidar, wheels, readings, steps, lag_s, progress)
        write_tum(folder / "groundtruth.txt", Trajectory.from_planar(stamps_s, poses[steps]))
        relations = relation_lines(stamps_s, poses[steps], generator(seed, "campus relations", home))
        write_lines(folder / "campus.relations", relations)
        (folder / "truth").mkdir()
        write_lines(folder / "truth" / "plan.txt", _plan_lines(campus))
        write_lines(folder / "truth" / "faults.json", [json.dumps(asdict(drive), indent=1)])
    return drive


def _write_log(
    path: Path,
    lidar: CampusLidar,
    wheels: CampusWheels,
    readings: IntArray,
    steps: IntArray,
    lag_s: float,
    progress: Progress | None,
) -> None:
    """Write readings and scans sorted by stamp; for equal stamps the reading first."""
    times_s = np.concatenate([readings / RATE_HZ, steps * STEP_S + lag_s])
    with CarmenWriter(path, FIRST_STAMP_S) as log:
        for place in np.argsort(times_s, kind="stable").tolist():
            time_s = float(times_s[place])
            stamp_s = round(FIRST_STAMP_S + time_s, 6)
            if place < len(readings):
                before = wheels.onward_xyt[max(int(readings[place]) - 1, 0)] * RATE_HZ
                reading = WheelOdometry(stamp_s, pose2_from_row(wheels.poses_xyt[readings[place]]))
                log.odometry(reading, (float(before[0]), float(before[2])), stamp_s)
            else:
                scan = lidar.scan(int(steps[place - len(readings)]), stamp_s)
                log.scan(scan, wheels.at(time_s), FIRST_STAMP_S + time_s - lag_s)
                if progress is not None:
                    progress(time_s, float(times_s.max()))


def relation_lines(stamps_s: FloatArray, poses_xyt: FloatArray, rng: np.random.Generator) -> Iterator[str]:
    """Return lines ``t1 t2 x y z roll pitch yaw``: to each scan from the previous one and from an earlier
    visit.

    Parameters
    ----------
    stamps_s, poses_xyt
        (N,) stamps and (N, 3) poses of the scans.
    rng
        Chooses one of several earlier scans.
    """
    driven_m, places = travelled_m(poses_xyt), spatial.cKDTree(poses_xyt[:, :2])
    poses = [pose2_from_row(row) for row in poses_xyt]
    for index, pose in enumerate(poses):
        neighbours = np.sort(places.query_ball_point(poses_xyt[index, :2], _NEAR_M))
        before = neighbours[driven_m[neighbours] < driven_m[index] - _WAY_BETWEEN_M]
        others = [rng.choice(before)] if len(before) else []
        for other in [*range(max(index - 1, 0), index), *others]:
            moved = poses[other].between(pose)
            planar = f"{moved.x():.9f} {moved.y():.9f} 0 0 0 {moved.theta():.9f}"
            yield f"{stamps_s[other]:.6f} {stamps_s[index]:.6f} {planar}"


def _plan_lines(campus: Campus) -> Iterator[str]:
    """Return lines ``wall`` or ``glass`` with the ends x1 y1 x2 y2."""
    for kind, segments in (("wall", campus.walls_m), ("glass", campus.glass_m)):
        yield from (f"{kind} {' '.join(f'{value:.4f}' for value in row)}" for row in segments)
