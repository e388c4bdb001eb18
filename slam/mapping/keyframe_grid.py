"""The settings of a run as the builder of grids takes them, and the lidar's grid of a map's keyframes."""

from __future__ import annotations

from collections.abc import Sequence

from fusion.height_band import HeightBand
from slam.config import Config
from slam.errors import ConfigError
from slam.mapping.depth_grid import DepthModel
from slam.mapping.layer_builder import LayerBuilder, LayerSettings
from slam.mapping.layered_map import OCCUPANCY, PASSED_BY, DecisionRule, LayeredMap
from slam.mapping.lidar_layer import LidarModel
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.mapping.passers_by import without_passers_by
from slam.measurements import FloatArray, LaserScan, pose2_from_row


def layer_settings(config: Config, depth: DepthModel | None = None) -> LayerSettings:
    """What the configuration says of the grids; the depth model only where depth images are drawn."""
    grid = config.grid
    return LayerSettings(
        resolution_m=grid.resolution_m,
        lidar=LidarModel(
            p_hit=grid.hit_probability,
            p_miss=grid.miss_probability,
            max_hit_range_m=config.scan.range_max_m,
            max_clear_range_m=grid.clear_range_m,
        ),
        depth=depth or DepthModel(),
        robot_radius_m=config.layers.robot_radius_m,
        max_cells=grid.greatest_cells,
    )


def depth_model(config: Config) -> DepthModel:
    """What the configuration says of depth images.

    Raises
    ------
    ConfigError
        Where the robot climbs over all that it is high.
    """
    layers = config.layers
    if layers.climb_m >= layers.robot_height_m:
        raise ConfigError(
            f"layers.climb_m = {layers.climb_m:g} leaves no obstacle to a robot of "
            f"layers.robot_height_m = {layers.robot_height_m:g}; make the step lower"
        )
    band = HeightBand(0.0, layers.robot_height_m, layers.climb_m)
    return DepthModel(band=band, depth_max_m=layers.depth_max_m)


def lidar_grids(
    scans: Sequence[LaserScan | None], poses: FloatArray, config: Config
) -> dict[str, OccupancyGrid]:
    """The lidar's grid of keyframe scans at their poses, and what stood there for a while and has gone.

    Parameters
    ----------
    scans
        In the order of time.
    poses
        (K, 3) map frame.

    Returns
    -------
    `OCCUPANCY`; nothing where no keyframe has a scan. `PASSED_BY` where something has gone.

    Raises
    ------
    ScanweaveError
        Where the grid would have too many cells.
    """
    settings = layer_settings(config)
    builder = LayerBuilder(settings)
    placed = [
        (scan, pose2_from_row(pose)) for scan, pose in zip(scans, poses, strict=True) if scan is not None
    ]
    for scan, T_map_base in placed:
        builder.add(scan, T_map_base)
    grid = builder.grid("lidar")
    if grid is None:
        return {}
    if grid.resolution_m > settings.resolution_m:
        return {OCCUPANCY: grid}
    static, passed_by = without_passers_by(grid, placed, settings.lidar)
    return {OCCUPANCY: static} if passed_by is None else {OCCUPANCY: static, PASSED_BY: passed_by}


def grid_of_keyframes(
    scans: Sequence[LaserScan | None], poses: FloatArray, config: Config
) -> OccupancyGrid | None:
    """The first of `lidar_grids`; None where no keyframe has a scan."""
    return lidar_grids(scans, poses, config).get(OCCUPANCY)


def layers_of_grids(
    lidar: OccupancyGrid | None, depth: OccupancyGrid | None, config: Config
) -> LayeredMap | None:
    """What the grids of both sensors decide together; None where there is neither.

    Raises
    ------
    ScanweaveError
        Where they do not lie on one lattice.
    """
    if lidar is None and depth is None:
        return None
    return LayeredMap(lidar, depth, DecisionRule(config.layers.rule))
