"""Sensor models from data sheets: rate, field of view, range, resolution, noise, and usual faults."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from slam.measurements import CameraIntrinsics
from slam.simulation.faults import NO_FAULTS, FaultConfig


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A 2D lidar.

    Attributes
    ----------
    rate_hz
        Scans per second.
    beams, start_angle_rad, step_rad
        Beams counter-clockwise in the laser frame.
    range_min_m, range_max_m, resolution_m
        Range limits and resolution of its readings.
    sigma_m, sigma_share, sigma_share_far
        Standard deviation: the first plus a share of the range, which grows with the square of the range from
        the second to the third at maximum range.
    faults
        Faults of single readings.
    """

    name: str
    rate_hz: float
    beams: int
    start_angle_rad: float
    step_rad: float
    range_min_m: float
    range_max_m: float
    resolution_m: float
    sigma_m: float
    sigma_share: float = 0.0
    sigma_share_far: float = 0.0
    faults: FaultConfig = NO_FAULTS


@dataclass(frozen=True, slots=True)
class RingLidarModel:
    """A rotating 3D lidar with rings.

    Attributes
    ----------
    elevations_rad
        Elevations of the rings, lowest first.
    azimuths
        Firings per revolution, counter-clockwise from x.
    sigma_m
        Standard deviation of a range.
    """

    name: str
    rate_hz: float
    elevations_rad: tuple[float, ...]
    azimuths: int
    range_min_m: float
    range_max_m: float
    resolution_m: float
    sigma_m: float
    faults: FaultConfig = NO_FAULTS


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A depth camera that triangulates, with its colour image registered.

    Attributes
    ----------
    intrinsics
        Intrinsics of both images.
    range_min_m, range_max_m
        Depths outside are holes.
    focal_baseline_px_m
        Focal length of the matcher times its baseline: disparity is this divided by the depth.
    disparity_step_px, disparity_sigma_px
        Quantisation and standard deviation of the disparity; both make a depth error that grows with the
        square of the depth.
    depth_unit_m
        Smallest difference of stored depths.
    color_sigma
        Noise of a colour value, in steps of 1 of 255.
    """

    name: str
    rate_hz: float
    intrinsics: CameraIntrinsics
    range_min_m: float
    range_max_m: float
    focal_baseline_px_m: float
    disparity_step_px: float
    disparity_sigma_px: float
    depth_unit_m: float = 0.001
    color_sigma: float = 2.0
    faults: FaultConfig = field(default=NO_FAULTS)


def intrinsics_from_fov(
    width: int, height: int, horizontal_deg: float, vertical_deg: float
) -> CameraIntrinsics:
    """Return a pinhole camera from its full angles of view."""
    return CameraIntrinsics(
        fx=0.5 * width / math.tan(math.radians(0.5 * horizontal_deg)),
        fy=0.5 * height / math.tan(math.radians(0.5 * vertical_deg)),
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
        width=width,
        height=height,
    )


_LIDAR_FAULTS = FaultConfig(
    glass_mirror_cos=math.cos(math.radians(8.0)),
    glass_hole_share=0.25,
    dark_range_m=5.0,
    grazing_cos=0.06,
    grazing_hole_share=0.6,
    random_hole_share=0.003,
    edge_burr_share=0.25,
    multipath_share=0.04,
    patch=2,
)

# 0.15-12 m, 400 points per revolution at 10 Hz (Li2020); triangulation, so its error grows with the range.
RPLIDAR_A2 = LidarModel(
    "rplidar_a2",
    rate_hz=10.0,
    beams=400,
    start_angle_rad=-math.pi,
    step_rad=2.0 * math.pi / 400,
    range_min_m=0.15,
    range_max_m=12.0,
    resolution_m=0.0005,
    sigma_m=0.003,
    sigma_share=0.003,
    sigma_share_far=0.01,
    faults=_LIDAR_FAULTS,
)

# 682 beams over 4.1847 rad as Robot@Home stores them. Data sheet: 1 mm steps, 1 % to 3 % by range.
HOKUYO_URG_04LX = LidarModel(
    "hokuyo_urg_04lx",
    rate_hz=10.0,
    beams=682,
    start_angle_rad=-0.5 * 4.1847,
    step_rad=4.1847 / 681,
    range_min_m=0.06,
    range_max_m=5.6,
    resolution_m=0.001,
    sigma_m=0.002,
    sigma_share=0.01,
    sigma_share_far=0.03,
    faults=FaultConfig(
        glass_mirror_cos=math.cos(math.radians(8.0)),
        glass_hole_share=0.4,
        dark_range_m=3.0,
        grazing_cos=0.06,
        grazing_hole_share=0.6,
        random_hole_share=0.005,
        edge_burr_share=0.3,
        multipath_share=0.04,
        patch=3,
    ),
)

# 181 beams of 1 degree, 80 m. The mirror rotates at 75 Hz, but a scan has 372 bytes, and the usual serial
# line of 38400 baud transmits 10 scans per second.
SICK_LMS_180 = LidarModel(
    "sick_lms_180",
    rate_hz=10.0,
    beams=181,
    start_angle_rad=-0.5 * math.pi,
    step_rad=math.pi / 180,
    range_min_m=0.05,
    range_max_m=80.0,
    resolution_m=0.01,
    sigma_m=0.005,
    faults=FaultConfig(
        glass_mirror_cos=math.cos(math.radians(10.0)),
        glass_hole_share=0.15,
        grazing_cos=0.03,
        grazing_hole_share=0.5,
        random_hole_share=0.001,
        edge_burr_share=0.15,
        multipath_share=0.02,
    ),
)

# 16 rings 2 degrees apart, 0.2 degrees of azimuth at 10 Hz, 100 m, 3 cm.
VLP_16 = RingLidarModel(
    "vlp_16",
    rate_hz=10.0,
    elevations_rad=tuple(math.radians(angle) for angle in range(-15, 16, 2)),
    azimuths=1800,
    range_min_m=0.4,
    range_max_m=100.0,
    resolution_m=0.002,
    sigma_m=0.03,
    faults=FaultConfig(
        glass_mirror_cos=math.cos(math.radians(8.0)),
        glass_hole_share=0.2,
        dark_range_m=30.0,
        random_hole_share=0.002,
        edge_burr_share=0.15,
        multipath_share=0.02,
        patch=2,
    ),
)

# 64 rings from 2 degrees up to 24.8 down, 120 m, 2 cm; at 10 Hz about 2,000 firings per revolution.
HDL_64E = RingLidarModel(
    "hdl_64e",
    rate_hz=10.0,
    elevations_rad=tuple(math.radians(-24.8 + 26.8 * ring / 63) for ring in range(64)),
    azimuths=1800,
    range_min_m=0.9,
    range_max_m=120.0,
    resolution_m=0.002,
    sigma_m=0.02,
    faults=FaultConfig(random_hole_share=0.01),
)

# PrimeSense light: 580 px and 7.5 cm, disparity in eighths of a pixel, half a step of noise: 1.4 mm at 1 m,
# 17 mm at 3.5 m (Khoshelham & Elberink 2012, Accuracy and Resolution of Kinect Depth Data).
_PRIMESENSE_PX_M, _PRIMESENSE_STEP_PX, _PRIMESENSE_SIGMA_PX = 580.0 * 0.075, 0.125, 0.0625


def _structured_light_faults(shadow_px_m: float, scale: float) -> FaultConfig:
    """Faults of projected infrared dots; patches and reaches shrink with the image."""
    return FaultConfig(
        glass_hole_share=0.5,
        dark_range_m=2.6,
        grazing_cos=0.1,
        grazing_hole_share=0.6,
        backlight_reach=round(32 * scale),
        backlight_hole_share=0.35,
        random_hole_share=0.004,
        edge_burr_share=0.2,
        multipath_share=0.08,
        shadow_focal_baseline_px_m=shadow_px_m,
        patch=round(8 * scale),
    )


# 57 x 43 degrees, 0.8-3.5 m (Li2020).
_KINECT_INTRINSICS = intrinsics_from_fov(640, 480, 57.0, 43.0)
KINECT_V1 = CameraModel(
    "kinect_v1",
    rate_hz=30.0,
    intrinsics=_KINECT_INTRINSICS,
    range_min_m=0.8,
    range_max_m=3.5,
    focal_baseline_px_m=_PRIMESENSE_PX_M,
    disparity_step_px=_PRIMESENSE_STEP_PX,
    disparity_sigma_px=_PRIMESENSE_SIGMA_PX,
    faults=_structured_light_faults(_KINECT_INTRINSICS.fx * 0.075, 1.0),
)

# As stored by Robot@Home: 320 x 240, every second pixel of the device, 10.7 Hz.
XTION_PRO_LIVE = CameraModel(
    "xtion_pro_live",
    rate_hz=10.7,
    intrinsics=CameraIntrinsics(286.441, 271.370, 157.325, 120.080, 320, 240),
    range_min_m=0.8,
    range_max_m=4.0,
    focal_baseline_px_m=_PRIMESENSE_PX_M,
    disparity_step_px=_PRIMESENSE_STEP_PX,
    disparity_sigma_px=_PRIMESENSE_SIGMA_PX,
    faults=_structured_light_faults(286.441 * 0.075, 0.5),
)

# 69 x 42 degrees and square pixels make 16:9. Two infrared cameras 5 cm apart, 425 px of focal length at
# their best resolution, 0.08 px of noise: 15 mm at 2 m, inside the data sheet's 2 %.
_D435I_INTRINSICS = intrinsics_from_fov(640, 360, 69.0, 42.3)
REALSENSE_D435I = CameraModel(
    "realsense_d435i",
    rate_hz=30.0,
    intrinsics=_D435I_INTRINSICS,
    range_min_m=0.3,
    range_max_m=10.0,
    focal_baseline_px_m=425.0 * 0.05,
    disparity_step_px=1.0 / 32.0,
    disparity_sigma_px=0.08,
    faults=FaultConfig(
        glass_hole_share=0.3,
        dark_range_m=12.0,  # stereo needs texture, not much light
        grazing_cos=0.08,
        grazing_hole_share=0.4,
        backlight_reach=16,
        backlight_hole_share=0.15,
        random_hole_share=0.006,
        edge_burr_share=0.4,
        multipath_share=0.05,
        shadow_focal_baseline_px_m=_D435I_INTRINSICS.fx * 0.05,
        patch=8,
    ),
)
