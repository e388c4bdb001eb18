"""What can be set for a 3D lidar: odometry, loops and the map of its clouds."""

from __future__ import annotations

from pydantic import Field

from slam.config.strict import StrictModel


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
    keyframe_voxels: float = Field(default=2.0, gt=0, description="voxels between clouds of the local map")
    thickness_m: float = Field(
        default=0.06, gt=0, description="sigma across a plane up to which a voxel's points are a plane"
    )
    least_pairs: int = Field(default=60, ge=6, description="points on known planes, below which nothing fits")
    correlated_points: float = Field(default=5.0, ge=1, description="points that count as one reading")


class CloudLoopConfig(StrictModel):
    """Loop closure by clouds: places near by the estimate, and places that look the same."""

    reach_voxels: float = Field(
        default=15.0,
        gt=0,
        description="distance in voxels at which two keyframes see the same, and travel between two attempts",
    )
    least_path_voxels: float = Field(
        default=60.0, gt=0, description="path round in voxels below which it is no loop"
    )
    drift_share: float = Field(
        default=0.01,
        ge=0,
        description="sigma a metre travelled since the last loop, on top of what the covariances tell",
    )
    greatest_dissimilarity: float = Field(
        default=0.3, gt=0, le=1, description="distance of scan contexts up to which places look the same"
    )
    greatest_residual_ratio: float = Field(
        default=1.5, gt=1, description="greatest residual, in usual residuals of the odometry"
    )


class CloudMapConfig(StrictModel):
    """The plan that is cut from the clouds."""

    bearings: int = Field(default=720, ge=90, description="bearings of the plan's scan of each keyframe")
    ground_share: float = Field(
        default=0.005,
        ge=0,
        description="noise of a height a metre of distance, and that of two metres at any",
    )
    plan_range_m: float = Field(default=15.0, gt=0, description="farther points do not enter the plan")
    least_points: int = Field(default=2, ge=1, description="points of a bearing within a cell that stop it")
