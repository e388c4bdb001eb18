"""Settings for a 3D lidar: odometry, loop closure and the map of its clouds."""

from __future__ import annotations

from pydantic import Field

from slam.config.files import StrictModel


class CloudOdometryConfig(StrictModel):
    """Odometry of a 3D lidar, revolution by revolution: KISS-ICP, then point-to-plane."""

    scale_share: float = Field(
        default=0.05, gt=0, description="voxel size as a share of the median range, if voxel_m is not given"
    )
    voxel_m: float | None = Field(
        default=None,
        gt=0,
        description="voxel size for matched points, and smallest for planes; null: from the first cloud",
    )
    least_voxel_m: float = Field(default=0.1, gt=0, description="lower limit of a voxel size found from data")
    greatest_voxel_m: float = Field(
        default=0.6, gt=0, description="upper limit of a voxel size found from data"
    )
    range_min_m: float = Field(default=0.4, ge=0, description="nearer points are taken as the robot itself")
    range_max_m: float = Field(default=100.0, gt=0, description="farther points are not used")
    deskew: bool = Field(
        default=True, description="undo the motion within a revolution, if the log has the points' times"
    )
    keyframe_voxels: float = Field(
        default=2.0, gt=0, description="travel between two clouds of the local map, in voxels"
    )
    thickness_m: float = Field(
        default=0.06, gt=0, description="largest sigma across a plane for which a voxel's points are a plane"
    )
    least_pairs: int = Field(default=60, ge=6, description="fewest points on known planes in a valid match")
    correlated_points: float = Field(default=5.0, ge=1, description="points that count as one measurement")


class CloudLoopConfig(StrictModel):
    """Loop closure by clouds: candidate places by distance and by appearance."""

    reach_voxels: float = Field(
        default=15.0,
        gt=0,
        description="two keyframes this close (in voxels) see the same place; also travel between searches",
    )
    least_path_voxels: float = Field(default=60.0, gt=0, description="shortest path around a loop, in voxels")
    drift_share: float = Field(
        default=0.01,
        ge=0,
        description="position sigma per metre since the last loop, added to the covariance",
    )
    greatest_dissimilarity: float = Field(
        default=0.3, gt=0, le=1, description="largest distance of scan contexts at which places look the same"
    )
    greatest_residual_ratio: float = Field(
        default=1.5, gt=1, description="largest residual, relative to the usual residual of the odometry"
    )


class CloudMapConfig(StrictModel):
    """The 2D map that is cut from the clouds."""

    bearings: int = Field(default=720, ge=90, description="bearings in the 2D scan made of each keyframe")
    ground_share: float = Field(
        default=0.005, ge=0, description="height noise per metre of distance, plus that of two metres"
    )
    plan_range_m: float = Field(default=15.0, gt=0, description="farther points are not used in the 2D map")
    least_points: int = Field(default=2, ge=1, description="points per bearing and cell forming an obstacle")
