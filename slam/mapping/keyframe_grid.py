"""The occupancy grid of a map's keyframes."""

from __future__ import annotations

from collections.abc import Sequence

from slam.config_stages import GridConfig
from slam.mapping.occupancy_grid import InverseSensorModel, OccupancyGrid, PosedScan, build_grid
from slam.measurements import FloatArray, LaserScan, pose2_from_row


def grid_of_keyframes(
    scans: Sequence[LaserScan | None], poses: FloatArray, config: GridConfig
) -> OccupancyGrid | None:
    """The grid of keyframe scans at their poses, (K, 3) map frame; None where no keyframe has a scan.

    Raises
    ------
    ScanweaveError
        Where the grid would have too many cells.
    """
    if all(scan is None for scan in scans):
        return None
    model = InverseSensorModel(
        p_hit=config.hit_probability,
        p_miss=config.miss_probability,
        max_hit_range_m=config.hit_range_m,
        max_clear_range_m=config.clear_range_m,
    )
    posed = (
        PosedScan.of(scan, pose2_from_row(pose))
        for scan, pose in zip(scans, poses, strict=True)
        if scan is not None
    )
    return build_grid(posed, config.resolution_m, model, max_cells=config.greatest_cells)
