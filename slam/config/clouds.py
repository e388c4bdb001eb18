"""What can be set for a 3D lidar: odometry, loops and the map of its clouds."""

from __future__ import annotations

from pydantic import Field

from slam.config.stages import StrictModel


class CloudOdometryConfig(StrictModel):
    """From a turn of a 3D lidar to a motion: KISS-ICP, then point to plane."""

    scale_share: float = Field(
        default=0.05, gt=0, description="voxel as a share of the median range, where voxel_m is not given"
    )
    voxel_m: float | None = Field(
        default=None,
        gt=0,
        description="voxel of the matched points and smallest of the planes; null: by the first cloud",
    )
    least_voxel_m: float = Field(default=0.1, gt=0, description="limit of the voxel found by the data")
    greatest_voxel_m: float = Field(default=0.6, gt=0, description="limit of the voxel found by the data")
    range_min_m: float = Field(default=0.4, ge=0, description="nearer points are the robot itself")
    range_max_m: float = Field(default=100.0, gt=0, description="farther points are not used")
    deskew: bool = Field(
        default=True, description="undo the motion within a turn, where the log tells the points' times"
    )
    use_wheel_odometry: bool = Field(
        default=True, description="take the first guess from the wheels; otherwise from constant velocity"
    )
    local_map_keyframes: int = Field(default=40, ge=1, description="newest keyframes that make the local map")
    keyframe_voxels: float = Field(default=2.0, gt=0, description="travel in voxels that makes a keyframe")
    keyframe_angle_rad: float = Field(default=0.25, gt=0, le=3.15, description="turn that makes a keyframe")
    points_a_voxel: int = Field(default=20, ge=1, description="points KISS-ICP keeps a voxel")
    thickness_m: float = Field(
        default=0.06, gt=0, description="sigma across a plane up to which a voxel's points are a plane"
    )
    iterations: int = Field(default=15, ge=1, description="point-to-plane Gauss-Newton steps")
    least_pairs: int = Field(default=60, ge=6, description="points on known planes, below which nothing fits")
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="below this share the match is refused and odometry carries on"
    )
    correlated_points: float = Field(default=5.0, ge=1, description="points that count as one reading")
    floor_m: float = Field(default=0.002, gt=0, description="no match is surer than this")
    floor_rad: float = Field(default=0.0005, gt=0, description="no match is surer than this")
    minimal_residual_m: float = Field(default=0.01, gt=0, description="a smaller residual is luck")
    degenerate_share: float = Field(
        default=0.01, gt=0, lt=0.3, description="share of the points' information below which an axis is weak"
    )
    degenerate_sigma_m: float = Field(default=0.5, gt=0, description="sigma given to a weak axis")


class CloudLoopConfig(StrictModel):
    """Loop closure by clouds: places near by the estimate, and places that look the same."""

    enabled: bool = Field(default=True, description="close loops by the 3D lidar at all")
    caution: float = Field(default=4.0, ge=1, description="factor on a loop's covariance: places change")
    every_voxels: float = Field(default=12.0, gt=0, description="travel in voxels between two attempts")
    least_path_voxels: float = Field(
        default=60.0, gt=0, description="way round in voxels below which it is no loop"
    )
    reach_voxels: float = Field(
        default=15.0, gt=0, description="distance in voxels at which two keyframes see the same"
    )
    sigmas: float = Field(default=4.0, gt=0, description="how far a place may be from where it is expected")
    drift_share: float = Field(
        default=0.01,
        ge=0,
        description="sigma a metre of way since the last loop, on top of what the covariances tell",
    )
    near: int = Field(default=2, ge=0, description="places tried because they should be near")
    by_looks: int = Field(default=2, ge=0, description="places tried because they look the same")
    greatest_unlikeness: float = Field(
        default=0.3, gt=0, le=1, description="distance of scan contexts up to which places look the same"
    )
    half_keyframes: int = Field(default=8, ge=1, description="keyframes a side in a place's local map")
    places_cached: int = Field(default=8, ge=1, description="local maps kept in memory")
    least_overlap: float = Field(default=0.4, gt=0, le=1, description="least share of points on known planes")
    least_inlier_share: float = Field(default=0.6, gt=0, le=1, description="least share that agree of those")
    greatest_residual_ratio: float = Field(
        default=1.5, gt=1, description="greatest residual, in usual residuals of the odometry"
    )


class CloudMapConfig(StrictModel):
    """The maps of the clouds."""

    enabled: bool = Field(default=True, description="write the cloud of the whole map")
    voxel_m: float = Field(default=0.05, gt=0, description="one point a voxel of this side")
    bearings: int = Field(default=720, ge=90, description="bearings of the plan's scan of each keyframe")
    ground_sigma_m: float = Field(default=0.01, ge=0, description="noise of a height near the robot")
    ground_share: float = Field(default=0.005, ge=0, description="noise of a height a metre of distance")
    plan_range_m: float = Field(default=15.0, gt=0, description="farther points do not enter the plan")
    least_points: int = Field(default=2, ge=1, description="points of a bearing within a cell that stop it")
