"""Settings of a layered map for each simulated rig: ranges and noise of its sensors."""

from __future__ import annotations

import math
from dataclasses import replace

from fusion.depth_model import RangeNoise
from fusion.height_band import HeightBand
from slam.config import Config
from slam.mapping import keyframe_grid
from slam.mapping.depth_grid import DepthModel
from slam.mapping.layer_builder import LayerSettings
from slam.simulation.rigs import Rig

FARTHEST_DEPTH_M = 4.0  # beyond, a stereo camera's noise is wider than a cell


def layer_settings(rig: Rig, band: HeightBand, resolution_m: float = 0.05) -> LayerSettings:
    """Settings for a rig: noise and ranges from its data sheets, everything else the default."""
    usual = keyframe_grid.layer_settings(Config())
    depth, lidar = DepthModel(band, FARTHEST_DEPTH_M), usual.lidar
    if rig.cameras:
        model = rig.cameras[0].model
        # A rounded disparity adds its own noise.
        sigma_px = math.hypot(model.disparity_sigma_px, model.disparity_step_px / math.sqrt(12.0))
        depth = DepthModel(
            band=band,
            noise=RangeNoise(0.001, per_m=sigma_px / model.focal_baseline_px_m),
            depth_min_m=model.range_min_m,
            depth_max_m=min(model.range_max_m, FARTHEST_DEPTH_M),
        )
    if rig.lidar is not None:
        sheet = rig.lidar.model
        lidar = replace(
            lidar,
            noise=RangeNoise(sheet.sigma_m, share=sheet.sigma_share),
            max_hit_range_m=sheet.range_max_m,
            max_clear_range_m=min(8.0, sheet.range_max_m),
        )
    return replace(usual, resolution_m=resolution_m, lidar=lidar, depth=depth, robot_radius_m=0.0)
