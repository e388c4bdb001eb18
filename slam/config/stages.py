"""What can be set: one strict, frozen model a stage, each default with its reason in the description."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from slam.config.calibration import Calibration
from slam.config.strict import StrictModel
from slam.config.tags import KnownPlaces


class SensorsConfig(StrictModel):
    """Which sensors of a log are used, and how the robot moves."""

    lidar: bool = Field(default=True, description="use the lidar where there is one")
    rgbd: bool = Field(default=True, description="use the RGB-D cameras where there are any")
    wheels: bool = Field(
        default=True, description="take the first guess from the wheels; otherwise from constant velocity"
    )
    mounting: Literal["given", "estimate"] = Field(
        default="given",
        description="given: cameras sit where the log says; estimate: find out, starting there; a log that "
        "does not say is always estimated",
    )
    lidar_silent_s: float = Field(
        default=0.5, gt=0, description="time without a scan after which cameras carry on alone"
    )
    topics: tuple[str, ...] = Field(
        default=(),
        description="of a bag with several topics of a sort (scans, clouds, odometry, images): those to read",
    )
    imu: bool = Field(default=True, description="use the IMU where there is one")
    motion: Literal["auto", "planar", "spatial"] = Field(
        default="auto",
        description="planar: a robot on a floor, SE(2); spatial: a 3D lidar or a hand-held camera, SE(3); "
        "auto: by a 3D lidar where it is the only one, else planar where the log holds a lidar or wheels",
    )
    doctor: bool = Field(
        default=True, description="compare the sensors first, and correct what is wrong beyond doubt"
    )
    calibration: Calibration = Calibration()
    calibration_files: tuple[str, ...] = Field(
        default=(),
        description="files of lenses and mountings by other tools (camera_info, Kalibr, URDF, tf, OpenCV), "
        "believed before the log",
    )
    tags: KnownPlaces | None = Field(
        default=None, description="tags that hang, and surveyed places; see --tags"
    )


class ScanConfig(StrictModel):
    """From a lidar sweep to points with normals."""

    range_min_m: float = Field(default=0.1, ge=0, description="nearer readings are the robot itself")
    range_max_m: float = Field(default=40.0, gt=0, le=10_000, description="farther readings are not matched")
    neighbours: int = Field(default=4, ge=1, le=50, description="beams a side in the line fit of a normal")


class MatchConfig(StrictModel):
    """Alignment of scans, clouds and images to a local map, and the covariance taken from it."""

    cell_m: float = Field(default=0.1, gt=0, description="surfel cell of a scan's last alignment")
    iterations: int = Field(default=10, ge=3, description="Gauss-Newton steps an alignment")
    local_map_keyframes: int = Field(default=30, ge=1, description="newest keyframes that make the local map")
    confident_inlier_share: float = Field(
        default=0.7, gt=0, le=1, description="below this share of agreeing readings another guess is tried"
    )
    least_inlier_share: float = Field(
        default=0.4, gt=0, le=1, description="below this share the match is refused and odometry carries on"
    )
    lost_after: int = Field(default=10, ge=1, description="unmatched readings until tracking starts anew")
    search_half_yaw_rad: float = Field(
        default=0.6, gt=0, le=3.15, description="window of a search for the pose"
    )
    search_points: int = Field(default=120, ge=10, description="scan points in a search for the pose")
    search_least_score: float = Field(default=0.5, gt=0, lt=1, description="its least mean likelihood")
    correlated_beams: int = Field(
        default=25, ge=1, description="beams up to this far apart may share their errors in the map"
    )
    floor_m: float = Field(default=0.002, gt=0, description="no match is more certain than this")
    floor_rad: float = Field(default=0.001, gt=0, description="no match is more certain than this")
    minimal_residual_m: float = Field(default=0.01, gt=0, description="a smaller residual is luck")
    degenerate_share: float = Field(
        default=0.02, gt=0, lt=0.5, description="share of the points' information below which an axis is weak"
    )
    degenerate_sigma_m: float = Field(
        default=0.5, gt=0, description="sigma given to a weak axis of a cloud or image"
    )

    @property
    def coarse_cell_m(self) -> float:
        """Surfel cell of a scan's first alignment, and so how far off its guess may be."""
        return 3.0 * self.cell_m

    @property
    def search_half_width_m(self) -> float:
        """Window of a search for the pose where the first alignment has not found it."""
        return 2.0 * self.coarse_cell_m

    @property
    def coarse_iterations(self) -> int:
        """How many of an image's first steps have wide gates."""
        return self.iterations // 3


class PredictionConfig(StrictModel):
    """What is expected of the next motion before the lidar is asked, and who wins a contradiction."""

    velocity_floor_m: float = Field(default=0.05, gt=0, description="constant velocity: sigma of no motion")
    velocity_floor_rad: float = Field(default=0.05, gt=0, description="constant velocity: sigma of no turn")
    velocity_share: float = Field(default=0.5, ge=0, description="constant velocity: sigma a metre or radian")
    memory_scans: float = Field(default=30.0, ge=1, description="scans over which a predictor is judged")
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
    swing_m_per_rad: float = Field(
        default=0.1,
        ge=0,
        description="sigma of the path a radian turned, of wheels that proved exact on the straight",
    )
    greatest_speed_m_s: float = Field(default=5.0, gt=0, description="a faster jump is not believed")
    greatest_turn_rad_s: float = Field(default=6.0, gt=0, description="a faster turn is not believed")


class KeyframeConfig(StrictModel):
    """When a scan becomes a node of the graph."""

    distance_m: float = Field(default=0.2, gt=0, description="travel after which a scan becomes a keyframe")
    angle_rad: float = Field(
        default=0.2, gt=0, le=3.15, description="turn after which a scan becomes a keyframe"
    )

    def due(self, x_m: float, y_m: float, yaw_rad: float) -> bool:
        """Whether a motion since the last keyframe asks for another."""
        return math.hypot(x_m, y_m) > self.distance_m or abs(yaw_rad) > self.angle_rad


class LoopConfig(StrictModel):
    """Loop closure by scans, clouds and images: candidates, verification, acceptance."""

    enabled: bool = Field(default=True, description="close loops at all")
    caution: float = Field(
        default=4.0,
        ge=1,
        description="factor on a loop's covariance: places change, and nothing else holds a true loop",
    )
    every_m: float = Field(default=0.8, gt=0, description="travel between two attempts")
    least_path_m: float = Field(default=10.0, gt=0, description="path round below which it is no loop")
    reach_m: float = Field(default=3.0, gt=0, description="distance at which two keyframes see the same")
    sigmas: float = Field(default=3.0, gt=0, description="search window in standard deviations")
    greatest_half_width_m: float = Field(
        default=3.0,
        gt=0,
        description="limit of the window; a place less certain is searched over the whole map",
    )
    misses_until_wide: int = Field(
        default=4, ge=1, description="attempts without a loop in known surroundings until the window widens"
    )
    near: int = Field(default=3, ge=0, description="places tried because they should be near")
    by_appearance: int = Field(default=2, ge=0, description="places tried because they look the same")
    half_keyframes: int = Field(default=8, ge=1, description="keyframes a side in a place's local map")
    least_overlap: float = Field(default=0.3, gt=0, le=1, description="least share that is seen by both")
    least_inlier_share: float = Field(
        default=0.6, gt=0, le=1, description="least share of agreeing readings, of those"
    )
    inlier_probability: float = Field(
        default=0.99, gt=0, lt=1, description="GNC: a true loop passes the chi-square gate with this"
    )


class GraphConfig(StrictModel):
    """The factor graph and its solvers."""

    incremental_every: int = Field(default=20, ge=1, description="keyframes between two iSAM2 updates")
    lost_sigma_m: float = Field(default=1.0, gt=0, description="sigma of a step that nothing measured")
    confident_inlier_share: float = Field(
        default=0.8, ge=0, le=1, description="a match with fewer agreeing points may be overruled by loops"
    )
    loose_share: float = Field(default=0.3, gt=0, le=1, description="share of them where a match is refused")
    lost_sigma_rad: float = Field(default=0.5, gt=0, description="sigma of a step that nothing measured")


class GridConfig(StrictModel):
    """The cells of every map, and what a beam of the lidar tells of them."""

    resolution_m: float = Field(default=0.05, ge=0.001, le=1, description="side of a cell")
    hit_probability: float = Field(default=0.7, gt=0.5, lt=1, description="p of a cell that a beam ends in")
    miss_probability: float = Field(
        default=0.45,
        gt=0,
        lt=0.5,
        description="p of a cell that a beam passes: it says little of a thin leg in it",
    )
    clear_range_m: float = Field(
        default=8.0,
        ge=0,
        le=10_000,
        description="a beam without return clears so far: black things return nothing too",
    )
    greatest_cells: int = Field(
        default=64_000_000, ge=1, description="of a map; a larger one gets larger cells"
    )


class RgbdConfig(StrictModel):
    """From an RGB-D frame to features and surface points."""

    working_width: int = Field(default=320, ge=40, description="columns of the depth image that is matched")
    plane_radius: int = Field(default=3, ge=1, le=10, description="half window of the plane fits, pixels")
    farthest_m: float = Field(default=6.0, gt=0, description="depth readings from farther are not matched")
    points: int = Field(default=6000, ge=100, description="surface points a frame is matched by")
    features: int = Field(default=1000, ge=50, description="ORB keypoints a frame")
    registration: Literal["auto", "given"] = Field(
        default="auto",
        description="given: colour is registered to depth; auto: find out where the colour camera sits",
    )


class RgbdOdometryConfig(StrictModel):
    """Frame to keyframe matching of RGB-D images."""

    views: int = Field(default=5, ge=1, description="keyframes a frame is matched against at once")
    feature_views: int = Field(default=2, ge=1, description="of them, those whose features are matched too")
    match_ratio: float = Field(default=0.8, gt=0, le=1, description="Lowe's ratio of descriptor distances")
    match_bits: int = Field(default=64, ge=1, le=256, description="greatest Hamming distance of a match")
    guided_radius: float = Field(
        default=0.05, gt=0, le=1, description="distance to where a feature is expected, in image widths"
    )
    least_inliers: int = Field(
        default=15, ge=6, description="features that must agree for PnP to be believed"
    )
    kernel_sigmas: float = Field(
        default=3.0, gt=0, description="scale of the robust kernel, and error within which PnP agrees"
    )
    gate_m: float = Field(default=0.05, gt=0, description="distance up to which surfaces are partners")
    depth_floor_m: float = Field(default=0.001, gt=0, description="sigma of a near depth reading")
    depth_share: float = Field(default=0.0012, ge=0, description="sigma of depth a square metre of distance")
    correlated_points: float = Field(
        default=60.0, ge=1, description="surface points that count as one reading"
    )
    correlated_features: float = Field(default=2.0, ge=1, description="features that count as one reading")
    least_points: int = Field(
        default=300, ge=1, description="surface points that must agree where too few features do"
    )
    keyframe_parallax: float = Field(
        default=0.12, gt=0, description="travel over median depth that makes a keyframe"
    )
    keyframe_overlap: float = Field(
        default=0.6, gt=0, le=1, description="share of the image known, below which a keyframe is made"
    )


class VisualLoopConfig(StrictModel):
    """Loop closure by the camera: known places, near and by their appearance."""

    least_gap: int = Field(default=2, ge=1, description="keyframes between the two ends")
    near_dissimilarity: float = Field(
        default=0.8, gt=0, description="travel in median depths plus turn in radians up to which they should"
    )
    least_place_score: float = Field(
        default=0.02, gt=0, le=1, description="least likeness, relative to that of two neighbouring keyframes"
    )
    least_features: int = Field(
        default=25, ge=6, description="features that must agree where appearance alone proposes the place"
    )


class DenseMapConfig(StrictModel):
    """Surfaces: the coloured map of the camera keyframes, the cloud of a 3D lidar."""

    enabled: bool = Field(default=True, description="write a mesh and a point cloud")
    voxel_m: float = Field(
        default=0.015, ge=0.001, le=1, description="side of a voxel of the signed distance field"
    )
    nearest_m: float = Field(default=0.3, ge=0, description="nearer depth readings are left out")
    octomap: bool = Field(default=False, description="write an OctoMap too; wants scanweave[octomap]")


class FusionConfig(StrictModel):
    """Repair of scans and depth images by each other (Xu2024)."""

    enabled: bool = Field(default=True, description="repair keyframes before they are drawn into the grid")
    tolerance_s: float = Field(default=0.15, gt=0, description="time between a scan and its image at most")
    least_pairs: int = Field(
        default=50, ge=1, description="pairs that must be summed before the rig is believed"
    )


class LayersConfig(StrictModel):
    """The map to drive by: lidar and depth layers, and what both decide (Li2020, Yang2021)."""

    enabled: bool = Field(default=True, description="write the layers of a robot that has a camera")
    robot_height_m: float = Field(default=0.7, gt=0, description="what hangs higher stops no robot")
    robot_radius_m: float = Field(
        default=0.15,
        ge=0,
        description="of a disc around the base that the robot covers: nothing stands there",
    )
    climb_m: float = Field(default=0.03, ge=0, description="highest step that the robot drives over")
    depth_max_m: float = Field(
        default=3.5, gt=0.25, le=100, description="farther depth readings mark nothing, in no map"
    )
    rule: Literal["cautious", "corrected", "printed"] = Field(
        default="cautious",
        description="what is free: seen free by cameras at all heights of the robot; or, as Li2020 Table 3, "
        "by the lidar at its own height too (its two swapped cells put right, or as printed)",
    )

    @model_validator(mode="after")
    def _something_stops(self) -> LayersConfig:
        """A robot must not climb over all that it is high."""
        if self.climb_m >= self.robot_height_m:
            raise ValueError("climb_m leaves no obstacle to a robot of robot_height_m; make the step lower")
        return self
