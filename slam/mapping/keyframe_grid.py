"""Settings of a run for the grid builder, and the lidar grid of a map's keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from fusion.bayes import evidence_steps
from fusion.height_band import HeightBand
from slam.config import Config
from slam.heap import give_back
from slam.mapping.depth_grid import DepthModel
from slam.mapping.layer_builder import LayerBuilder, LayerSettings
from slam.mapping.layered_map import OCCUPANCY, PASSED_BY, DecisionRule, LayeredMap
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import OccupancyGrid, Steps
from slam.mapping.passers_by import without_passers_by
from slam.measurements import FloatArray, LaserScan, pose2_from_row


def layer_settings(config: Config) -> LayerSettings:
    """Return the settings of the grids from the configuration."""
    grid, layers = config.grid, config.layers
    return LayerSettings(
        resolution_m=grid.resolution_m,
        lidar=LidarModel(
            p_hit=grid.hit_probability,
            p_miss=grid.miss_probability,
            max_hit_range_m=config.scan.range_max_m,
            max_clear_range_m=grid.clear_range_m,
        ),
        depth=DepthModel(HeightBand(0.0, layers.robot_height_m, layers.climb_m), layers.depth_max_m),
        robot_radius_m=layers.robot_radius_m,
        max_cells=grid.greatest_cells,
    )


def lidar_grids(
    scans: Sequence[LaserScan | None],
    poses: FloatArray,
    config: Config,
    measured: Sequence[LaserScan | None] = (),
) -> dict[str, OccupancyGrid]:
    """Draw the lidar grid from keyframe scans at their poses, and the grid of moving or temporary objects.

    Parameters
    ----------
    scans
        Sorted by time.
    poses
        (K, 3) map frame.
    measured
        The scans as measured: readings that are negative only in ``scans`` were removed as moving.

    Returns
    -------
    `OCCUPANCY`; nothing if no keyframe has a scan. `PASSED_BY` if something was removed.

    Raises
    ------
    ScanweaveError
        If the grid would have too many cells.
    """
    settings = layer_settings(config)
    builder = LayerBuilder(settings)

    def placed() -> Iterator[tuple[LaserScan, gtsam.Pose2]]:
        pairs = zip(scans, poses, strict=True)
        return ((scan, pose2_from_row(pose)) for scan, pose in pairs if scan is not None)

    for scan, T_map_base in placed():
        builder.add(scan, T_map_base)
    grid = builder.grid("lidar")
    del builder  # its tiles are equally large
    give_back()
    if grid is None:
        return {}
    if grid.resolution_m > settings.resolution_m:
        return {OCCUPANCY: grid}
    static, stood = without_passers_by(grid, placed(), settings.lidar)
    past = _moved(scans, poses, measured, grid, settings)
    if stood is not None:
        there = np.nonzero(stood.steps)
        past[there] = np.maximum(past[there], stood.steps[there])
    return {OCCUPANCY: static} | ({PASSED_BY: replace(grid, steps=past)} if past.any() else {})


def _moved(
    scans: Sequence[LaserScan | None],
    poses: FloatArray,
    measured: Sequence[LaserScan | None],
    grid: OccupancyGrid,
    settings: LayerSettings,
) -> Steps:
    """Return the evidence of removed moving objects in the cells of the grid of measured scans."""
    # Memory is allocated only where something is added.
    steps, cell_m, most = np.zeros(grid.shape, np.int16), grid.resolution_m, evidence_steps(settings.p_max)
    corner = round(grid.T_map_grid.y() / cell_m), round(grid.T_map_grid.x() / cell_m)
    for scan, was, pose in zip(scans, measured, poses, strict=False):
        if scan is was or scan is None or was is None:
            continue
        moving = (scan.ranges_m < 0.0) & (was.ranges_m > 0.0)
        if moving.any():
            alone = replace(was, ranges_m=np.where(moving, was.ranges_m, np.float32(np.nan)))
            board = lidar_board(alone, pose2_from_row(pose), settings.lidar, cell_m)
            row, col = board.row - corner[0], board.col - corner[1]
            rows, cols = board.steps.shape
            part = steps[row : row + rows, col : col + cols]
            hit = board.steps > 0
            part[hit] = np.minimum(part[hit] + board.steps[hit], most)
    return steps


def grid_of_keyframes(
    scans: Sequence[LaserScan | None], poses: FloatArray, config: Config
) -> OccupancyGrid | None:
    """Return the first of `lidar_grids`; None if no keyframe has a scan."""
    return lidar_grids(scans, poses, config).get(OCCUPANCY)


def layers_of_grids(
    lidar: OccupancyGrid | None, depth: OccupancyGrid | None, config: Config
) -> LayeredMap | None:
    """Combine the grids of both sensors; None if there is neither.

    Raises
    ------
    ScanweaveError
        If their cells are not aligned.
    """
    if lidar is None and depth is None:
        return None
    return LayeredMap(lidar, depth, DecisionRule(config.layers.rule))
