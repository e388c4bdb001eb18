"""What can be set: one strict, frozen model a stage, each default with its reason in the description."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class StrictModel(BaseModel):
    """Base of every stage model: unknown keys and silent type changes are errors, values are final."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ScanConfig(StrictModel):
    """From a lidar sweep to points with normals."""

    range_min_m: float = Field(default=0.1, ge=0, description="nearer readings are the robot itself")
    range_max_m: float = Field(default=40.0, gt=0, description="farther readings are not matched")
    neighbours: int = Field(default=4, ge=1, le=50, description="beams a side in the line fit of a normal")


class MatchConfig(StrictModel):
    """Point-to-line alignment and the covariance taken from it."""

    coarse_cell_m: float = Field(default=0.3, gt=0, description="surfel cell of the first alignment")
    fine_cell_m: float = Field(default=0.1, gt=0, description="surfel cell of the last alignment")
    coarse_kernel_m: float = Field(default=0.1, gt=0, description="robust kernel of the first alignment")
    fine_kernel_m: float = Field(default=0.05, gt=0, description="robust kernel of the last alignment")
    iterations: int = Field(default=10, ge=1, description="Gauss-Newton steps an alignment")
    correlated_points: float = Field(
        default=25.0, ge=1, description="neighbouring beams that share an error and count as one reading"
    )
    floor_m: float = Field(default=0.002, gt=0, description="no match is surer than this")
    floor_rad: float = Field(default=0.001, gt=0, description="no match is surer than this")
    minimal_residual_m: float = Field(default=0.01, gt=0, description="a smaller residual is luck")
    degenerate_share: float = Field(
        default=0.02, gt=0, lt=0.5, description="share of the points' information below which an axis is weak"
    )
    degenerate_sigma_m: float = Field(default=0.5, gt=0, description="sigma given to a weak axis")


class LidarOdometryConfig(StrictModel):
    """Scan to local map matching."""

    method: Literal["surfel", "kiss_icp"] = Field(
        default="surfel", description="surfel: point-to-line on surfels; kiss_icp: KISS-ICP's registration"
    )
    use_wheel_odometry: bool = Field(
        default=True, description="take the first guess from the wheels; otherwise from constant velocity"
    )
    local_map_keyframes: int = Field(default=30, ge=1, description="newest keyframes that make the local map")
    sure_inlier_share: float = Field(
        default=0.7, gt=0, le=1, description="below this share the other guesses and a search are tried"
    )
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="below this share the match is refused and odometry carries on"
    )
    search_half_width_m: float = Field(default=0.6, gt=0, description="window of the search for a lost scan")
    search_half_yaw_rad: float = Field(default=0.6, gt=0, description="window of the search for a lost scan")
    search_least_score: float = Field(default=0.4, gt=0, lt=1, description="least score of that search")
    kiss_voxel_m: float = Field(default=0.2, gt=0, description="voxel of KISS-ICP's local map")
    kiss_map_radius_m: float = Field(default=60.0, gt=0, description="KISS-ICP forgets what is farther")
    kiss_correspondence_m: float = Field(default=0.3, gt=0, description="KISS-ICP's greatest pair distance")
    kiss_kernel_m: float = Field(default=0.1, gt=0, description="KISS-ICP's robust kernel")
    kiss_points_a_voxel: int = Field(default=10, ge=1, description="points KISS-ICP keeps a voxel")


class PredictionConfig(StrictModel):
    """What is expected of the next motion before the lidar is asked, and who wins a contradiction."""

    velocity_floor_m: float = Field(default=0.05, gt=0, description="constant velocity: sigma of no motion")
    velocity_floor_rad: float = Field(default=0.05, gt=0, description="constant velocity: sigma of no turn")
    velocity_share: float = Field(default=0.5, ge=0, description="constant velocity: sigma a metre or radian")
    memory_scans: float = Field(default=30.0, ge=1, description="scans over which a predictor is judged")
    surprise_sigmas: float = Field(
        default=3.0, gt=0, description="beyond this the match contradicts the best prediction"
    )
    disputed_within: float = Field(
        default=8.0, ge=0, description="log-likelihood ratio within which a contradiction is not decided"
    )


class WheelConfig(StrictModel):
    """How far wheel odometry is trusted between two keyframes."""

    floor_m: float = Field(default=0.03, gt=0, description="sigma of no motion")
    floor_rad: float = Field(default=0.02, gt=0, description="sigma of no turn")
    distance_share: float = Field(default=0.2, ge=0, description="sigma a metre travelled")
    turn_share: float = Field(default=0.2, ge=0, description="sigma a radian turned")
    turn_per_m_rad: float = Field(default=0.05, ge=0, description="yaw sigma a metre travelled")
    greatest_speed_m_s: float = Field(default=5.0, gt=0, description="a faster jump is not believed")
    greatest_turn_rad_s: float = Field(default=6.0, gt=0, description="a faster turn is not believed")


class KeyframeConfig(StrictModel):
    """When a scan becomes a node of the graph."""

    distance_m: float = Field(default=0.2, gt=0, description="travel after which a scan becomes a keyframe")
    angle_rad: float = Field(
        default=0.2, gt=0, le=3.15, description="turn after which a scan becomes a keyframe"
    )


class LoopConfig(StrictModel):
    """Loop closure: candidates, verification, acceptance."""

    enabled: bool = Field(default=True, description="close loops at all")
    every_m: float = Field(default=0.8, gt=0, description="travel between two attempts")
    least_path_m: float = Field(default=10.0, gt=0, description="way round below which it is no loop")
    reach_m: float = Field(default=3.0, gt=0, description="distance at which two keyframes see the same")
    sigmas: float = Field(default=3.0, gt=0, description="search window in standard deviations")
    greatest_half_width_m: float = Field(default=10.0, gt=0, description="limit of the window")
    greatest_half_yaw_rad: float = Field(default=1.6, gt=0, le=3.15, description="limit of the window")
    least_half_width_m: float = Field(default=0.3, gt=0, description="below this no search is needed")
    least_half_yaw_rad: float = Field(default=0.15, gt=0, description="below this no search is needed")
    misses_until_wide: int = Field(
        default=4, ge=1, description="attempts without a loop in known surroundings until the window widens"
    )
    wide_half_width_m: float = Field(default=1.5, gt=0, description="the widened window")
    wide_half_yaw_rad: float = Field(default=0.35, gt=0, le=3.15, description="the widened window")
    candidates: int = Field(default=3, ge=1, description="places tried an attempt")
    submap_half_keyframes: int = Field(default=8, ge=1, description="keyframes a side in a place's local map")
    submap_half_m: float = Field(default=4.0, gt=0, description="travel a side in a place's local map")
    submaps_cached: int = Field(default=32, ge=1, description="local maps kept in memory")
    field_cell_m: float = Field(default=0.05, gt=0, description="cell of the search's likelihood field")
    field_sigma_m: float = Field(default=0.1, gt=0, description="blur of the search's likelihood field")
    points: int = Field(default=120, ge=10, description="scan points in the search")
    least_score: float = Field(default=0.55, gt=0, lt=1, description="least mean likelihood")
    least_inlier_share: float = Field(default=0.5, gt=0, le=1, description="least share of matched points")
    greatest_residual_m: float = Field(default=0.04, gt=0, description="greatest residual of a true loop")
    inlier_probability: float = Field(
        default=0.99, gt=0, lt=1, description="GNC: a true loop passes the chi-square gate with this"
    )


class GraphConfig(StrictModel):
    """The factor graph and its solvers."""

    incremental_every: int = Field(default=20, ge=1, description="keyframes between two iSAM2 updates")
    lost_sigma_m: float = Field(default=1.0, gt=0, description="sigma of a step that nothing measured")
    sure_inlier_share: float = Field(
        default=0.8, ge=0, le=1, description="a match with fewer agreeing points may be overruled by loops"
    )
    loose_share: float = Field(default=0.3, gt=0, le=1, description="share of them where a match is refused")
    lost_sigma_rad: float = Field(default=0.5, gt=0, description="sigma of a step that nothing measured")


class GridConfig(StrictModel):
    """The occupancy grid that is saved."""

    resolution_m: float = Field(default=0.05, gt=0, le=1, description="side of a cell")
    hit_probability: float = Field(default=0.7, gt=0.5, lt=1, description="p of a cell that a beam ends in")
    miss_probability: float = Field(default=0.4, gt=0, lt=0.5, description="p of a cell a beam passes")
    hit_range_m: float = Field(default=40.0, gt=0, description="a return from farther marks nothing")
    clear_range_m: float = Field(
        default=8.0,
        ge=0,
        description="a beam without return clears so far: black things return nothing too",
    )
    greatest_cells: int = Field(
        default=64_000_000, ge=1, description="limit of the map's size, 5 bytes a cell"
    )
