"""Statistics of the readings of one sensor, specific to each type of sensor."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np

from slam.datasets.dataset import Thinned
from slam.earth import TangentPlane
from slam.measurements import FloatArray, GnssFix, ImuReading, LaserScan, PointCloud, RgbdFrame, WheelOdometry
from slam.vision.camera_frame import T_BODY_CAMERA

_EVERY_PIXEL = 4  # along rows and columns: 19200 pixels of 640 x 480 are enough for the fractions


class Figures(Protocol):
    """Running statistics of one sensor, created with its first reading."""

    def add(self, reading: Any) -> None:
        """Add a reading, also the first one."""

    def facts(self) -> dict[str, Any]:
        """The statistics as plain values."""


@dataclass(slots=True)
class ScanFigures:
    """Statistics of a 2D lidar."""

    last: LaserScan
    beams: Counter[str] = field(default_factory=Counter)
    beams_min: float = math.inf
    beams_max: int = 0
    longest_return_m: float | None = None

    def add(self, scan: LaserScan) -> None:
        """Count beams, returns, and beams without return."""
        ranges = scan.ranges_m
        returns = ranges[np.isfinite(ranges)]
        self.beams.update(
            all=ranges.size,
            invalid=int(np.count_nonzero(np.isnan(ranges))),
            no_return=int(np.count_nonzero(np.isinf(ranges))),
        )
        if returns.size:
            self.longest_return_m = max(self.longest_return_m or 0.0, float(returns.max()))
        self.beams_min = min(self.beams_min, ranges.size)
        self.beams_max = max(self.beams_max, ranges.size)
        self.last = scan

    def facts(self) -> dict[str, Any]:
        """Bearings of the latest scan in the laser frame, fractions of all beams, pose of the laser."""
        scan = self.last
        return {
            "beams_min": self.beams_min,
            "beams_max": self.beams_max,
            "first_angle_rad": scan.start_angle_rad,
            "last_angle_rad": scan.start_angle_rad + scan.step_rad * (scan.ranges_m.size - 1),
            "step_rad": scan.step_rad,
            "range_max_m": scan.range_max_m,
            "longest_return_m": self.longest_return_m,
            "no_return_share": self.beams["no_return"] / self.beams["all"],
            "invalid_share": self.beams["invalid"] / self.beams["all"],
            "mount_x_m": scan.T_base_laser.x(),
            "mount_y_m": scan.T_base_laser.y(),
            "mount_yaw_rad": scan.T_base_laser.theta(),
        }


@dataclass(slots=True)
class WheelFigures:
    """Statistics of wheel odometry."""

    last: WheelOdometry
    path_m: float = 0.0
    rotation_rad: float = 0.0

    def add(self, reading: WheelOdometry) -> None:
        """Add up path length and absolute rotation."""
        step = self.last.T_odom_base.between(reading.T_odom_base)
        self.path_m += math.hypot(step.x(), step.y())
        self.rotation_rad += abs(step.theta())
        self.last = reading

    def facts(self) -> dict[str, Any]:
        """Path length and rotation."""
        return {"path_m": self.path_m, "rotation_rad": self.rotation_rad}


@dataclass(slots=True)
class CameraFigures:
    """Statistics of an RGB-D camera."""

    last: RgbdFrame
    pixels: int = 0
    valid: int = 0
    nearest_m: float = math.inf
    farthest_m: float = 0.0

    def add(self, frame: RgbdFrame) -> None:
        """Add the depths of a sample of the pixels."""
        sample = frame.depth_m[::_EVERY_PIXEL, ::_EVERY_PIXEL]
        depths = sample[sample > 0.0]
        self.pixels += sample.size
        self.valid += depths.size
        if depths.size:
            self.nearest_m = min(self.nearest_m, float(depths.min()))
            self.farthest_m = max(self.farthest_m, float(depths.max()))
        self.last = frame

    def facts(self) -> dict[str, Any]:
        """Intrinsics and pose of the latest frame, depths of all frames.

        The pose is that of a body frame with x forward and the image upright.
        """
        lens, mount = self.last.intrinsics, self.last.T_base_camera
        return {
            **{name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
            "valid_depth_share": self.valid / self.pixels,
            "depth_min_m": self.nearest_m if self.valid else None,
            "depth_max_m": self.farthest_m if self.valid else None,
            **_mounting(None if mount is None else mount.compose(T_BODY_CAMERA.inverse())),
        }


@dataclass(slots=True)
class CloudFigures:
    """Statistics of a 3D lidar."""

    last: PointCloud
    points_min: float = math.inf
    points_max: int = 0
    nearest_m: float = math.inf
    farthest_m: float = 0.0
    turn_s: float | None = None

    def add(self, cloud: PointCloud) -> None:
        """Add points, ranges and times."""
        count = len(cloud.points_lidar)
        self.points_min = min(self.points_min, count)
        self.points_max = max(self.points_max, count)
        if count:
            ranges_m = np.linalg.norm(cloud.points_lidar, axis=1)
            self.nearest_m = min(self.nearest_m, float(ranges_m.min()))
            self.farthest_m = max(self.farthest_m, float(ranges_m.max()))
        if cloud.times_s is not None and cloud.times_s.size:
            self.turn_s = max(self.turn_s or 0.0, float(np.ptp(cloud.times_s)))
        self.last = cloud

    def facts(self) -> dict[str, Any]:
        """Points per cloud, ranges from the lidar, longest revolution, pose of the lidar."""
        return {
            "points_min": self.points_min,
            "points_max": self.points_max,
            "nearest_m": self.nearest_m if self.points_max else 0.0,
            "farthest_m": self.farthest_m,
            "turn_s": self.turn_s,
            **_mounting(self.last.T_base_lidar),
        }


@dataclass(slots=True)
class ImuFigures:
    """Statistics of an IMU."""

    last: ImuReading
    count: int = 0
    force_sum: FloatArray = field(default_factory=lambda: np.zeros(3))
    greatest_gyro_rad_s: float = 0.0
    greatest_force_m_s2: float = 0.0

    def add(self, reading: ImuReading) -> None:
        """Update the mean specific force and the largest readings of an axis."""
        self.count += 1
        self.force_sum = self.force_sum + reading.specific_force_m_s2
        self.greatest_gyro_rad_s = max(self.greatest_gyro_rad_s, float(np.abs(reading.gyro_rad_s).max()))
        force_m_s2 = float(np.abs(reading.specific_force_m_s2).max())
        self.greatest_force_m_s2 = max(self.greatest_force_m_s2, force_m_s2)
        self.last = reading

    def facts(self) -> dict[str, Any]:
        """Both in the IMU frame, and the pose of the IMU."""
        return {
            "mean_force_m_s2": (self.force_sum / self.count).tolist(),
            "greatest_gyro_rad_s": self.greatest_gyro_rad_s,
            "greatest_force_m_s2": self.greatest_force_m_s2,
            **_mounting(self.last.T_base_imu),
        }


@dataclass(slots=True)
class GnssFigures:
    """Statistics of a GNSS receiver."""

    last: GnssFix
    plane: TangentPlane | None = None
    farthest_m: float = 0.0
    sigmas_m: Thinned = field(default_factory=Thinned)

    def add(self, fix: GnssFix) -> None:
        """Update the distance from the first fix, and the horizontal sigma."""
        place = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
        self.plane = self.plane or TangentPlane(*place)
        self.farthest_m = max(self.farthest_m, float(np.hypot(*self.plane.enu_m(*place)[:2])))
        if fix.covariance_m2 is not None:
            self.sigmas_m.add(math.sqrt(0.5 * float(np.trace(fix.covariance_m2[:2, :2]))))
        self.last = fix

    def facts(self) -> dict[str, Any]:
        """The first position, the distance of the others from it, the median horizontal sigma."""
        plane, antenna_m = self.plane, self.last.antenna_m
        return {
            "first": plane and [plane.latitude_deg, plane.longitude_deg, plane.altitude_m],
            "farthest_m": self.farthest_m,
            "median_sigma_m": self.sigmas_m.median(),
            "antenna_m": None if antenna_m is None else antenna_m.tolist(),
        }


# For each type of readings: the name of the statistics, and the class that computes them.
KINDS: dict[type, tuple[str, Callable[[Any], Figures]]] = {
    LaserScan: ("laser", ScanFigures),
    WheelOdometry: ("odometry", WheelFigures),
    RgbdFrame: ("camera", CameraFigures),
    PointCloud: ("cloud", CloudFigures),
    ImuReading: ("imu", ImuFigures),
    GnssFix: ("gnss", GnssFigures),
}


def _mounting(pose: gtsam.Pose3 | None) -> dict[str, Any]:
    """Position, roll, pitch and yaw on the robot; None if the log does not contain them."""
    return {
        "mount_m": None if pose is None else pose.translation().tolist(),
        "mount_rpy_rad": None if pose is None else pose.rotation().rpy().tolist(),
    }
