"""The layered map of a finished run: what each sensor says of every cell, and what to drive by."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam

from fusion.height_band import HeightBand
from slam.config import Config
from slam.errors import ConfigError
from slam.map_result import MapResult
from slam.mapping.depth_grid import DepthModel
from slam.mapping.layered_map import LayerBuilder, LayeredMap, LayerSettings
from slam.measurements import LaserScan, Pose, RgbdFrame, pose2_from_row


def layers_of(result: MapResult, config: Config) -> LayeredMap | None:
    """The layers of a robot on a floor that has a camera; None for any other run.

    Raises
    ------
    ScanweaveError
        Where the map would not fit, or the robot climbs over all that it is high.
    """
    planar = isinstance(result.graph.pose(0), gtsam.Pose2)
    if not (config.layers.enabled and planar and result.dense is not None):
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
        max_cells=config.grid.greatest_cells,
    )
    builder = LayerBuilder(settings)
    for reading, T_map_base in _readings(result):
        builder.add(reading, T_map_base)
    return builder.finish()


def _readings(result: MapResult) -> Iterator[tuple[LaserScan | RgbdFrame, Pose]]:
    """Keyframe scans and images with the pose of the base at each."""
    for scan, pose in zip(result.keyframe_scans, result.keyframe_poses, strict=True):
        if scan is not None:
            yield scan, pose2_from_row(pose)
    if result.dense is None:
        return
    for frame, T_map_camera in zip(result.dense.frames, result.dense.poses, strict=True):
        if frame.T_base_camera is not None:
            yield frame, T_map_camera.compose(frame.T_base_camera.inverse())
