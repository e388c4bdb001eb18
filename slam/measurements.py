"""What sensors say and what is concluded from it: frozen records, frames after REP-105.

``T_a_b`` maps coordinates in frame b to frame a. Stamps are seconds, lengths metres, angles radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
AnyFloatArray: TypeAlias = NDArray[np.floating[Any]]
BoolArray: TypeAlias = NDArray[np.bool_]
ColorImage: TypeAlias = NDArray[np.uint8]
Pose: TypeAlias = "gtsam.Pose2 | gtsam.Pose3"


def one_line(record: Any) -> str:
    """A dataclass in one line, as the ``__repr__`` of those that hold arrays: arrays by type and shape."""
    shown = (f"{item.name}={_shown(getattr(record, item.name))}" for item in fields(record) if item.repr)
    return f"{type(record).__name__}({', '.join(shown)})"


def _shown(value: Any) -> str:
    """A field in `one_line`; what is long by its type and size."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, list | tuple):
        return f"{type(value).__name__}[{len(value)}]"
    if isinstance(value, gtsam.Pose2):
        return f"Pose2({value.x():.6g}, {value.y():.6g}, {value.theta():.6g})"
    if isinstance(value, gtsam.Pose3):
        x, y, z = value.translation()
        roll, pitch, yaw = value.rotation().rpy()
        return f"Pose3(xyz=({x:.6g}, {y:.6g}, {z:.6g}), rpy=({roll:.6g}, {pitch:.6g}, {yaw:.6g}))"
    return repr(value.item() if isinstance(value, np.generic) else value)


# Standard gravity, by which a reading in g is told (ISO 80000-3).
GRAVITY_M_S2 = 9.80665
# x, y and yaw in GTSAM's order of a tangent in space: roll, pitch, yaw, x, y, z.
IN_PLANE = [3, 4, 2]


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One sweep of a 2D lidar.

    Attributes
    ----------
    stamp_s
        Time of the sweep.
    ranges_m
        (N,) ranges in beam order. No return is stored as ``inf``, an invalid reading as ``nan``. In a map
        that a person has edited a negative range is a reading that was taken away: the beam was free up to
        there, and what it met counts no more.
    start_angle_rad, step_rad
        Bearing of beam 0 and the increment between beams, counter-clockwise, in the laser frame.
    range_max_m
        Range up to which a beam without a return is known to have met nothing.
    T_base_laser
        Mounting of the laser on the robot.
    sensor
        Name of the sensor, as the log tells it.
    """

    stamp_s: float
    ranges_m: Float32Array
    start_angle_rad: float
    step_rad: float
    range_max_m: float
    T_base_laser: gtsam.Pose2 = field(default_factory=lambda: gtsam.Pose2())
    sensor: str = "laser"

    __repr__ = one_line

    def bearings_rad(self) -> FloatArray:
        """Bearing of every beam in the laser frame, (N,)."""
        return self.start_angle_rad + self.step_rad * np.arange(self.ranges_m.size, dtype=np.float64)

    def points_laser(self) -> FloatArray:
        """(N, 2) points of the beams that met something, laser frame."""
        ranges = self.ranges_m.astype(np.float64)
        met = np.isfinite(ranges) & (ranges > 0.0) & (ranges < self.range_max_m)
        bearings = self.bearings_rad()[met]
        return np.column_stack([ranges[met] * np.cos(bearings), ranges[met] * np.sin(bearings)])


@dataclass(frozen=True, slots=True)
class WheelOdometry:
    """The robot's pose by its own wheels, in the drifting odom frame."""

    stamp_s: float
    T_odom_base: gtsam.Pose2
    sensor: str = "odometry"

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """A pin-hole camera without lens distortion, in pixels; pixel (0, 0) has its centre at (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One colour image with the depth image registered to it.

    Attributes
    ----------
    stamp_s
        Time of the frame.
    color
        (H, W, 3) RGB.
    depth_m
        (H, W) distance along the optical axis, 0 where the reading is invalid.
    intrinsics
        Of both images.
    T_base_camera
        Mounting of the optical frame on the robot: z forward, x right, y down in the image. None where the
        log does not tell it.
    sensor
        Name of the camera, as the log tells it.
    """

    stamp_s: float
    color: ColorImage
    depth_m: Float32Array
    intrinsics: CameraIntrinsics
    T_base_camera: gtsam.Pose3 | None = None
    sensor: str = "camera"

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class PointCloud:
    """One turn of a 3D lidar.

    Attributes
    ----------
    stamp_s
        Time of the cloud, as the sensor stamps it.
    points_lidar
        (N, 3) finite points, lidar frame.
    times_s
        (N,) time of each point after ``stamp_s``, below zero before it; None where the log does not tell it.
    T_base_lidar
        Mounting of the lidar on the robot.
    sensor
        Name of the sensor, as the log tells it.
    """

    stamp_s: float
    points_lidar: Float32Array
    times_s: FloatArray | None = None
    T_base_lidar: gtsam.Pose3 = field(default_factory=lambda: gtsam.Pose3())
    sensor: str = "lidar"

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class ImuReading:
    """What an inertial measurement unit (IMU) says at an instant, in its own frame.

    Attributes
    ----------
    stamp_s
        Time of the reading, as the sensor stamps it.
    gyro_rad_s
        (3,) turn rate.
    specific_force_m_s2
        (3,) by the accelerometer: at rest the reaction to gravity, 9.8 upward.
    T_base_imu
        Mounting of the IMU on the robot; None where the log does not tell it.
    sensor
        Name of the sensor, as the log tells it.
    """

    stamp_s: float
    gyro_rad_s: FloatArray
    specific_force_m_s2: FloatArray
    T_base_imu: gtsam.Pose3 | None = None
    sensor: str = "imu"

    __repr__ = one_line


Measurement: TypeAlias = LaserScan | WheelOdometry | RgbdFrame | PointCloud | ImuReading


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """A measured motion between two base frames, with its own trust.

    Attributes
    ----------
    T_reference_base
        Pose of the current base frame in the reference frame, Pose2 or Pose3.
    covariance
        (d, d) covariance in GTSAM's tangent order of the current frame: Pose2 (x, y, theta).
        A degenerate direction is already inflated.
    inlier_share
        Share of the used readings that agree with the result, 0..1.
    fit
        Mean robust weight of the used readings, 0..1: falls with every millimetre.
    residual_m
        Robust standard deviation of the agreeing readings.
    converged
        Whether the iteration settled; of a cloud, also where as many of its points fit as usual.
    degenerate
        Whether a direction of motion is not determined by the readings (a corridor).
    weak_direction
        (d,) unit tangent vector of the undetermined direction; zero where all are determined.
    """

    T_reference_base: Pose
    covariance: FloatArray
    inlier_share: float
    fit: float
    residual_m: float
    converged: bool
    degenerate: bool
    weak_direction: FloatArray

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time, in the order of the log (which need not be the order of the stamps).

    Attributes
    ----------
    stamps_s
        (N,) seconds.
    positions_m
        (N, 3) of the base frame in the map frame.
    quaternions_xyzw
        (N, 4), unit length.
    """

    stamps_s: FloatArray
    positions_m: FloatArray
    quaternions_xyzw: FloatArray

    __repr__ = one_line

    def __len__(self) -> int:
        return int(self.stamps_s.size)

    def __getitem__(self, chosen: slice | NDArray[Any]) -> Trajectory:
        return Trajectory(self.stamps_s[chosen], self.positions_m[chosen], self.quaternions_xyzw[chosen])

    @classmethod
    def from_planar(cls, stamps_s: FloatArray, poses_xyt: FloatArray) -> Trajectory:
        """Lift (N, 3) rows of x, y, yaw into the plane z = 0."""
        count = len(stamps_s)
        positions = np.zeros((count, 3))
        positions[:, :2] = poses_xyt[:, :2]
        quaternions = np.zeros((count, 4))
        quaternions[:, 2] = np.sin(0.5 * poses_xyt[:, 2])
        quaternions[:, 3] = np.cos(0.5 * poses_xyt[:, 2])
        return cls(np.asarray(stamps_s, dtype=np.float64), positions, quaternions)

    def poses(self) -> list[gtsam.Pose3]:
        """The N poses."""
        return [
            gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), position)
            for (x, y, z, w), position in zip(self.quaternions_xyzw.tolist(), self.positions_m, strict=True)
        ]

    def to_planar(self) -> FloatArray:
        """(N, 3) rows of x, y, yaw: the projection onto the ground plane."""
        x, y, z, w = self.quaternions_xyzw.T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return np.column_stack([self.positions_m[:, :2], yaw])


def pose2_from_row(row: Sequence[float] | FloatArray) -> gtsam.Pose2:
    """A Pose2 from x, y, yaw."""
    return gtsam.Pose2(float(row[0]), float(row[1]), float(row[2]))


def row_from_pose2(pose: Pose) -> FloatArray:
    """x, y, yaw of a Pose2, (3,)."""
    assert isinstance(pose, gtsam.Pose2)
    return np.array([pose.x(), pose.y(), pose.theta()])


def spatial(pose: Pose) -> gtsam.Pose3:
    """A pose in space; one of the plane at z = 0."""
    return pose if isinstance(pose, gtsam.Pose3) else gtsam.Pose3(pose)
