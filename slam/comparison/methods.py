"""Compared methods from log to trajectory: Scanweave, Scanweave with other odometries, and others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace

import gtsam
import numpy as np

from slam.app.mapping import map_log
from slam.comparison.dense_odometry import DenseOdometry
from slam.comparison.kiss_odometry import KissOdometry
from slam.comparison.open3d_library import load_open3d
from slam.comparison.product import AcceptedLoop, Product
from slam.config import Config
from slam.datasets import Dataset
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.pipeline import build_map
from slam.mapping.occupancy_grid import StateGrid
from slam.measurements import (
    FloatArray,
    LaserScan,
    PointCloud,
    RgbdFrame,
    WheelOdometry,
    row_from_pose,
    row_from_pose2,
)
from slam.odometry import Odometries
from slam.storage.map_contents import MapContents

_FARTHEST_DEPTH_M = 4.0


def scanweave(dataset: Dataset, config: Config) -> Product:
    """Run Scanweave, with the navigation map if there are cameras."""
    with closing(map_log(dataset, config)) as made:
        layers = made.layers
        decision = layers.decision() if layers is not None and layers.names else None
        return replace(_product(made.contents, made.planar, made.warnings), decision=decision)


def by_odometry(dataset: Dataset, config: Config, odometries: Odometries) -> Product:
    """Scanweave's mapper with the odometry of another system, to compare odometries."""
    result = build_map(dataset, config, odometries=odometries)
    return _product(result.map, result.map.grid is not None, result.warnings)


def _product(made: MapContents, on_floor: bool, warnings: Sequence[str]) -> Product:
    """What is measured of a map; loops only of a robot on a floor."""
    grid = made.grid
    return Product(
        trajectory=made.trajectory,
        plane=None if grid is None else StateGrid(grid.states(), grid.resolution_m, grid.T_map_grid),
        loops=_accepted(made.loops, made.stamps_s) if on_floor else None,
        keyframe_stamps_s=made.stamps_s,
        loops_tried=len(made.loops),
        warnings=tuple(warnings),
    )


def wheels(dataset: Dataset) -> Product:
    """Recorded wheel odometry alone."""
    readings = [reading for reading in dataset if isinstance(reading, WheelOdometry)]
    if not readings:
        raise DatasetError(f"{dataset.name} holds no wheel odometry; leave 'wheels' out of its baselines")
    poses = np.array([row_from_pose2(reading.T_odom_base) for reading in readings])
    return Product(Trajectory.from_planar(np.array([reading.stamp_s for reading in readings]), poses))


def kiss_icp(dataset: Dataset) -> Product:
    """Unmodified KISS-ICP with its defaults on each cloud of a 3D lidar, or else on the points of each scan.

    No deskewing, because it aborts the process for points without timestamps.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    settings = KISSConfig()
    settings.data.deskew = False
    settings.registration.max_num_threads = 1
    # KISS-ICP's own rule if no voxel size is given.
    settings.mapping.voxel_size = settings.data.max_range / 100.0
    odometry = KissICP(settings)
    stamps, poses = [], []
    kind = PointCloud if any(isinstance(reading, PointCloud) for reading in dataset) else LaserScan
    for reading in dataset:
        if not isinstance(reading, kind):
            continue
        mount, points = _cloud(reading)
        if not len(points):
            continue  # KISS-ICP treats an empty cloud as a motion
        odometry.register_frame(points, np.zeros(len(points)))
        poses.append(mount.compose(gtsam.Pose3(odometry.last_pose)).compose(mount.inverse()))
        stamps.append(reading.stamp_s)
    if not stamps:
        raise DatasetError(f"{dataset.name} holds no scan or cloud; leave 'kiss_icp' out of its baselines")
    return Product(_trajectory(stamps, poses))


def open3d(dataset: Dataset) -> Product:
    """Open3D's multi-scale RGB-D odometry (hybrid), frame to frame from identity, on the first camera.

    A step that fails is taken as no motion.
    """
    o3d = load_open3d()
    odometry = o3d.t.pipelines.odometry
    before, camera, first = None, None, ""
    pose, failed = np.eye(4), 0
    stamps, poses = [], []
    for frame in dataset:
        if not isinstance(frame, RgbdFrame) or frame.sensor != (first := first or frame.sensor):
            continue
        if camera is None:
            k = frame.intrinsics
            matrix = np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])
            camera = o3d.core.Tensor.from_numpy(matrix)
        pictures = (np.ascontiguousarray(frame.color), np.ascontiguousarray(frame.depth_m))
        image = o3d.t.geometry.RGBDImage(*(o3d.t.geometry.Image(picture) for picture in pictures))
        if before is not None:
            try:
                odometry_result = odometry.rgbd_odometry_multi_scale(
                    image,
                    before,
                    camera,
                    depth_scale=1.0,
                    depth_max=_FARTHEST_DEPTH_M,
                    method=odometry.Method.Hybrid,
                )
                step = odometry_result.transformation.numpy()
            except RuntimeError:
                step = np.full((4, 4), np.nan)
            failed += not np.isfinite(step).all()
            pose = pose @ step if np.isfinite(step).all() else pose
        before = image
        mount = gtsam.Pose3() if frame.T_base_camera is None else frame.T_base_camera
        poses.append(mount.compose(gtsam.Pose3(pose)).compose(mount.inverse()))
        stamps.append(frame.stamp_s)
    if not stamps:
        raise DatasetError(f"{dataset.name} holds no image; leave 'open3d' out of its baselines")
    warnings = (f"{failed} of {len(stamps) - 1} steps failed",) if failed else ()
    return Product(_trajectory(stamps, poses), warnings=warnings)


# Odometries of other systems for Scanweave's mapper, by their name in a run.
ODOMETRIES = {"kiss_matching": Odometries(lidar=KissOdometry), "dense": Odometries(rgbd=DenseOdometry)}
# Methods without configuration, by their name in a run; and those of them that use no images.
STOCK: dict[str, Callable[[Dataset], Product]] = {"wheels": wheels, "kiss_icp": kiss_icp, "open3d": open3d}
WITHOUT_IMAGES = frozenset({"wheels", "kiss_icp"})


def _cloud(reading: LaserScan | PointCloud) -> tuple[gtsam.Pose3, FloatArray]:
    """A lidar's pose, and (N, 3) points in its frame; those of a scan have z = 0."""
    if isinstance(reading, PointCloud):
        return reading.T_base_lidar, reading.points_lidar.astype(np.float64)
    points = reading.points_laser()
    return gtsam.Pose3(reading.T_base_laser), np.column_stack([points, np.zeros(len(points))])


def _accepted(loops: Sequence[LoopCandidate], stamps: FloatArray) -> list[AcceptedLoop]:
    """The accepted loops of a robot on a floor, with the stamps (K,) of the keyframes."""
    return [
        AcceptedLoop(
            float(stamps[loop.place]),
            float(stamps[loop.keyframe]),
            row_from_pose2(loop.motion.T_reference_base),
        )
        for loop in loops
        if loop.accepted and loop.motion is not None
    ]


def _trajectory(stamps_s: list[float], poses: list[gtsam.Pose3]) -> Trajectory:
    """Poses as a trajectory."""
    rows = np.array([row_from_pose(pose) for pose in poses])
    return Trajectory(np.array(stamps_s), rows[:, :3], rows[:, 3:])
