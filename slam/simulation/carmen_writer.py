"""Writes scans and odometry as a CARMEN log (`scans.log`)."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np

from slam.measurements import FloatArray, LaserScan, WheelOdometry

_HALF_TURN_TOLERANCE_RAD = math.radians(5.0)
_PRINTED_M = 0.001  # ranges are written in whole millimetres


class CarmenWriter:
    """One CARMEN log; use it as a context manager.

    A lidar with a field of view of 180 degrees is written as FLASER, with angles from PARAM lines; any other
    as ROBOTLASER1, which contains them. No return is written as the maximum, an invalid reading as 0.
    The stamp of a line is the sensor's; the logger's stamp at its end is the true time since the beginning.

    Parameters
    ----------
    path
        The log to create.
    first_stamp_s
        True time when the drive began.
    """

    def __init__(self, path: Path, first_stamp_s: float) -> None:
        self._file = path.open("w", encoding="ascii", newline="\n", buffering=1 << 18)
        self._first_stamp_s = first_stamp_s
        self._described = False
        self._file.write(
            "# CARMEN Logfile, simulated\n"
            "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"
        )

    def __enter__(self) -> CarmenWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def odometry(self, reading: WheelOdometry, twist: tuple[float, float], true_stamp_s: float) -> None:
        """Write an ODOM line; ``twist`` is speed and angular rate."""
        pose, tail = _pose_text(reading.T_odom_base), self._tail(reading.stamp_s, true_stamp_s)
        self._file.write(f"ODOM {pose} {twist[0]:.6f} {twist[1]:.6f} 0 {tail}\n")

    def scan(self, scan: LaserScan, T_odom_base: gtsam.Pose2, true_stamp_s: float) -> None:
        """Write a scan line; ``T_odom_base`` is the wheel odometry at the scan's stamp."""
        tail = self._tail(scan.stamp_s, true_stamp_s)
        half = is_half_circle(scan)
        if not self._described:
            self._file.writelines(f"{line} {tail}\n" for line in _parameters(scan))
            self._described = True
        ranges = " ".join(map("{:.3f}".format, written_ranges_m(scan).tolist()))
        poses = f"{_pose_text(T_odom_base.compose(scan.T_base_laser))} {_pose_text(T_odom_base)}"
        if half:
            self._file.write(f"FLASER {scan.ranges_m.size} {ranges} {poses} {tail}\n")
            return
        # Single precision, like angles in ROS messages, so that the bag and the log contain the same scan.
        start, step = float(np.float32(scan.start_angle_rad)), float(np.float32(scan.step_rad))
        angles = f"{start:.17g} {step * (scan.ranges_m.size - 1):.17g} {step:.17g}"
        head = f"0 {angles} {scan.range_max_m:.3f} 0.010 0 {scan.ranges_m.size}"
        # No remissions; speeds and safety distances are unknown to the lidar.
        self._file.write(f"ROBOTLASER1 {head} {ranges} 0 {poses} 0 0 0 0 0 {tail}\n")

    def _tail(self, stamp_s: float, true_stamp_s: float) -> str:
        """Return the stamp of the sensor, the host, and the stamp of the logger."""
        return f"{stamp_s:.6f} simulated {true_stamp_s - self._first_stamp_s:.6f}"


def is_half_circle(scan: LaserScan) -> bool:
    """Return whether the beams cover 180 degrees ahead, symmetrically, including both edges."""
    fov = scan.step_rad * (scan.ranges_m.size - 1)
    symmetric = abs(scan.start_angle_rad + 0.5 * fov) < 1e-9
    return symmetric and abs(fov - math.pi) < _HALF_TURN_TOLERANCE_RAD


def written_ranges_m(scan: LaserScan) -> FloatArray:
    """Return the ranges (N,) as CARMEN writes them."""
    ranges = scan.ranges_m.astype(np.float64)
    # A true reading next to the maximum must not be rounded up to mean "no return".
    kept = np.clip(ranges, _PRINTED_M, scan.range_max_m - _PRINTED_M)
    return np.where(np.isnan(ranges), 0.0, np.where(np.isfinite(ranges), kept, scan.range_max_m))


def _parameters(scan: LaserScan) -> list[str]:
    """Return the PARAM lines of the lidar's mounting and field of view."""
    mount = scan.T_base_laser
    fov_deg = math.degrees(scan.step_rad * (scan.ranges_m.size - 1))
    return [
        f"PARAM robot_frontlaser_offset {mount.x():.6f}",
        f"PARAM robot_frontlaser_side_offset {mount.y():.6f}",
        f"PARAM robot_frontlaser_angular_offset {mount.theta():.9f}",
        f"PARAM laser_front_laser_resolution {math.degrees(scan.step_rad):.12g}",
        f"PARAM laser_front_laser_fov {fov_deg:.12g}",
        f"PARAM robot_front_laser_max {scan.range_max_m:.3f}",
    ]


def _pose_text(pose: gtsam.Pose2) -> str:
    """x, y, yaw."""
    return f"{pose.x():.12f} {pose.y():.12f} {pose.theta():.12f}"
