"""The layered map of a finished run: what each sensor says of every cell, and what to drive by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from fusion.height_band import HeightBand
from slam.config import Config
from slam.errors import ConfigError
from slam.map_result import DenseKeyframes, MapResult
from slam.mapping.depth_grid import DepthModel
from slam.mapping.layered_map import LayerBuilder, LayeredMap, LayerSettings
from slam.measurements import FloatArray, LaserScan, Pose, RgbdFrame, pose2_from_row


def layers_of(result: MapResult, config: Config) -> LayeredMap | None:
    """The layers of a robot on a floor, or of one with a 3D lidar, that has a camera; None for any other run.

    Raises
    ------
    ScanweaveError
        Where the map would not fit, or the robot climbs over all that it is high.
    """
    if result.dense is None:
        return None
    if isinstance(result.graph.pose(0), gtsam.Pose2):
        return layers_of_keyframes(result.keyframe_scans, result.keyframe_poses, result.dense, config)
    if result.clouds is None or not result.keyframe_scans:
        return None
    ground_m = result.clouds.ground_m
    return layers_of_keyframes(result.keyframe_scans, result.keyframe_poses, result.dense, config, ground_m)


def layers_of_keyframes(
    scans: Sequence[LaserScan | None],
    poses: FloatArray,
    dense: DenseKeyframes,
    config: Config,
    ground_m: float | None = None,
) -> LayeredMap | None:
    """The layers of keyframe scans with (K, 3) poses and of camera keyframes, as in `layers_of`.

    Parameters
    ----------
    ground_m
        Height of the floor in the base frame of a robot in space, which then counts as level; None of one
        that stays in the plane.
    """
    if not config.layers.enabled:
        return None
    if config.layers.climb_m >= config.layers.robot_height_m:
        raise ConfigError(
            f"layers.climb_m = {config.layers.climb_m:g} leaves no obstacle to a robot of "
            f"layers.robot_height_m = {config.layers.robot_height_m:g}; make the step lower"
        )
    band = HeightBand(0.0, config.layers.robot_height_m, config.layers.climb_m)
    settings = LayerSettings(
        resolution_m=config.grid.resolution_m,
        depth=DepthModel(band=band, depth_max_m=config.layers.depth_max_m),
        rule=config.layers.rule,
        robot_radius_m=config.layers.robot_radius_m,
        max_cells=config.grid.greatest_cells,
    )
    builder = LayerBuilder(settings)
    for reading, T_map_base in _readings(scans, poses, dense, ground_m):
        builder.add(reading, T_map_base)
    return builder.finish()


def _readings(
    scans: Sequence[LaserScan | None], poses: FloatArray, dense: DenseKeyframes, ground_m: float | None
) -> Iterator[tuple[LaserScan | RgbdFrame, Pose]]:
    """Keyframe scans and images with the pose of the base at each."""
    for scan, pose in zip(scans, poses, strict=True):
        if scan is not None:
            yield scan, pose2_from_row(pose)
    for frame, T_map_camera in zip(dense.frames, dense.poses, strict=True):
        if frame.T_base_camera is not None:
            base = T_map_camera.compose(frame.T_base_camera.inverse())
            if ground_m is not None:
                level = gtsam.Rot3.Yaw(base.rotation().yaw())
                base = gtsam.Pose3(level, np.array([base.x(), base.y(), -ground_m]))
            yield frame, base
