"""The robot of Robot@Home, common to both layouts of the dataset.

Ruiz-Sarmiento et al. 2017, "Robot@Home, a robotic dataset for semantic mapping of home environments".
"""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import STAMP_LIMIT_S, RecordFault
from slam.datasets.frame_pairs import FramePair
from slam.datasets.laser_geometry import NO_VALID_RANGE, RepeatedRange, classify_ranges
from slam.measurements import CameraIntrinsics, FloatArray, LaserScan
from slam.vision.camera_frame import T_BODY_CAMERA

LASER = "HOKUYO1"
BAD_TIME = "observation without a time of this age"
BAD_SCAN = "scan with inconsistent values"

T_BASE_LASER = gtsam.Pose2(0.205, 0.0, 0.0)
# x, y, z of the optical centres and the yaw of their axes; the cameras are rotated by 90 degrees.
_CAMERAS = {
    "RGBD_1": ((0.271, -0.031, 1.045), -45.0),
    "RGBD_2": ((0.240, -0.045, 1.045), -90.0),
    "RGBD_3": ((0.271, 0.031, 1.045), 45.0),
    "RGBD_4": ((0.285, 0.000, 1.045), 0.0),
}
# Intrinsics of the stored 320 x 240 images: fx 286.441, fy 271.370, cx 157.325, cy 120.080. Rotated
# counter-clockwise, the pixel (u, v) goes to (v, 319 - u).
_UPRIGHT = CameraIntrinsics(271.370, 286.441, 120.080, 319.0 - 157.325, 240, 320)
_QUARTER_TURNS = 1
_DEPTH_STEPS_PER_M = 6553.5
_TICKS_PER_S = 10_000_000
_EPOCH_S = 11644473600  # from 1601 to 1970


def camera(sensor: str, pairs: list[FramePair]) -> Camera:
    """A camera with upright images; the mounting is unknown for other camera names."""
    mount = None
    if sensor in _CAMERAS:
        position_m, yaw_deg = _CAMERAS[sensor]
        turned = gtsam.Rot3.Yaw(math.radians(yaw_deg)).compose(T_BODY_CAMERA.rotation())
        mount = gtsam.Pose3(turned, np.array(position_m))
    return Camera(sensor, pairs, Calibration(_UPRIGHT, _DEPTH_STEPS_PER_M, (), mount), _QUARTER_TURNS)


def unix_stamp_s(ticks: Any) -> float:
    """Return seconds since 1970 of 100 ns ticks since 1601; RecordFault if that is no time."""
    try:
        seconds, rest = divmod(int(ticks), _TICKS_PER_S)
    except (TypeError, ValueError):
        seconds, rest = 0, 0
    if not 0 <= seconds - _EPOCH_S < STAMP_LIMIT_S:
        raise RecordFault(BAD_TIME, f"{str(ticks)[:24]} ticks")
    return (seconds - _EPOCH_S) + rest / _TICKS_PER_S


def laser_scan(
    stamp_s: float,
    ranges_m: FloatArray,
    valid: FloatArray,
    aperture_rad: float,
    max_m: float,
    account: Account,
) -> LaserScan:
    """A scan whose beams cover the aperture including both edges, starting at the right.

    Parameters
    ----------
    ranges_m, valid
        (N,) readings and flags, 0 for no reading.

    Raises
    ------
    RecordFault
        The counts differ, the aperture or maximum is wrong, or no reading is valid.
    """
    if ranges_m.size < 2 or ranges_m.size != valid.size:
        raise RecordFault(BAD_SCAN, f"{ranges_m.size} ranges, {valid.size} flags")
    if not (0.0 < aperture_rad <= 2.0 * math.pi + 1e-6 and 0.0 < max_m < math.inf):
        raise RecordFault(BAD_SCAN, f"aperture {aperture_rad} rad, maximum {max_m} m")
    clean, max_m = classify_ranges(ranges_m, max_m, RepeatedRange())
    clean[(valid == 0.0) & np.isfinite(clean)] = np.nan
    invalid = int(np.count_nonzero(np.isnan(clean)))
    if invalid == clean.size:
        raise RecordFault(NO_VALID_RANGE, f"{invalid} beams")
    step_rad = aperture_rad / (ranges_m.size - 1)
    return LaserScan(stamp_s, clean, -0.5 * aperture_rad, step_rad, max_m, T_BASE_LASER, LASER)
