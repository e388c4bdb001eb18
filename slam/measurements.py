"""Measurements of sensors: frozen records, frames after REP-105.

``T_a_b`` maps coordinates in frame b to frame a. Stamps are seconds, lengths metres, angles radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.checks import numbers
from fusion.curves import Intrinsics
from fusion.showing import drawn, shaded, with_pictures
from fusion.showing import one_line as one_line
from slam.errors import ScanweaveError
from slam.later import load_later

# SciPy asks numpy for everything: ten megabytes that neither uses.
load_later("numpy.f2py")
load_later("numpy.testing")

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
AnyFloatArray: TypeAlias = NDArray[np.floating[Any]]
BoolArray: TypeAlias = NDArray[np.bool_]
ColorImage: TypeAlias = NDArray[np.uint8]
Pose: TypeAlias = "gtsam.Pose2 | gtsam.Pose3"


# Standard gravity, the unit of a reading in g (ISO 80000-3).
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
        (N,) ranges in beam order. No return is stored as ``inf``, an invalid reading as ``nan``. In an edited
        map a negative range is a reading that the user removed: the beam is free up to there, but its end
        point is ignored.
    start_angle_rad, step_rad
        Bearing of beam 0 and angle between beams, counter-clockwise, in the laser frame.
    range_max_m
        Range up to which a beam without a return is free.
    T_base_laser
        Pose of the laser on the robot.
    sensor
        Name of the sensor in the log.
    beam_s
        Time between beams; the stamp is that of the first. Below zero if the last beam was measured first;
        zero if the log has no such time.

    Examples
    --------
    A lidar that looks ahead, to the left, back and to the right; nothing is behind it.

    >>> import numpy as np, slam
    >>> ranges_m = np.array([2.0, 1.0, np.inf, 3.0], np.float32)
    >>> scan = slam.LaserScan(0.0, ranges_m, start_angle_rad=0.0, step_rad=np.pi / 2, range_max_m=20.0)
    >>> (scan.points_laser().round(3) + 0.0).tolist()
    [[2.0, 0.0], [0.0, 1.0], [0.0, -3.0]]
    """

    stamp_s: float
    ranges_m: Float32Array
    start_angle_rad: float
    step_rad: float
    range_max_m: float
    T_base_laser: gtsam.Pose2 = field(default_factory=lambda: gtsam.Pose2())
    sensor: str = "laser"
    beam_s: float = field(default=0.0, repr=False)  # is in no saved map

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, drawn(black=self.points_laser(), red=np.zeros((1, 2))))

    def bearings_rad(self) -> FloatArray:
        """Bearing of every beam in the laser frame, (N,).

        Examples
        --------
        >>> import numpy as np, slam
        >>> scan = slam.LaserScan(0.0, np.ones(3), start_angle_rad=-0.5, step_rad=0.5, range_max_m=20.0)
        >>> scan.bearings_rad().tolist()
        [-0.5, 0.0, 0.5]
        """
        return self.start_angle_rad + self.step_rad * np.arange(self.ranges_m.size, dtype=np.float64)

    def points_laser(self) -> FloatArray:
        """(N, 2) points of the beams with a valid return, laser frame.

        Examples
        --------
        >>> import numpy as np, slam
        >>> seen = np.array([1.0, np.nan, np.inf, 25.0], np.float32)  # one hit; invalid, no return, too far
        >>> scan = slam.LaserScan(0.0, seen, start_angle_rad=0.0, step_rad=0.1, range_max_m=20.0)
        >>> scan.points_laser().tolist()
        [[1.0, 0.0]]
        """
        ranges = self.ranges_m.astype(np.float64)
        met = np.isfinite(ranges) & (ranges > 0.0) & (ranges < self.range_max_m)
        bearings = self.bearings_rad()[met]
        return np.column_stack([ranges[met] * np.cos(bearings), ranges[met] * np.sin(bearings)])


@dataclass(frozen=True, slots=True)
class WheelOdometry:
    """The robot's pose from wheel odometry, in the drifting odom frame.

    Examples
    --------
    >>> import gtsam, slam
    >>> slam.WheelOdometry(stamp_s=0.1, T_odom_base=gtsam.Pose2(0.05, 0.0, 0.01))
    WheelOdometry(stamp_s=0.1, T_odom_base=Pose2(0.05, 0, 0.01), sensor='odometry')
    """

    stamp_s: float
    T_odom_base: gtsam.Pose2
    sensor: str = "odometry"

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class CameraIntrinsics(Intrinsics):
    """Intrinsics of a pinhole camera without distortion, in pixels; the centre of pixel (0, 0) is at (0, 0).

    Examples
    --------
    >>> import slam
    >>> lens = slam.CameraIntrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
    >>> x_m, z_m = 0.4, 2.0  # a point 2 m ahead and 0.4 m to the right
    >>> lens.fx * x_m / z_m + lens.cx  # its column
    424.5
    """

    width: int
    height: int


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One colour image and the depth image registered to it.

    Attributes
    ----------
    stamp_s
        Time of the frame.
    color
        (H, W, 3) RGB.
    depth_m
        (H, W) distance along the optical axis, 0 for an invalid reading.
    intrinsics
        Intrinsics of both images.
    T_base_camera
        Pose of the optical frame on the robot: z forward, x right, y down in the image. None if the log
        does not contain it.
    sensor
        Name of the camera in the log.

    Examples
    --------
    >>> import gtsam, numpy as np, slam
    >>> lens = slam.CameraIntrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
    >>> color, depth_m = np.zeros((480, 640, 3), np.uint8), np.full((480, 640), 2.0, np.float32)
    >>> ahead = gtsam.Rot3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))  # optical axes to the robot's
    >>> frame = slam.RgbdFrame(0.0, color, depth_m, lens, gtsam.Pose3(ahead, np.array([0.1, 0.0, 0.4])))
    >>> frame.T_base_camera.transformFrom(np.array([0.0, 0.0, 2.0])).round(3).tolist()  # 2 m before it
    [2.1, 0.0, 0.4]
    """

    stamp_s: float
    color: ColorImage
    depth_m: Float32Array
    intrinsics: CameraIntrinsics
    T_base_camera: gtsam.Pose3 | None = None
    sensor: str = "camera"

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, shaded(self.color), shaded(self.depth_m))


@dataclass(frozen=True, slots=True)
class PointCloud:
    """One revolution of a 3D lidar.

    Attributes
    ----------
    stamp_s
        Time of the cloud, as stamped by the sensor.
    points_lidar
        (N, 3) finite points, lidar frame.
    times_s
        (N,) time of each point relative to ``stamp_s``, negative before it; None if the log has none.
    T_base_lidar
        Pose of the lidar on the robot.
    sensor
        Name of the sensor in the log.
    intensities
        (N,) intensity of the return of each point, in the sensor's own units; None if the log has none.

    Examples
    --------
    >>> import gtsam, numpy as np, slam
    >>> points = np.array([[5.0, 0.0, -1.0], [0.0, 4.0, 0.5]], np.float32)
    >>> mounting = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 1.2]))
    >>> slam.PointCloud(0.0, points, times_s=np.array([0.0, 0.05]), T_base_lidar=mounting).points_lidar.shape
    (2, 3)
    """

    stamp_s: float
    points_lidar: Float32Array
    times_s: FloatArray | None = None
    T_base_lidar: gtsam.Pose3 = field(default_factory=lambda: gtsam.Pose3())
    sensor: str = "lidar"
    intensities: Float32Array | None = None

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, drawn(black=self.points_lidar[:, :2], red=np.zeros((1, 2))))


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One reading of an inertial measurement unit (IMU), in its own frame.

    Attributes
    ----------
    stamp_s
        Time of the reading, as stamped by the sensor.
    gyro_rad_s
        (3,) angular rate.
    specific_force_m_s2
        (3,) from the accelerometer: at rest the reaction to gravity, 9.8 upward. Zeros if it has none.
    T_base_imu
        Pose of the IMU on the robot; None if the log does not contain it.
    sensor
        Name of the sensor in the log.

    Examples
    --------
    >>> import numpy as np, slam
    >>> at_rest = slam.ImuReading(0.0, gyro_rad_s=np.zeros(3), specific_force_m_s2=np.array([0.0, 0.0, 9.81]))
    >>> at_rest.specific_force_m_s2.tolist()  # the reaction to gravity points up
    [0.0, 0.0, 9.81]
    """

    stamp_s: float
    gyro_rad_s: FloatArray
    specific_force_m_s2: FloatArray
    T_base_imu: gtsam.Pose3 | None = None
    sensor: str = "imu"

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class GnssFix:
    """Position of the antenna from a GNSS receiver, on the ellipsoid WGS 84.

    Attributes
    ----------
    stamp_s
        Time of the fix, as stamped by the sensor.
    latitude_deg, longitude_deg, altitude_m
        Positive north, positive east, and height above the ellipsoid.
    covariance_m2
        (3, 3) covariance of east, north, up; None if the receiver does not report it.
    antenna_m
        (3,) position of the antenna on the robot; None if the log does not contain it.
    sensor
        Name of the sensor in the log.

    Examples
    --------
    >>> import numpy as np, slam
    >>> fix = slam.GnssFix(0.0, 49.0, 8.4, 116.0, np.diag([4.0, 4.0, 9.0]), np.array([0.3, 0.0, 1.2]))
    >>> np.sqrt(np.diag(fix.covariance_m2)).tolist()  # east, north, up, metres
    [2.0, 2.0, 3.0]
    """

    stamp_s: float
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance_m2: FloatArray | None = None
    antenna_m: FloatArray | None = None
    sensor: str = "gnss"

    __repr__ = one_line


def numbers_of(
    value: Any, shape: tuple[int | None, ...], name: str, error: type[ScanweaveError] = ScanweaveError
) -> FloatArray:
    """Return finite numbers that a caller gave, see `fusion.checks.numbers`, or raise an error of a type."""
    try:
        return np.asarray(numbers(value, shape, name), np.float64)
    except ValueError as fault:
        raise error(str(fault)) from None


Measurement: TypeAlias = LaserScan | WheelOdometry | RgbdFrame | PointCloud | ImuReading | GnssFix


def pose2_from_row(row: Sequence[float] | FloatArray) -> gtsam.Pose2:
    """Create a Pose2 from x, y, yaw."""
    return gtsam.Pose2(float(row[0]), float(row[1]), float(row[2]))


def row_from_pose2(pose: Pose) -> FloatArray:
    """Return x, y, yaw of a Pose2, (3,)."""
    assert isinstance(pose, gtsam.Pose2)
    return np.array([pose.x(), pose.y(), pose.theta()])


def spatial(pose: Pose) -> gtsam.Pose3:
    """Return a 3D pose; a planar pose is placed at z = 0."""
    return pose if isinstance(pose, gtsam.Pose3) else gtsam.Pose3(pose)


def planar(pose: Pose) -> gtsam.Pose2:
    """Return a planar pose: x, y and yaw of a 3D pose."""
    if isinstance(pose, gtsam.Pose2):
        return pose
    return gtsam.Pose2(pose.x(), pose.y(), pose.rotation().yaw())


def row_from_pose(pose: Pose) -> list[float]:
    """Return x, y, z and the quaternion x, y, z, w of a pose."""
    turn: Any = spatial(pose).rotation().toQuaternion()
    return [*spatial(pose).translation().tolist(), turn.x(), turn.y(), turn.z(), turn.w()]


def composed(one: Pose, other: Pose) -> Pose:
    """Compose two poses, both planar or both 3D; GTSAM has no common type for them."""
    return one.compose(other)  # type: ignore[arg-type]


def motion_between(one: Pose, other: Pose) -> Pose:
    """Return the pose of the other in the frame of the first."""
    return one.between(other)  # type: ignore[arg-type]


def logarithm(step: Pose) -> FloatArray:
    """Return the (d,) tangent vector of a motion."""
    return gtsam.Pose2.Logmap(step) if isinstance(step, gtsam.Pose2) else gtsam.Pose3.Logmap(step)
