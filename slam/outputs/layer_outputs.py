"""The map of a finished run to drive by, and the layers that it was made of."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import ScanweaveError
from slam.mapper.map_result import DenseKeyframes, MapResult
from slam.mapping.keyframe_grid import depth_model, layer_settings, layers_of_grids
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import Pose, RgbdFrame


def layers_of(result: MapResult, config: Config) -> LayeredMap | None:
    """The layers of a run whose robot knows its floor; None of a camera in space.

    The lidar's is the run's grid, the depth layer is drawn from the camera keyframes. Where it cannot be
    drawn, the run gets a warning and the lidar's stands alone.
    """
    grid, settled = result.grid, config
    if grid is not None and grid.resolution_m > config.grid.resolution_m:
        result.warnings.append(
            f"The map is so large that its cells are {grid.resolution_m:g} m wide; for cells of "
            f"{config.grid.resolution_m:g} m raise grid.greatest_cells = {config.grid.greatest_cells}"
        )
        cells = config.grid.model_copy(update={"resolution_m": grid.resolution_m})
        settled = config.model_copy(update={"grid": cells})
    planar = isinstance(result.graph.pose(0), gtsam.Pose2)
    if result.dense is not None and (planar or (result.clouds is not None and result.grid is not None)):
        ground_m = None if planar or result.clouds is None else result.clouds.ground_m
        try:
            depth = depth_grid(result.dense, settled, ground_m)
            return layers_of_grids(grid, depth, config)
        except ScanweaveError as error:
            result.warnings.append(f"No depth layer was drawn, the map is the lidar's alone: {error}")
    return layers_of_grids(grid, None, config)


def depth_grid(dense: DenseKeyframes, config: Config, ground_m: float | None = None) -> OccupancyGrid | None:
    """The depth layer of camera keyframes; None where it is not asked for, or they tell nothing.

    Parameters
    ----------
    ground_m
        Height of the floor in the base frame of a robot in space, which then counts as level; None of one
        that stays in the plane.

    Raises
    ------
    ScanweaveError
        Where the map would not fit, or the robot climbs over all that it is high.
    """
    if not config.layers.enabled:
        return None
    builder = LayerBuilder(layer_settings(config, depth_model(config)))
    for frame, T_map_base in _posed_frames(dense, ground_m):
        builder.add(frame, T_map_base)
    return builder.grid("depth")


def _posed_frames(dense: DenseKeyframes, ground_m: float | None) -> Iterator[tuple[RgbdFrame, Pose]]:
    """Keyframe images with the pose of the base at each."""
    for frame, T_map_camera in zip(dense.frames, dense.poses, strict=True):
        if frame.T_base_camera is not None:
            base = T_map_camera.compose(frame.T_base_camera.inverse())
            if ground_m is not None:
                level = gtsam.Rot3.Yaw(base.rotation().yaw())
                base = gtsam.Pose3(level, np.array([base.x(), base.y(), -ground_m]))
            yield frame, base
