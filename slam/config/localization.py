"""Settings of localisation in a known map."""

from __future__ import annotations

from pydantic import Field

from slam.config.files import StrictModel


class LocalizationConfig(StrictModel):
    """Localisation in a saved map: global search, hypotheses, tracking, loss and recovery."""

    search_every_m: float = Field(default=1.0, gt=0, description="least travel between two global searches")
    search_least_score: float = Field(default=0.45, gt=0, lt=1, description="lowest accepted mean likelihood")
    search_keep_share: float = Field(
        default=0.85, gt=0, le=1, description="poses with this share of the best score are kept too"
    )
    hypotheses: int = Field(default=24, ge=1, description="largest number of hypotheses")
    keyframe_m: float = Field(default=0.4, gt=0, description="travel between two readings that are weighted")
    keyframe_rad: float = Field(
        default=0.3, gt=0, description="rotation between two readings that are weighted"
    )
    window_m: float = Field(default=12.0, gt=0, description="path whose readings are weighted together")
    novel_cell_m: float = Field(default=0.3, gt=0, description="a surface counts once per cell of this size")
    correlated_cells: float = Field(
        default=3.0, ge=1, description="neighbouring surface cells that count as one measurement"
    )
    nowhere_nats: float = Field(
        default=3.5, ge=0, description="prior log-odds against a robot outside the map, or a kidnapped robot"
    )
    confident_probability: float = Field(
        default=0.98, gt=0.5, lt=1, description="posterior probability at which a hypothesis wins"
    )
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="least share of inliers for a match to the map"
    )
    gate_sigmas: float = Field(
        default=4.0, gt=0, description="matches farther from the prediction are rejected"
    )
    lost_nats: float = Field(default=12.0, gt=0, description="evidence against a pose above which it is lost")
    lost_after_s: float = Field(default=1.0, ge=0, description="least time this evidence must last")
    dead_reckoning_m: float = Field(
        default=0.5, gt=0, description="position sigma of dead reckoning above which the pose is lost"
    )
    map_sigma_m: float = Field(default=0.015, gt=0, description="local position error of the map itself")
    map_sigma_rad: float = Field(default=0.004, gt=0, description="local rotation error of the map itself")


class CloudLocalizationConfig(StrictModel):
    """Localisation of a 3D lidar in a map of clouds; ``localization`` applies to it too.

    Lengths that depend on the size of the scene are in voxels of ``cloud_odometry.voxel_m``.
    """

    reach_voxels: float = Field(
        default=40.0, gt=0, description="farther than this from every keyframe, there is no map to match"
    )
    places: int = Field(
        default=6, ge=1, description="places tried per search by appearance, and as many by the 2D plan"
    )
    new_share: float = Field(
        default=0.2, gt=0, le=1, description="share of a scan that counts as new compared with the last scan"
    )
