"""A room with pillars seen by a lidar of 16 rings, by ray casting on boxes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gtsam
import numpy as np
import yaml

from slam.config import Config
from slam.config.clouds import CloudOdometryConfig
from slam.estimates import MotionEstimate
from slam.matching.cloud_points import base_points
from slam.measurements import FloatArray, PointCloud

T_BASE_LIDAR = gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.7]))
# x, y and z from and to: the room's inside is the first, what stands in it the others.
ROOM = np.array([[-5.0, 6.0], [-4.0, 4.0], [0.0, 2.6]])
PILLARS = np.array(
    [
        [[1.0, 1.4], [1.6, 2.0], [0.0, 2.6]],
        [[-2.5, -2.0], [-2.4, -1.6], [0.0, 2.6]],
        [[3.5, 4.3], [-3.0, -2.6], [0.0, 1.2]],
        [[-4.2, -3.6], [2.0, 3.2], [0.0, 0.9]],
    ]
)
ELEVATIONS = np.radians(np.arange(-15.0, 16.0, 2.0))

# A wall with a door between the left room and the right one.
ROOMS = np.concatenate(
    [PILLARS, [[[0.4, 0.6], [-4.0, -0.2], [0.0, 2.6]], [[0.4, 0.6], [1.2, 4.0], [0.0, 2.6]]]]
)
WAY = [(-3.6, -0.8), (-2.6, 1.2), (-0.8, 0.5), (0.5, 0.5), (2.4, 0.3), (4.6, 0.8), (4.8, 2.6), (3.0, 3.0)]
# As the map, a little beside it.
OTHER = [(-3.2, -0.6), (-2.3, 0.9), (-0.8, 0.6), (0.5, 0.6), (2.2, 0.5), (4.3, 0.9), (4.6, 2.4), (3.2, 2.8)]

SMALL = (
    "cloud_loops.least_path_voxels=20",
    "cloud_loops.reach_voxels=3",
    "cloud_odometry.voxel_m=0.25",
    "match.local_map_keyframes=6",
)


def cast(origin: FloatArray, directions: FloatArray, boxes: FloatArray = PILLARS) -> FloatArray:
    """(N,) distance from a place in the room to what each ray (N, 3) meets first."""
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.max((ROOM[None] - origin[None, :, None]) / directions[:, :, None], axis=2)
        hit = np.nanmin(np.where(walls > 0.0, walls, np.inf), axis=1)
        for box in boxes:
            ways = np.sort((box[None] - origin[None, :, None]) / directions[:, :, None], axis=2)
            into, out = np.nanmax(ways[:, :, 0], axis=1), np.nanmin(ways[:, :, 1], axis=1)
            hit = np.where((into < out) & (into > 0.0), np.minimum(hit, into), hit)
    return hit


def rays(elevations: FloatArray = ELEVATIONS, azimuths: int = 360) -> FloatArray:
    """(N, 3) unit vectors, firing by firing."""
    bearing = np.linspace(0.0, 2.0 * np.pi, azimuths, endpoint=False)
    across, up = np.meshgrid(bearing, elevations, indexing="ij")
    return np.stack([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)], -1).reshape(-1, 3)


def look(
    T_map_base: gtsam.Pose3,
    stamp_s: float = 0.0,
    *,
    seed: int = 0,
    sigma_m: float = 0.01,
    elevations: FloatArray = ELEVATIONS,
    boxes: FloatArray = PILLARS,
) -> PointCloud:
    """One turn of the lidar, all points at one instant."""
    rng = np.random.default_rng(seed)
    T_map_lidar = T_map_base.compose(T_BASE_LIDAR)
    directions = rays(elevations)
    ranges = cast(T_map_lidar.translation(), directions @ T_map_lidar.rotation().matrix().T, boxes)
    ranges = ranges + sigma_m * rng.standard_normal(len(ranges))
    points = (directions * ranges[:, None]).astype(np.float32)
    return PointCloud(stamp_s, points, None, T_BASE_LIDAR)


def look_on_the_way(
    T_map_base: gtsam.Pose3, twist: FloatArray, stamp_s: float, *, seed: int = 0, turn_s: float = 0.1
) -> PointCloud:
    """One turn of the lidar on a robot that moves by ``twist`` (6,), stamped at its beginning."""
    rng = np.random.default_rng(seed)
    slices = np.array_split(rays().reshape(-1, len(ELEVATIONS), 3), 60)
    points, times_s = [], []
    for n, directions in enumerate(slices):
        at_s = turn_s * n / len(slices)
        T_map_lidar = T_map_base.compose(gtsam.Pose3.Expmap(twist * at_s)).compose(T_BASE_LIDAR)
        fan = directions.reshape(-1, 3)
        ranges = cast(T_map_lidar.translation(), fan @ T_map_lidar.rotation().matrix().T)
        points.append(fan * (ranges + 0.01 * rng.standard_normal(len(ranges)))[:, None])
        times_s.append(np.full(len(fan), at_s))
    return PointCloud(stamp_s, np.vstack(points).astype(np.float32), np.concatenate(times_s), T_BASE_LIDAR)


def base(x: float, y: float, yaw: float) -> gtsam.Pose3:
    """A robot on the floor."""
    return gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.array([x, y, 0.0]))


def way_round(count: int) -> list[gtsam.Pose3]:
    """Once about the middle of the room, and back to where it began, looking ahead."""
    turns = np.linspace(0.0, 2.0 * np.pi, count)
    return [base(1.6 * np.cos(a), 0.4 + 1.4 * np.sin(a), a + 0.5 * np.pi) for a in turns]


def drive(corners: Sequence[tuple[float, float]], step_m: float = 0.25) -> list[gtsam.Pose3]:
    """Poses along a way that turns gently."""
    ends = np.array(corners)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ends, axis=0).T))])
    stops = np.arange(0.0, along[-1], step_m)
    x, y = (np.interp(stops, along, column) for column in ends.T)
    return [base(a, b, 0.5 * np.sin(0.6 * way)) for a, b, way in zip(x, y, stops, strict=True)]


def seen(poses: Sequence[gtsam.Pose3], seed: int) -> list[PointCloud]:
    """A cloud at every pose, ten a second."""
    return [look(pose, 0.1 * n, seed=seed + n, boxes=ROOMS) for n, pose in enumerate(poses)]


def write_log(folder: Path, clouds: Sequence[PointCloud], poses: Sequence[gtsam.Pose3] = ()) -> Path:
    """A folder of clouds with its list of stamps, its mounting and the truth."""
    (folder / "points").mkdir(parents=True)
    mounting = {"translation_m": T_BASE_LIDAR.translation().tolist(), "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
    (folder / "points" / "calibration.yaml").write_text(yaml.safe_dump({"T_base_lidar": mounting}))
    for number, cloud in enumerate(clouds):
        bright = np.zeros(len(cloud.points_lidar)) if cloud.intensities is None else cloud.intensities
        rows = np.column_stack([cloud.points_lidar, bright]).astype("<f4")
        (folder / "points" / f"{number:06d}.bin").write_bytes(rows.tobytes())
    (folder / "times.txt").write_text("".join(f"{cloud.stamp_s:.6f}\n" for cloud in clouds))
    lines = []
    for cloud, pose in zip(clouds, poses, strict=False):
        q = pose.rotation().toQuaternion()
        lines.append(" ".join(map(str, [cloud.stamp_s, *pose.translation(), q.x(), q.y(), q.z(), q.w()])))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    return folder


# Voxels as small as the room asks.
CONFIG = Config(cloud_odometry=CloudOdometryConfig(voxel_m=0.2))


def points_at(pose: gtsam.Pose3, seed: int = 0, **kwargs: object) -> FloatArray:
    """What a lidar that stands still sees there, base frame."""
    return base_points(look(pose, seed=seed, **kwargs), np.zeros(6), CONFIG.cloud_odometry)  # type: ignore[arg-type]


def error_of(motion: MotionEstimate | None, truth: gtsam.Pose3) -> FloatArray:
    """(6,) of a motion in space."""
    assert motion is not None
    assert isinstance(motion.T_reference_base, gtsam.Pose3)
    return np.asarray(gtsam.Pose3.Logmap(truth.between(motion.T_reference_base)))
