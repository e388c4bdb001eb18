"""Tiny runs of every kind, in which each setting has something to decide, and what they come to."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, TypeVar

import gtsam
import numpy as np
import pytest
from cloud_world import look, look_on_the_way, way_round
from flat_worlds import box, room, sweep
from imu_world import readings, stands
from room_world import SMALL, T_BODY_CAMERA, furnished, render, turning_walk

from slam.app.mapping import Measured, run_log
from slam.config import Config, load_config
from slam.errors import ScanweaveError
from slam.localization.localizer import Localizer
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.mapping.cloud_map import CloudTiles
from slam.matching.planar import compose
from slam.measurements import LaserScan, Measurement, RgbdFrame, WheelOdometry, pose2_from_row
from slam.outputs import exports
from slam.storage.map_contents import MapContents
from slam.storage.packing import pack

T = TypeVar("T")


class Differs(Exception):
    """A run has come to another answer than the one that it is compared with."""


class Course(Checkpoint):
    """Everything that a run comes to, as digests; beside another's it stops at the first that differs."""

    def __init__(self, other: Course | None = None) -> None:
        super().__init__()
        self.digests: list[bytes] = []
        self._other = other

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        answer = compute()
        self.note(question, float(key), answer)
        return answer

    def note(self, *what: Any) -> None:
        """One more thing."""
        self.digests.append(hashlib.blake2b(pack(list(what)), digest_size=8).digest())
        if self._other is not None:
            before = self._other.digests[: len(self.digests)]
            if before[-1] != self.digests[-1] or len(before) < len(self.digests):
                raise Differs


Run = Callable[[Config, Course], None]


def differs(run: Run, config: Config, baseline: Course) -> bool:
    """Whether a run comes to something else than another has."""
    course = Course(baseline)
    try:
        run(config, course)
    except Differs:
        return True
    except ScanweaveError:  # a setting that leaves nothing to map
        return True
    return len(course.digests) != len(baseline.digests)


def mapped(log: Measured, config: Config, course: Course) -> MapResult:
    """A log, mapped, and everything that came of it noted."""
    result = build_map(log, config, checkpoint=course)
    course.note(result.map.trajectory)
    for factor in result.map.factors:
        edge, kept = factor.edge, factor.kept
        course.note(edge.kind.value, edge.T_source_target, edge.covariance, bool(kept), bool(edge.trusted))
    for loop in result.map.loops:
        course.note(loop)
    course.note(*result.warnings, *result.notes)
    course.note(*[sweep.ranges_m for sweep in result.map.keyframe_scans if sweep is not None])
    course.note("" if result.fused is None else result.fused.note)
    layers = result.map.layers(config)
    if layers is not None:
        course.note(layers.states("decision"), layers.T_map_grid, layers.resolution_m)
        course.note(*[grid.steps for grid in (layers.lidar, layers.depth) if grid is not None])
    return result


_ROUND_WALLS = np.concatenate(
    [
        box(-3, -2.5, 3.5, 2.5),
        box(1.9, 1.2, 3.5, 2.5),
        box(-1.0, -0.6, 0.4, 0.4),
        box(-3, -2.5, -2.2, -1.4),
    ]
)


@cache
def planar_log() -> Measured:
    """Once round the block in a room and on: the lidar is blind, wheels slip and jump, somebody pushes."""
    rng, found, wheels = np.random.default_rng(3), list[Measurement](), np.array([5.0, 1.0, -2.0])

    def on_the_round(angle: float) -> np.ndarray[Any, Any]:
        return np.array([-0.3 + 2.0 * math.cos(angle), 1.45 * math.sin(angle), 0.0])

    last = None
    for n in range(92):
        pose, ahead = (on_the_round(2.0 * math.pi * n / 76.0 + phase) for phase in (2.4, 2.5))
        pose[2] = math.atan2(*(ahead - pose)[1::-1])
        if n >= 72:
            pose = compose(pose, np.array([-0.25, 0.15, 0.45]))  # pushed while its wheels stood still
        if last is not None:
            step = gtsam.Pose2() if n == 72 else gtsam.Pose2(*last).between(gtsam.Pose2(*pose))
            slip = np.array([step.x() * 1.02, step.y(), step.theta() * 1.01])
            slip *= [1.4 if 30 <= n < 36 else 1.0, 1.0, 1.25 if 50 <= n < 54 else 1.0]
            slip += [4.0 if n == 20 else 0.0, 0.0, 2.5 if n == 24 else 0.0]
            wheels = compose(wheels, slip)
        last, stamp_s = pose, 100.0 + 0.2 * n
        seen = sweep(_ROUND_WALLS, pose, beams=121, fov_rad=4.7, sigma_m=0.01, seed=rng, stamp_s=stamp_s)
        lost = (rng.random(seen.ranges_m.size) < 0.05) | (60 <= n < 64)
        ranges_m = np.where(lost, np.float32(np.inf), seen.ranges_m)
        ranges_m[rng.random(ranges_m.size) < 0.04] *= np.float32(0.7)
        ranges_m[:2] = 0.05
        found += [WheelOdometry(stamp_s, pose2_from_row(wheels)), replace(seen, ranges_m=ranges_m)]
    return Measured(found)


def planar(config: Config, course: Course) -> None:
    """A lidar on wheels."""
    mapped(planar_log(), config, course)


_MOUNT = gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([0.1, 0.0, 1.1])) * T_BODY_CAMERA
_FURNISHED_WALLS = np.concatenate(
    [box(-2.5, -2.0, 2.5, 2.0), box(1.6, 0.4, 2.5, 1.5), box(-2.5, -2.0, -1.7, -1.1)]
)


@cache
def fused_log() -> Measured:
    """Wheels, scans and a camera on a floor that is not quite even; the lidar is silent for a while."""
    rng, found = np.random.default_rng(0), list[Measurement]()
    pose, wheels = np.array([0.3, -0.7, 0.2]), np.array([5.0, 1.0, -2.0])
    for n in range(28):
        stamp_s = 100.0 + 0.1 * n
        nod = gtsam.Rot3.Ypr(pose[2], 0.02 * math.sin(2.0 * n), 0.0)
        body = gtsam.Pose3(nod, np.array([pose[0], pose[1], 0.0]))
        frame = render(
            furnished(), body * _MOUNT, SMALL, stamp_s - 0.01, noise=(0.001, 0.0012), seed=n, smooth=False,
            T_base_camera=_MOUNT,
        )  # fmt: skip
        found += [frame, WheelOdometry(stamp_s, pose2_from_row(wheels))]
        if not 12 <= n < 20:
            seen = sweep(_FURNISHED_WALLS, pose, beams=181, fov_rad=math.pi, sigma_m=0.01, seed=rng)
            found.append(replace(seen, stamp_s=stamp_s))
        pose = compose(pose, np.array([0.05, 0.0, 0.09]))
        wheels = compose(wheels, np.array([0.052, 0.0, 0.093]))
    return Measured(found)


def fused(config: Config, course: Course) -> None:
    """A lidar and a camera on wheels."""
    mapped(fused_log(), config, course)


@cache
def spatial_log() -> Measured:
    """A camera in the hand goes round in a room; it is swung once, and a board covers it for a moment."""
    walk = turning_walk(70, turns=1.25)
    poses = [walk[n] for n in [*range(0, 44, 2), *range(47, 69, 2)]]
    frames = [
        render(furnished(), pose, SMALL, n / 10.0, noise=(0.001, 0.0012), seed=n, smooth=False)
        for n, pose in enumerate(poses)
    ]
    board = {"color": np.zeros_like(frames[0].color), "depth_m": np.full_like(frames[0].depth_m, 0.5)}
    return Measured([replace(frame, **board) if n in (24, 25) else frame for n, frame in enumerate(frames)])


def spatial(config: Config, course: Course) -> None:
    """A camera in the hand."""
    mapped(spatial_log(), config, course)


@cache
def cloud_log() -> Measured:
    """A 3D lidar goes once round in a room with pillars, on wheels that are a little off; it grows noisy.

    Because it pauses, the first map does not contain all of the drive.
    """
    found, poses, rng = list[Measurement](), way_round(22), np.random.default_rng(0)
    for n, pose in enumerate(poses):
        twist = gtsam.Pose3.Logmap(pose.between(poses[min(n + 1, len(poses) - 1)])) / 0.1
        stamp_s = 0.1 * n + 1.5 * (n > 1)
        seen = look_on_the_way(pose, twist, stamp_s, seed=n)
        points, times_s = seen.points_lidar[::6], seen.times_s
        assert times_s is not None
        sigma_m = 0.02 if n > 18 else 0.0
        points = (points + sigma_m * rng.standard_normal(points.shape)).astype(np.float32)
        odom = gtsam.Pose2(1.03 * pose.x(), 0.98 * pose.y(), pose.rotation().yaw())
        found += [WheelOdometry(stamp_s, odom), replace(seen, points_lidar=points, times_s=times_s[::6])]
    return Measured(found)


def clouds(config: Config, course: Course) -> None:
    """A 3D lidar on wheels, until it is back where it began."""
    mapped(cloud_log(), config, course)


def first_clouds(config: Config, course: Course) -> None:
    """The beginning of it, and the cloud of the map."""
    result = mapped(Measured(list(cloud_log())[:16]), config, course)
    assert result.map.clouds is not None
    seen = result.map.clouds, result.map.node_poses, config.grid.resolution_m
    with TemporaryFile() as file:
        for cloud in CloudTiles(*seen, file).cloud():  # type: ignore[arg-type]
            course.note(cloud.points_map)


@cache
def imu_log() -> Measured:
    """A 3D lidar that stands on a slope, and its IMU."""
    felt, found = list(readings(stands, 2.0)), list[Measurement]()
    for n in range(18):
        found += felt[20 * n : 20 * n + 40 if n == 17 else 20 * n + 20]
        found.append(look(stands(0.0), 0.1 * n + 0.05, seed=n))
    return Measured(found)


def with_imu(config: Config, course: Course) -> None:
    """A slope that only an IMU knows of."""
    mapped(imu_log(), config, course)


@cache
def _result(run: Callable[[], Measured], *settings: str) -> MapResult:
    """The map that files are written of, or in which a robot is found."""
    return build_map(run(), load_config(None, settings))


def files(config: Config, course: Course) -> None:
    """What is written of a camera's keyframes and of a 3D lidar's; of the surface what it is asked for."""

    class Asked(Exception):
        pass

    def asked(_frames: object, _poses: object, settings: Any) -> None:
        course.note(settings.voxel_size_m, settings.depth_min_m, settings.depth_max_m)
        raise Asked

    cameras, lidar = _result(spatial_log, *BASES["spatial"]), _result(cloud_log, *BASES["clouds"])
    assert cameras.map.frames is not None
    with TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        patch.setattr(exports, "fuse_keyframes", asked)
        folder = Path(name)
        with suppress(Asked):
            exports.Exports(cameras.map, config).write_surfaces(folder)
        written = exports.Exports(lidar.map, config).write_surfaces(folder)
        course.note(*[path.name for path in written], *[path.read_bytes() for path in written])


def localized(
    known: MapContents, measurements: Sequence[Measurement], config: Config, course: Course
) -> None:
    """A drive in a known map; every word of the localiser noted."""
    localizer = Localizer(known, config)
    for measurement in measurements:
        output = localizer.add(measurement)
        if output is not None:
            reported = [output.state.value, output.confidence, output.support, output.pose, output.covariance]
            course.note(*reported, *[past.pose for past in output.recovered])


def _with_ranges(part: Sequence[Measurement], ranges_m: Any) -> list[Measurement]:
    """A part of a log in which the lidar sees something else."""
    return [
        replace(seen, ranges_m=np.full_like(seen.ranges_m, ranges_m)) if isinstance(seen, LaserScan) else seen
        for seen in part
    ]


def in_plan(config: Config, course: Course) -> None:
    """A lidar in another room, in its own, blind while its wheels slip, in the other again, and back."""
    known = _result(planar_log, *BASES["planar"]).map
    log = list(planar_log())
    other = sweep(room(), [0.3, 0.2, 0.3], beams=121, fov_rad=4.7).ranges_m
    elsewhere, blind_there = _with_ranges(log[96:120], other), _with_ranges(log[60:66], np.inf)
    localized(known, [*log[4:60], *blind_there, *log[66:96], *elsewhere, *log[120:170]], config, course)


def in_room(config: Config, course: Course) -> None:
    """A 3D lidar in its room, carried off once."""
    known = _result(cloud_log, *BASES["clouds"]).map
    log = list(cloud_log())
    localized(known, [*log[24:44], *log[2:24]], config, course)


def frames_alone(config: Config, course: Course) -> None:
    """A camera in the map of a camera."""
    known = _result(spatial_log, *BASES["spatial"]).map
    localized(known, [one for one in spatial_log() if isinstance(one, RgbdFrame)], config, course)


def from_a_file(config: Config, course: Course) -> None:
    """A log that is opened by its path."""
    with TemporaryDirectory() as name:
        path = Path(name) / "scans.log"
        path.write_text("FLASER 4 1 1 1 1 0 0 0 0 0 0 1 host 1\n")
        saved = run_log(path, config, out=path.with_name("map")).map
        course.note(saved.keyframe_poses)
        saved.close()


_CAMERA = ("rgbd.registration=given", "rgbd.features=300", "rgbd.points=1500")
# What makes each run short, and gives its settings something to decide.
BASES: dict[str, tuple[str, ...]] = {
    "planar": (
        "loops.least_path_m=4",
        "loops.every_m=0.4",
        "keyframes.distance_m=0.15",
        "loops.half_keyframes=4",
    ),
    "fused": (*_CAMERA, "fusion.least_pairs=3", "keyframes.distance_m=0.1"),
    "spatial": (*_CAMERA, "rgbd_odometry.least_inliers=8", "match.lost_after=3"),
    "clouds": (
        "cloud_loops.least_path_voxels=12",
        "cloud_loops.reach_voxels=3",
        "cloud_odometry.voxel_m=0.25",
        "match.local_map_keyframes=6",
    ),
    "first_clouds": ("cloud_odometry.voxel_m=0.25", "match.local_map_keyframes=4"),
    "in_plan": ("localization.keyframe_m=0.1",),
    "in_room": ("cloud_odometry.voxel_m=0.25", "localization.confident_probability=0.8"),
    "frames_alone": (*_CAMERA, "rgbd_odometry.least_inliers=8"),
}
RUNS: dict[str, Run] = {
    run.__name__: run
    for run in (
        planar,
        fused,
        spatial,
        clouds,
        first_clouds,
        with_imu,
        in_plan,
        in_room,
        frames_alone,
        from_a_file,
        files,
    )
}
