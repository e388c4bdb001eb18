"""IMU as support for a 3D lidar: it deskews clouds, predicts poses, and bridges gaps in the matching."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np

from fusion.estimation import FEWEST, gate
from fusion.kernel import kernel
from slam.matching.cloud_points import SLICES
from slam.matching.upright import Gravity
from slam.measurements import GRAVITY_M_S2, FloatArray, ImuReading, PointCloud
from slam.odometry.imu_readings import FORCE_WALK, ImuReadings
from slam.odometry.imu_smoother import FORCE_BIAS_M_S2, ImuSmoother, ImuSpread, ImuState

# Poses over this time determine velocity and gravity; without a pose for as long, readings continue.
_BEGIN_S, _LEAST_POSES = 1.0, 4
# Sigmas of the first guess: velocity in m/s, gravity in radians.
_GUESS = ImuSpread.of_guess(0.5, 0.1)
# If rotations of lidar and gyroscope differ by more than this plus a share of the rotation, one such step may
# be a bad match; most of them mean a wrong mounting or clock.
_APART_RAD, _APART_SHARE = 0.02, 0.1


class UnfitImuError(Exception):
    """The IMU contradicts the lidar; the arguments are its name, the reason, and its calibration."""


class ImuTracker:
    """State of one IMU beside the tracker of a lidar; the first poses determine it.

    Attributes
    ----------
    bridged_s
        Time bridged by readings alone.
    """

    def __init__(self) -> None:
        self.bridged_s = 0.0
        self._states = 0
        self._sensor = ""
        self._readings = ImuReadings()
        self._parameters: gtsam.PreintegrationCombinedParams | None = None
        self._smoother: ImuSmoother | None = None
        self._poses: list[tuple[float, gtsam.Pose3, FloatArray]] = []
        self._agree: deque[bool] = deque(maxlen=2 * FEWEST)
        self._interval: tuple[ImuState, float, gtsam.PreintegratedCombinedMeasurements] | None = None

    def add(self, reading: ImuReading) -> None:
        """Add the next reading."""
        self._sensor = reading.sensor
        if self._readings.add(reading):
            self._lose()
        self._interval = None

    @property
    def state(self) -> ImuState | None:
        """Return the newest state, once velocity and gravity are known."""
        return None if self._smoother is None else self._smoother.state

    def due_s(self) -> float | None:
        """Return a stamp up to which readings alone must continue without a cloud; None if not needed."""
        state, newest_s = self.state, self._readings.newest_s
        return None if state is None or newest_s - state.stamp_s <= _BEGIN_S else newest_s - 0.5 * _BEGIN_S

    def predicted(self, stamp_s: float) -> gtsam.Pose3 | None:
        """Predict ``T_odom_base`` at a stamp after the newest state; None if the readings do not suffice."""
        return None if self._readings.weightless else self._carried(stamp_s)

    def turned(self, stamp_s: float) -> gtsam.Rot3 | None:
        """Predict the rotation of `predicted`, which needs no forces, and no state before there is one."""
        if self._poses and self._readings.covers(self._poses[-1][0], stamp_s):
            last_s, last, _ = self._poses[-1]
            turn = gtsam.Rot3(self._readings.turns(np.array([stamp_s]), last_s, np.zeros(3))[0])
            return last.rotation().compose(turn).compose(self._readings.T_base_imu.rotation().inverse())
        pose = self._carried(stamp_s)
        return None if pose is None else pose.rotation()

    def turned_between(self, begin_s: float, end_s: float) -> gtsam.Rot3 | None:
        """Return the rotation of the base from one stamp to a later one; None if readings do not cover it."""
        if not self._readings.covers(begin_s, end_s):
            return None
        bias = np.zeros(3) if self.state is None else np.asarray(self.state.bias.gyroscope())
        turn = gtsam.Rot3(self._readings.turns(np.array([end_s]), begin_s, bias)[0])
        mounting = self._readings.T_base_imu.rotation()
        return mounting.compose(turn).compose(mounting.inverse())

    def _carried(self, stamp_s: float) -> gtsam.Pose3 | None:
        """Return the newest state, carried on by the readings up to a stamp."""
        state = self.state
        if state is None or stamp_s <= state.stamp_s or not self._readings.covers(state.stamp_s, stamp_s):
            return None
        pose = state.carried(self._integrated(state, stamp_s))[0]
        return pose.compose(self._readings.T_base_imu.inverse())

    def straightened(self, cloud: PointCloud, twist: FloatArray) -> PointCloud:
        """Deskew a revolution to its stamp: rotated by the gyroscope, translated by velocity and force.

        Unchanged if the readings do not cover it. Only rotated, with its times, if the IMU does not know its
        velocity: that is known better after the match.

        Parameters
        ----------
        twist
            (6,) twist of the base from previous clouds.
        """
        if cloud.times_s is None:
            return cloud
        first_s, last_s = float(cloud.times_s.min()), float(cloud.times_s.max())
        if not self._readings.covers(cloud.stamp_s + first_s, cloud.stamp_s + last_s):
            return cloud
        T_imu_base = self._readings.T_base_imu.inverse()
        mean = self._readings.mean(cloud.stamp_s + first_s, cloud.stamp_s + last_s)
        state, there, left_s = self.state, T_imu_base.AdjointMap(), None
        bias = np.zeros(3) if state is None else np.asarray(state.bias.gyroscope())
        # In its own frame, the velocity of the robot hardly changes.
        velocity, acceleration = there[3:, :3] @ twist[:3], np.cross(mean[:3] - bias, there[3:] @ twist)
        known = state is not None and self._readings.covers(state.stamp_s, cloud.stamp_s)
        if state is None or not known or self._readings.weightless:
            left_s = cloud.times_s
        else:
            pose, moving = state.carried(self._integrated(state, cloud.stamp_s))
            velocity = np.asarray(pose.rotation().unrotate(moving))
            weight = GRAVITY_M_S2 * pose.rotation().unrotate(state.down)
            acceleration = mean[3:] - state.bias.accelerometer() + weight
        edges_s = np.linspace(first_s, last_s, SLICES + 1)
        turns = self._readings.turns(cloud.stamp_s + edges_s, cloud.stamp_s, bias)
        T_imu_lidar = T_imu_base.compose(cloud.T_base_lidar)
        mounting, lever = T_imu_lidar.rotation().matrix(), T_imu_lidar.translation()
        # Composed with the mounting, so that each point is transformed once.
        moved = (turns @ lever - lever) @ mounting
        poses = np.concatenate([mounting.T @ turns @ mounting, moved[:, :, None]], axis=2)
        slopes = np.stack([velocity, 0.5 * acceleration]) @ mounting
        points = np.empty((len(cloud.points_lidar), 3), np.float32)
        per_slice_s = (last_s - first_s) / SLICES
        times_s = np.asarray(cloud.times_s, dtype=np.float64)
        _turned(cloud.points_lidar, times_s, first_s, per_slice_s, poses, slopes, points)
        return replace(cloud, points_lidar=points, times_s=left_s)

    def took(
        self,
        stamp_s: float,
        pose: gtsam.Pose3,
        covariance: FloatArray | None,
        step: tuple[gtsam.Pose3, FloatArray] | None = None,
    ) -> None:
        """Add a pose measured by the lidar.

        Parameters
        ----------
        pose, covariance
            ``T_odom_base``, (6, 6) in its tangent; no covariance if it was not measured.
        step
            Motion since the newest state by the wheels, with its covariance (6, 6).

        Raises
        ------
        UnfitImuError
            If its rotations or forces contradict the measured path.
        """
        T_base_imu = self._readings.T_base_imu
        pose, there = pose.compose(T_base_imu), T_base_imu.inverse().AdjointMap()
        if covariance is not None:
            covariance = there @ covariance @ there.T
        if step is not None:
            moved = T_base_imu.inverse().compose(step[0]).compose(T_base_imu)
            step = moved, there @ step[1] @ there.T
        if self._smoother is None:
            self._begin(stamp_s, pose, covariance)
        else:
            self._advance(self._smoother, stamp_s, pose, covariance, step)

    def _advance(
        self,
        smoother: ImuSmoother,
        stamp_s: float,
        pose: gtsam.Pose3,
        covariance: FloatArray | None,
        step: tuple[gtsam.Pose3, FloatArray] | None = None,
    ) -> None:
        """As `took`, for the pose of the IMU."""
        state = smoother.state
        if stamp_s <= state.stamp_s:
            return
        if not self._readings.covers(state.stamp_s, stamp_s):
            self._lose()
            return
        integral = self._integrated(state, stamp_s)
        if covariance is not None:
            self._judge(state.pose.between(pose), integral, state)
        try:
            smoother.advance(stamp_s, integral, pose if covariance is not None else None, covariance, step)
        except RuntimeError:  # indeterminate: an extreme contradiction to the lidar
            self._lose()
            return
        self._states += 1
        if covariance is None:
            self.bridged_s += stamp_s - state.stamp_s
            return
        off_m_s2 = float(np.linalg.norm(smoother.state.bias.accelerometer()))
        if off_m_s2**2 > gate(3) * FORCE_BIAS_M_S2**2:
            why = f"its forces are {off_m_s2:.1f} m/s^2 off what the trajectory implies"
            raise UnfitImuError(self._sensor, f"{why}: a wrong mounting, clock or unit", {"force_scale": 0.0})

    def restart(self) -> None:
        """Restart at the newest state, where the lidar's map is restarted."""
        if self._smoother is not None:
            self._smoother = self._smoother.restarted()
        self._poses.clear()

    def spread(self) -> FloatArray | None:
        """Return (6, 6) the covariance of the newest ``T_odom_base``; None if the IMU does not know it."""
        if self.state is None or self._smoother is None or self._readings.weightless:
            return None
        back = self._readings.T_base_imu.AdjointMap()
        return np.asarray(back @ self._smoother.spread() @ back.T)

    def off(self, pose: gtsam.Pose3) -> FloatArray | None:
        """Return (6, 6) the covariance of the newest ``T_odom_base`` against a pose; None without a state."""
        state, spread = self.state, self.spread()
        if state is None or spread is None:
            return None
        offset = gtsam.Pose3.Logmap(pose.between(state.pose.compose(self._readings.T_base_imu.inverse())))
        return spread + np.outer(offset, offset)

    def gravity(self) -> Gravity | None:
        """Return gravity in the base frame at the newest state."""
        state = self.state
        if state is None or self._smoother is None or self._readings.weightless:
            return None
        down_imu = state.pose.rotation().unrotate(state.down)
        down = np.asarray(self._readings.T_base_imu.rotation().rotate(down_imu))
        return Gravity(state.stamp_s, down, self._smoother.down_sigma_rad())

    def outcome(self) -> tuple[list[str], dict[str, str]]:
        """Return notes for the user at the end of the log, and, by its name, why it was not used."""
        if not self._sensor:
            return [], {}
        state, gravity = self.state, self.gravity()
        if state is None:
            why = "velocity and gravity could not be initialised; that needs a second of matches"
            return [], {self._sensor: why} if self._states < FEWEST else {}
        gyro, force = np.abs(state.bias.gyroscope()).max(), np.abs(state.bias.accelerometer()).max()
        biases = f"biases up to {math.degrees(gyro):.2f} degrees/s"
        if gravity is None:
            return [f"{self._sensor}: its gyroscope alone is used; {biases}"], {}
        known = f"gravity to {math.degrees(gravity.sigma_rad):.2f} degrees (sigma)"
        notes = [f"{self._sensor}: {known}; {biases} and {force:.3f} m/s^2"]
        if self.bridged_s:
            notes.append(f"{self._sensor}: {self.bridged_s:.1f} s without a match were bridged")
        return notes, {}

    def _begin(self, stamp_s: float, pose: gtsam.Pose3, covariance: FloatArray | None) -> None:
        """Collect poses until they determine velocity and gravity; restart after a gap."""
        before_s = self._poses[-1][0] if self._poses else stamp_s
        if covariance is None or not self._readings.covers(before_s, stamp_s):
            self._poses.clear()
        if covariance is None:
            return
        self._poses.append((stamp_s, pose, covariance))
        if stamp_s - self._poses[0][0] < _BEGIN_S or len(self._poses) < _LEAST_POSES:
            return
        poses, self._poses = self._poses, []
        self._parameters = self._readings.parameters()
        self._smoother = ImuSmoother(self._first(poses), _GUESS)
        for measured in poses[1:]:
            if self._smoother is not None:
                self._advance(self._smoother, *measured)

    def _first(self, poses: list[tuple[float, gtsam.Pose3, FloatArray]]) -> ImuState:
        """Estimate the state at the first pose: velocity by differences, gravity from forces."""
        stamps_s = np.array([stamp_s for stamp_s, _, _ in poses])
        places = np.array([pose.translation() for _, pose, _ in poses])
        velocities = np.diff(places, axis=0) / np.diff(stamps_s)[:, None]
        forces = [
            pose.rotation().rotate(self._readings.mean(begin_s, end_s)[3:])
            for (begin_s, _, _), (end_s, pose, _) in pairwise(poses)
        ]
        mean = np.average(forces, axis=0, weights=np.diff(stamps_s))
        middles_s = 0.5 * (stamps_s[1:] + stamps_s[:-1])
        change = (velocities[-1] - velocities[0]) / (middles_s[-1] - middles_s[0])
        down = np.array([0.0, 0.0, -1.0]) if self._readings.weightless else np.asarray(change - mean)
        return ImuState(
            float(stamps_s[0]),
            poses[0][1],
            velocities[0],
            gtsam.imuBias.ConstantBias(),
            down / np.linalg.norm(down),
        )

    def _judge(
        self, matched: gtsam.Pose3, integral: gtsam.PreintegratedCombinedMeasurements, state: ImuState
    ) -> None:
        """Check whether lidar and gyroscope measure the same rotations; if mostly not, ignore the IMU."""
        self._agree.append(alike(matched, state.pose.between(state.carried(integral)[0])))
        if len(self._agree) == 2 * FEWEST and sum(self._agree) < FEWEST:
            why = "its rotation does not agree with the lidar's: a wrong mounting, clock or unit"
            raise UnfitImuError(self._sensor, why, {"use": False})

    def _lose(self) -> None:
        """Discard the state after a gap in the readings."""
        self._smoother = None
        self._poses.clear()

    def _integrated(self, state: ImuState, stamp_s: float) -> gtsam.PreintegratedCombinedMeasurements:
        """Integrate readings from a state to a stamp; cached, since a cloud needs them more than once."""
        if self._interval is None or self._interval[0] is not state or self._interval[1] != stamp_s:
            assert self._parameters is not None
            integral = self._readings.integrated(state.stamp_s, stamp_s, self._parameters, state.bias)
            self._interval = state, stamp_s, integral
        return self._interval[2]


def alike(matched: gtsam.Pose3, predicted: gtsam.Pose3) -> bool:
    """Return whether two motions have the same rotation, within the error of a match."""
    turn_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(matched.rotation())))
    apart_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(predicted.rotation().between(matched.rotation()))))
    return apart_rad <= _APART_RAD + _APART_SHARE * turn_rad


def apart_in_time(directions: dict[int, Gravity]) -> dict[int, Gravity]:
    """Return directions by keyframe, with covariances scaled by the number that shares one error.

    The accelerometer's bias tilts gravity, and stays the same until it has drifted by its uncertainty: the
    directions of that time count as one.
    """
    stamps_s = np.array([gravity.stamp_s for gravity in directions.values()])
    scaled = {}
    for key, gravity in directions.items():
        shared_s = (gravity.sigma_rad * GRAVITY_M_S2 / FORCE_WALK) ** 2
        sharing = int(np.count_nonzero(np.abs(stamps_s - gravity.stamp_s) <= 0.5 * shared_s))
        scaled[key] = replace(gravity, sigma_rad=gravity.sigma_rad * float(np.sqrt(sharing)))
    return scaled


@kernel
def _turned(points, times_s, first_s, per_slice_s, poses, slopes, straight):  # type: ignore[no-untyped-def]
    """Transform points (N, 3) into ``straight`` by the poses (S + 1, 3, 4) around their slices.

    Within a slice, the rotation is small enough for linear interpolation.
    """
    for i in range(points.shape[0]):
        t = times_s[i]
        slices = (t - first_s) / per_slice_s
        n = min(max(int(slices), 0), poses.shape[0] - 2)
        part = slices - n
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        for k in range(3):
            begun = poses[n, k, 0] * x + poses[n, k, 1] * y + poses[n, k, 2] * z + poses[n, k, 3]
            ended = (
                poses[n + 1, k, 0] * x + poses[n + 1, k, 1] * y + poses[n + 1, k, 2] * z + poses[n + 1, k, 3]
            )
            straight[i, k] = begun + part * (ended - begun) + t * (slopes[0, k] + t * slopes[1, k])
