"""What can be set of localisation in a known map."""

from __future__ import annotations

from pydantic import Field

from slam.config.stages import StrictModel


class LocalizationConfig(StrictModel):
    """Localisation in a saved map: global search, hypotheses, tracking, loss and recovery."""

    field_cell_m: float = Field(default=0.1, gt=0, description="cell of the whole map's likelihood field")
    field_sigma_m: float = Field(default=0.15, gt=0, description="blur of that field")
    unknown_likelihood: float = Field(
        default=0.25, ge=0, lt=1, description="likelihood of a point where the map knows nothing"
    )
    search_every_m: float = Field(default=1.0, gt=0, description="travel between two global searches")
    search_back_m: float = Field(default=4.0, gt=0, description="travel whose scans are searched together")
    search_points: int = Field(default=150, ge=20, description="points in the global search")
    search_least_score: float = Field(default=0.45, gt=0, lt=1, description="least mean likelihood")
    search_keep_share: float = Field(
        default=0.85, gt=0, le=1, description="poses with this share of the best score are kept too"
    )
    search_threads: int = Field(default=2, ge=1, le=64, description="threads of the global search")
    hypotheses: int = Field(default=24, ge=1, description="hypotheses carried at most")
    tile_m: float = Field(default=4.0, gt=0, description="side of a tile of the map that is matched to")
    tile_reach_m: float = Field(
        default=10.0, gt=0, description="keyframes so near to a tile's middle make its local map"
    )
    tiles_cached: int = Field(default=48, ge=1, description="tiles kept in memory")
    station_m: float = Field(default=0.4, gt=0, description="travel between two scans that are weighed")
    station_rad: float = Field(default=0.3, gt=0, description="turn between two scans that are weighed")
    window_m: float = Field(default=12.0, gt=0, description="travel whose scans are weighed together")
    news_cell_m: float = Field(
        default=0.3, gt=0, description="a surface is weighed once, cell by cell of this side"
    )
    correlated_cells: float = Field(
        default=3.0, ge=1, description="neighbouring cells of a surface that count as one reading"
    )
    nowhere_nats: float = Field(
        default=3.5, description="evidence that a pose must exceed to be likelier than none in the map"
    )
    kidnap_nats: float = Field(
        default=3.0, ge=0, description="what it costs a hypothesis to believe that the robot was carried off"
    )
    carried_nats: float = Field(
        default=4.0, description="evidence that a lost robot is where dead reckoning takes it"
    )
    looks_nats: float = Field(
        default=4.0, description="evidence of a camera that recognised a place, where a lidar has its say too"
    )
    sure_probability: float = Field(
        default=0.98, gt=0.5, lt=1, description="posterior at which a hypothesis wins"
    )
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="share of the scan that must agree for a match to the map"
    )
    gate_sigmas: float = Field(
        default=4.0, gt=0, description="a match farther from the prediction is not believed"
    )
    lost_nats: float = Field(default=12.0, gt=0, description="evidence against the pose that means lost")
    lost_after_s: float = Field(default=1.0, ge=0, description="and the least time that it must last")
    dead_reckoning_m: float = Field(
        default=0.5, gt=0, description="sigma of the position beyond which dead reckoning means lost"
    )


class CloudLocalizationConfig(StrictModel):
    """Localisation of a 3D lidar in a map of clouds, beside what ``localization`` says of every kind.

    Lengths that follow the scene are in voxels of ``cloud_odometry.voxel_m``.
    """

    tile_voxels: float = Field(default=16.0, gt=0, description="side of a tile of the map that is matched to")
    tile_keyframes: int = Field(default=24, ge=1, description="nearest keyframes that make a tile's map")
    reach_voxels: float = Field(
        default=40.0, gt=0, description="farther than this from every keyframe there is no map to match to"
    )
    space_voxels: float = Field(
        default=120.0, gt=0, description="how far around a tile it is known what was free"
    )
    tiles_cached: int = Field(default=48, ge=1, description="tiles kept in memory")
    thickness_m: float = Field(
        default=0.03, gt=0, description="sigma across a plane; the two faces of a thin wall must exceed it"
    )
    looks: int = Field(
        default=6,
        ge=1,
        description="places that look alike, and as many of the same plan, tried by each search",
    )
    looks_apart_voxels: float = Field(default=8.0, gt=0, description="nearer places are tried once")
    looks_beside_voxels: float = Field(
        default=10.0, ge=0, description="places are also compared as they look from so far beside the robot"
    )
    coarseness: float = Field(
        default=3.0, ge=1, description="a place by looks is first aligned with voxels so many times as large"
    )
    arrive_voxels: float = Field(default=12.0, gt=0, description="how far a place by looks may be off")
    refined: int = Field(default=4, ge=1, description="of those, the best so many are aligned exactly")
    hypotheses: int = Field(default=8, ge=1, description="hypotheses carried at most")
    on_plane_voxels: float = Field(
        default=0.5, gt=0, description="a point so near to a plane is explained by it"
    )
    new_share: float = Field(
        default=0.2, gt=0, le=1, description="part of what a scan sees that the one before did not see alike"
    )
    least_stations: int = Field(
        default=3, ge=1, description="scans from different places that must agree before a pose is believed"
    )
    least_agreement: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="least share of a cloud on known planes, as a part of what the map's own clouds have",
    )
    map_sigma_m: float = Field(default=0.015, gt=0, description="what the map is off by from place to place")
    map_sigma_rad: float = Field(default=0.004, gt=0, description="and by how much it is bent there")
