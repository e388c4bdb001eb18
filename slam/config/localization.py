"""What can be set of localisation in a known map."""

from __future__ import annotations

from pydantic import Field

from slam.config.strict import StrictModel


class LocalizationConfig(StrictModel):
    """Localisation in a saved map: global search, hypotheses, tracking, loss and recovery."""

    field_cell_m: float = Field(default=0.1, gt=0, description="cell of the whole map's likelihood field")
    search_every_m: float = Field(default=1.0, gt=0, description="travel between two global searches")
    search_least_score: float = Field(default=0.45, gt=0, lt=1, description="least mean likelihood")
    search_keep_share: float = Field(
        default=0.85, gt=0, le=1, description="poses with this share of the best score are kept too"
    )
    search_threads: int = Field(default=2, ge=1, le=64, description="threads of the global search")
    hypotheses: int = Field(default=24, ge=1, description="hypotheses kept at most")
    tiles_cached: int = Field(default=48, ge=1, description="tiles of the map kept in memory")
    keyframe_m: float = Field(default=0.4, gt=0, description="travel between two readings that are weighed")
    keyframe_rad: float = Field(default=0.3, gt=0, description="turn between two readings that are weighed")
    window_m: float = Field(default=12.0, gt=0, description="travel whose readings are weighed together")
    novel_cell_m: float = Field(
        default=0.3, gt=0, description="a surface is weighed once, cell by cell of this side"
    )
    correlated_cells: float = Field(
        default=3.0, ge=1, description="neighbouring cells of a surface that count as one reading"
    )
    nowhere_nats: float = Field(
        default=3.5,
        ge=0,
        description="prior odds against a surprise: that the robot is nowhere in the map, or was kidnapped",
    )
    confident_probability: float = Field(
        default=0.98, gt=0.5, lt=1, description="posterior at which a hypothesis wins"
    )
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="share of the reading that must agree for a match to the map"
    )
    gate_sigmas: float = Field(
        default=4.0, gt=0, description="a match farther from the prediction is not believed"
    )
    lost_nats: float = Field(default=12.0, gt=0, description="evidence against the pose that means lost")
    lost_after_s: float = Field(default=1.0, ge=0, description="and the least time that it must last")
    dead_reckoning_m: float = Field(
        default=0.5, gt=0, description="sigma of the position beyond which dead reckoning means lost"
    )
    map_sigma_m: float = Field(default=0.015, gt=0, description="what the map is off by from place to place")
    map_sigma_rad: float = Field(default=0.004, gt=0, description="and by how much it is bent there")


class CloudLocalizationConfig(StrictModel):
    """Localisation of a 3D lidar in a map of clouds, beside what ``localization`` says of every kind.

    Lengths that follow the scene are in voxels of ``cloud_odometry.voxel_m``.
    """

    reach_voxels: float = Field(
        default=40.0, gt=0, description="farther than this from every keyframe there is no map to match to"
    )
    places: int = Field(
        default=6,
        ge=1,
        description="places of like appearance, and as many of like plan, tried by each search",
    )
    new_share: float = Field(
        default=0.2, gt=0, le=1, description="part of what a scan sees that the one before did not see alike"
    )
    least_agreement: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="least share of a cloud on known planes, as a part of what the map's own clouds have",
    )
