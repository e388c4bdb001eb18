"""Settings: one strict, frozen model per stage; each field has a description."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from slam.config.calibration import Calibration
from slam.config.files import StrictModel
from slam.config.tags import KnownPlaces


class SensorsConfig(StrictModel):
    """Which sensors of a log are used, and how the robot moves."""

    lidar: bool = Field(default=True, description="use the lidar, if the log has one")
    rgbd: bool = Field(default=True, description="use the RGB-D cameras, if the log has any")
    wheels: bool = Field(
        default=True, description="predict the next pose from wheel odometry; false: from constant velocity"
    )
    mounting: Literal["given", "estimate"] = Field(
        default="given",
        description="given: use the camera mountings in the log; estimate: estimate them, starting from "
        "those in the log; mountings missing in the log are always estimated",
    )
    topics: tuple[str, ...] = Field(
        default=(),
        description="topics to read if a bag has several of one kind (scans, clouds, odometry, images)",
    )
    imu: bool = Field(default=True, description="use the IMU, if the log has one")
    motion: Literal["auto", "planar", "spatial"] = Field(
        default="auto",
        description="planar: robot on a floor, SE(2); spatial: 3D lidar or hand-held camera, SE(3); auto: "
        "spatial if the only lidar is a 3D lidar, else planar if the log has a lidar or wheel "
        "odometry",
    )
    doctor: bool = Field(
        default=True, description="compare the sensors first, and correct errors that are beyond doubt"
    )
    calibration: Calibration = Calibration()
    calibration_files: tuple[str, ...] = Field(
        default=(),
        description="intrinsics and mountings from other tools (camera_info, Kalibr, URDF, tf, OpenCV); "
        "they override the log",
    )
    tags: KnownPlaces | None = Field(default=None, description="tags and surveyed points; see --tags")


class ScanConfig(StrictModel):
    """Conversion of a lidar sweep to points with normals."""

    range_min_m: float = Field(default=0.1, ge=0, description="nearer readings are taken as the robot itself")
    range_max_m: float = Field(default=40.0, gt=0, le=10_000, description="farther readings are not matched")
    neighbours: int = Field(default=4, ge=1, le=50, description="beams per side in the line fit of a normal")


class MatchConfig(StrictModel):
    """Alignment of scans, clouds and images to a local map, and the covariance of the result."""

    cell_m: float = Field(default=0.1, gt=0, description="side of the finest surfels and likelihood cells")
    iterations: int = Field(default=10, ge=3, description="Gauss-Newton steps per alignment")
    local_map_keyframes: int = Field(default=30, ge=1, description="newest keyframes in the local map")
    confident_inlier_share: float = Field(
        default=0.7,
        gt=0,
        le=1,
        description="below this share of inliers, another guess is tried, and loops may overrule the match",
    )
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="below this share of inliers, odometry replaces the match"
    )
    lost_after: int = Field(default=10, ge=1, description="unmatched readings after which tracking restarts")
    search_half_yaw_rad: float = Field(
        default=0.6, gt=0, le=3.15, description="half width of the yaw window in a pose search"
    )
    search_points: int = Field(default=120, ge=10, description="scan points used in a pose search")
    search_least_score: float = Field(default=0.5, gt=0, lt=1, description="lowest mean likelihood accepted")
    correlated_beams: int = Field(
        default=25, ge=1, description="beams up to this many apart may have correlated errors in the map"
    )
    floor_m: float = Field(default=0.002, gt=0, description="lower limit for the position sigma of a match")
    minimal_residual_m: float = Field(default=0.01, gt=0, description="smaller residuals are raised to this")
    degenerate_share: float = Field(
        default=0.02, gt=0, lt=0.5, description="share of information below which a direction is degenerate"
    )
    degenerate_sigma_m: float = Field(
        default=0.5, gt=0, description="sigma of a degenerate direction of a cloud or image"
    )

    @property
    def floor_rad(self) -> float:
        """Lower limit for the rotation sigma of a match: that of a position, two metres away."""
        return 0.5 * self.floor_m

    @property
    def coarse_cell_m(self) -> float:
        """Surfel cell size of a scan's first alignment, and so the largest error of its initial guess."""
        return 3.0 * self.cell_m

    @property
    def search_half_width_m(self) -> float:
        """Half width of the pose search that follows if the first alignment fails."""
        return 2.0 * self.coarse_cell_m

    @property
    def coarse_iterations(self) -> int:
        """Number of first steps in an image alignment that use wide gates."""
        return self.iterations // 3


class PredictionConfig(StrictModel):
    """Prediction of the next motion, and the decision if match and prediction contradict each other."""

    velocity_floor: float = Field(
        default=0.05, gt=0, description="constant velocity: sigma at rest, m and rad"
    )
    velocity_share: float = Field(default=0.5, ge=0, description="constant velocity: sigma per m or rad")
    memory_scans: float = Field(default=30.0, ge=1, description="scans over which errors are averaged")
    disputed_within: float = Field(
        default=8.0, ge=0, description="log-likelihood ratio up to which a contradiction stays undecided"
    )


class WheelConfig(StrictModel):
    """Uncertainty of wheel odometry between two keyframes."""

    floor_m: float = Field(default=0.03, gt=0, description="position sigma at rest")
    floor_rad: float = Field(default=0.02, gt=0, description="yaw sigma at rest")
    distance_share: float = Field(default=0.2, ge=0, description="position sigma per metre travelled")
    turn_share: float = Field(default=0.2, ge=0, description="yaw sigma per radian of rotation")
    turn_per_m_rad: float = Field(default=0.05, ge=0, description="yaw sigma per metre travelled")
    swing_m_per_rad: float = Field(
        default=0.1,
        ge=0,
        description="position sigma per radian of rotation, if the odometry was exact on straight paths",
    )
    greatest_speed_m_s: float = Field(default=5.0, gt=0, description="faster steps are rejected")
    greatest_turn_rad_s: float = Field(default=6.0, gt=0, description="faster rotations are rejected")


class KeyframeConfig(StrictModel):
    """When a scan becomes a keyframe, a node of the graph."""

    distance_m: float = Field(default=0.2, gt=0, description="distance travelled that triggers a keyframe")
    angle_rad: float = Field(default=0.2, gt=0, le=3.15, description="rotation that triggers a keyframe")

    def due(self, x_m: float, y_m: float, yaw_rad: float) -> bool:
        """Whether a motion since the last keyframe requires a new keyframe."""
        return math.hypot(x_m, y_m) > self.distance_m or abs(yaw_rad) > self.angle_rad


class LoopConfig(StrictModel):
    """Loop closure by scans, clouds and images: candidates, verification, acceptance."""

    enabled: bool = Field(default=True, description="search for loop closures")
    caution: float = Field(
        default=4.0,
        ge=1,
        description="factor on a loop's covariance: places change, and nothing else supports a true loop",
    )
    every_m: float = Field(default=0.8, gt=0, description="distance travelled between two searches")
    least_path_m: float = Field(default=10.0, gt=0, description="shortest path around a loop")
    reach_m: float = Field(
        default=3.0,
        gt=0,
        description="two keyframes this close see the same place; a less certain pose is searched for in the "
        "whole map",
    )
    sigmas: float = Field(default=3.0, gt=0, description="half width of the search window in sigmas")
    near: int = Field(default=3, ge=0, description="candidate places chosen by their distance")
    by_appearance: int = Field(default=2, ge=0, description="candidate places chosen by their appearance")
    half_keyframes: int = Field(default=8, ge=1, description="keyframes on each side in a place's local map")
    least_overlap: float = Field(default=0.3, gt=0, le=1, description="least share seen by both keyframes")
    least_inlier_share: float = Field(
        default=0.6, gt=0, le=1, description="least inlier share in the overlap"
    )
    inlier_probability: float = Field(
        default=0.99, gt=0, lt=1, description="GNC: probability that a true loop passes the chi-square gate"
    )


class GraphConfig(StrictModel):
    """The factor graph and its solvers."""

    incremental_every: int = Field(default=20, ge=1, description="keyframes between two iSAM2 updates")
    lost_sigma_m: float = Field(default=1.0, gt=0, description="position sigma of an unmeasured step")
    loose_share: float = Field(
        default=0.3, gt=0, le=1, description="factor on the lost sigmas, for a step whose match is rejected"
    )

    @property
    def lost_sigma_rad(self) -> float:
        """Rotation sigma of an unmeasured step."""
        return 0.5 * self.lost_sigma_m


class GridConfig(StrictModel):
    """Cells of all grid maps, and the sensor model of a lidar beam."""

    resolution_m: float = Field(default=0.05, ge=0.001, le=1, description="side of a cell")
    hit_probability: float = Field(
        default=0.7, gt=0.5, lt=1, description="occupancy probability of a cell in which a beam ends"
    )
    miss_probability: float = Field(
        default=0.45,
        gt=0,
        lt=0.5,
        description="occupancy probability of a cell that a beam passes: it may miss a thin leg there",
    )
    clear_range_m: float = Field(
        default=8.0,
        ge=0,
        le=10_000,
        description="free distance along a beam without return: dark surfaces return nothing either",
    )
    greatest_cells: int = Field(default=64_000_000, ge=1, description="above this, a map gets larger cells")


class RgbdConfig(StrictModel):
    """Conversion of an RGB-D frame to features and surface points."""

    working_width: int = Field(default=320, ge=40, description="columns of the depth image used for matching")
    plane_radius: int = Field(default=3, ge=1, le=10, description="half window of the plane fits, pixels")
    farthest_m: float = Field(default=6.0, gt=0, description="farther depth readings are not matched")
    points: int = Field(default=6000, ge=100, description="surface points matched per frame")
    features: int = Field(default=1000, ge=50, description="ORB keypoints per frame")
    registration: Literal["auto", "given"] = Field(
        default="auto",
        description="given: colour is registered to depth; auto: estimate the pose of the colour camera",
    )


class RgbdOdometryConfig(StrictModel):
    """Matching of RGB-D frames to keyframes."""

    views: int = Field(default=5, ge=1, description="keyframes to which a frame is matched at once")
    match_ratio: float = Field(default=0.8, gt=0, le=1, description="Lowe's ratio of descriptor distances")
    guided_radius: float = Field(
        default=0.05, gt=0, le=1, description="search radius around a predicted feature, in image widths"
    )
    least_inliers: int = Field(default=15, ge=6, description="fewest inliers of an accepted PnP pose")
    kernel_sigmas: float = Field(
        default=3.0, gt=0, description="scale of the robust kernel, and inlier threshold of PnP"
    )
    gate_m: float = Field(default=0.05, gt=0, description="largest distance of corresponding surfaces")
    depth_floor_m: float = Field(default=0.001, gt=0, description="sigma of a near depth reading")
    depth_share: float = Field(default=0.0012, ge=0, description="depth sigma per squared metre of distance")
    correlated_points: float = Field(default=60.0, ge=1, description="points that count as one measurement")
    correlated_features: float = Field(default=2.0, ge=1, description="features that count as one")
    keyframe_parallax: float = Field(
        default=0.12, gt=0, description="travel over median depth that makes a keyframe"
    )
    keyframe_overlap: float = Field(
        default=0.6, gt=0, le=1, description="a keyframe is made if a smaller share of the image is known"
    )

    @property
    def feature_views(self) -> int:
        """Number of keyframes whose features a frame is matched to, too."""
        return max(self.views // 2, 1)

    @property
    def least_points(self) -> float:
        """Fewest matched surface points where too few features match: those of five measurements."""
        return 5.0 * self.correlated_points


class VisualLoopConfig(StrictModel):
    """Loop closure by camera: candidate places by distance and by appearance."""

    least_gap: int = Field(default=2, ge=1, description="fewest keyframes between the two ends")
    near_dissimilarity: float = Field(
        default=0.8,
        gt=0,
        description="views are near up to this sum: travel (in median depths) and rotation (in radians)",
    )
    least_features: int = Field(
        default=25, ge=6, description="fewest matched features if only the appearance proposes the place"
    )


class DenseMapConfig(StrictModel):
    """Dense maps: coloured surfaces of the camera keyframes, the point cloud of a 3D lidar."""

    enabled: bool = Field(default=True, description="write a mesh and a point cloud")
    voxel_m: float = Field(default=0.015, ge=0.001, le=1, description="voxel of the signed distance field")


class FusionConfig(StrictModel):
    """Mutual repair of scans and depth images (Xu2024)."""

    enabled: bool = Field(default=True, description="repair keyframes before they are drawn into the grid")
    tolerance_s: float = Field(default=0.15, gt=0, description="largest time between a scan and its image")
    least_pairs: int = Field(default=50, ge=1, description="pairs summed before the rig estimate is used")


class LayersConfig(StrictModel):
    """Navigation map: lidar and depth layers, and their combination (Li2020, Yang2021)."""

    enabled: bool = Field(default=True, description="write the layers of a robot that has a camera")
    robot_height_m: float = Field(default=0.7, gt=0, description="obstacles above this do not stop the robot")
    robot_radius_m: float = Field(
        default=0.15, ge=0, description="radius of the disc around the base that the robot covers: it is free"
    )
    climb_m: float = Field(default=0.03, ge=0, description="highest step that the robot drives over")
    depth_max_m: float = Field(
        default=3.5, gt=0.25, le=100, description="farther depth readings mark nothing, in any map"
    )
    rule: Literal["cautious", "corrected", "printed"] = Field(
        default="cautious",
        description="cautious: free where cameras see all heights of the robot free; corrected, printed: as "
        "Li2020 Table 3, also free where the lidar sees its own height free (two swapped cells "
        "put right, or as printed)",
    )

    @model_validator(mode="after")
    def _something_stops(self) -> LayersConfig:
        """Check that the highest step is lower than the robot."""
        if self.climb_m >= self.robot_height_m:
            raise ValueError("climb_m leaves no obstacle to a robot of robot_height_m; make the step lower")
        return self
