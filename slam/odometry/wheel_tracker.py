"""Wheel odometry as a prediction and as a measurement, never as ground truth."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from fusion.estimation import gate
from fusion.time_alignment import GAP_S
from slam.config.stages import WheelConfig
from slam.matching.motion import Motion
from slam.matching.planar import between, compose, wrap
from slam.measurements import FloatArray, WheelOdometry
from slam.odometry.clock_learner import ClockLearner, SensorClock, Turns
from slam.odometry.gyro_yaw import GyroMoment, YawGyro
from slam.odometry.usual_speed import UsualSpeed
from slam.odometry.wheel_gaps import WheelGaps

# The time between readings with equal or decreasing stamps is unknown.
SHORTEST_STEP_S = 0.05
_UNKNOWN_STEP_S = 1.0
# Sigma of the rotation per unobserved metre, radians.
_TURN_PER_M = 0.5


@dataclass(frozen=True, slots=True)
class WheelMoment:
    """A pose of the robot by its wheels.

    Attributes
    ----------
    pose
        (3,) in the odom frame.
    guessed_m
        Path length up to there that no reading measured.
    unusual_m
        Path length up to there by which readings exceed the usual motion of the robot in their time.
    """

    pose: FloatArray
    guessed_m: float
    unusual_m: float = 0.0


class WheelTracker:
    """The newest odometry readings, for poses at the stamps of scans; and the wheels' clock."""

    def __init__(self, config: WheelConfig, gyro: YawGyro | None = None) -> None:
        self._config, self._gyro = config, gyro
        self._gaps = WheelGaps()
        # Sums over steps; their initial values keep the scale at one for the first metres.
        self._counted_m2 = self._true_m2 = 1.0
        self._scale = np.ones(3)
        # Rotation per metre that the wheels miss, its sums over steps, and the mean square residual.
        self._yaw_rad_per_m = self._driven_m_rad = self._driven_m2 = 0.0
        self._missed_rad2, self._turns_learned = config.floor_rad**2, 1
        self._clocks = ClockLearner()
        # Recent stamps and poses (3,), stamps increasing; the newest first.
        self._recent: deque[tuple[float, FloatArray]] = deque()
        self._rising = True
        # Whether a reading ever differed from the first; whether the robot has moved although none did.
        self.moved, self.dead = False, False
        self._fastest_m_s = config.greatest_speed_m_s
        self._speed = UsualSpeed(config.greatest_speed_m_s, config.floor_m)
        self._turning = UsualSpeed(config.greatest_turn_rad_s, config.floor_rad)
        self._unusual_m = 0.0
        self._moment_s = math.nan
        self._ahead_s = 0.0
        self._T_odom_read = np.zeros(3)
        # The newest pose by the wheels alone, and the gyroscope's rotation at that time.
        self._alone: tuple[FloatArray, GyroMoment | None] | None = None

    @property
    def turns(self) -> Turns:
        """Rotation of the robot by its wheels."""
        return self._clocks.turns

    @property
    def clock(self) -> SensorClock:
        """Clock offset of the wheels to the lidar, if it is known."""
        return self._clocks.clock

    @property
    def clock_was_used(self) -> bool:
        """Whether a pose was ever read at another time than that of the stamps."""
        return bool(self._ahead_s or np.count_nonzero(self._T_odom_read))

    def learn_clock(self, lidar: Turns, *, final: bool = False) -> None:
        """Estimate the clock offset again if due; poses continue from the one last returned."""
        known = self.clock
        self._clocks.learn(lidar, final=final)
        if self.clock is known or self.clock.significant_s == self._ahead_s:
            return
        before = self.pose_at(self._moment_s)
        self._ahead_s = self.clock.significant_s
        after = self.pose_at(self._moment_s)
        if before is not None and after is not None:
            self._T_odom_read = compose(compose(before, between(after, np.zeros(3))), self._T_odom_read)

    def add(self, reading: WheelOdometry) -> FloatArray:
        """Add the next reading in log order; return its pose (3,) without impossible jumps.

        Its rotations are fused with those of a gyroscope, by covariance.
        """
        step, step_s = self._gaps.step(reading)
        alone = self._gaps.add(reading, step, step_s, usual=self._usual(step, step_s))
        self.turns.add(reading.stamp_s, float(alone[2]))
        pose = self._joined(alone, reading.stamp_s)
        if self._recent and np.count_nonzero(pose != self._recent[0][1]):
            self.moved, self.dead = True, False
        self._rising = not self._recent or reading.stamp_s > self._recent[0][0]
        while self._recent and reading.stamp_s <= self._recent[0][0]:
            self._recent.popleft()
        self._recent.appendleft((reading.stamp_s, pose))
        while len(self._recent) > 2 and reading.stamp_s - self._recent[-1][0] > 2.0 * GAP_S:
            self._recent.pop()
        return pose

    def _joined(self, alone: FloatArray, stamp_s: float) -> FloatArray:
        """Return the pose (3,) that follows the newest one; if no wheel has moved, the robot stands still."""
        gyro = None if self._gyro is None else self._gyro.moment(stamp_s - self._ahead_s)
        begun, self._alone = self._alone, (alone, gyro)
        if begun is None or not self._recent:
            return alone
        step = between(begun[0], alone)
        turn = self._gyro.turn(begun[1], gyro) if self._gyro is not None and np.count_nonzero(step) else None
        if turn is None and not self._yaw_rad_per_m and self._recent[0][1] is begun[0]:
            return alone  # bit-identical: nothing was ever joined
        step[2] += self._yaw_rad_per_m * step[0]
        if turn is not None:
            step = Motion(step, self.covariance(step)).looking(*turn).pose
        return compose(self._recent[0][1], step)

    def moment(self, stamp_s: float, *, in_order: bool = True) -> WheelMoment | None:
        """Return the pose of the robot at a stamp, see `pose_at`; None before any reading."""
        pose = self.pose_at(stamp_s, in_order=in_order)
        if pose is None:
            return None
        guess, guess_m = self._gaps.guess_at(stamp_s + self._ahead_s)
        return WheelMoment(compose(pose, guess), self._gaps.guessed_m + guess_m, self._unusual_m)

    def motion(
        self, begun: WheelMoment | None, ended: WheelMoment | None, elapsed_s: float
    ) -> FloatArray | None:
        """Return the motion (3,) between two moments; None if not measured, or impossible for a robot.

        Wheels that never move do not prove that it stands still.
        """
        if begun is None or ended is None or self.dead:
            return None
        step = between(begun.pose, ended.pose) * self._scale
        return step if self.plausible(step, elapsed_s) else None

    def on_top(self, step: FloatArray, begun: WheelMoment, ended: WheelMoment) -> FloatArray:
        """Return the covariance (3, 3) of a motion (3,) that learning from matches cannot reduce.

        The base may be farther from the axle than the log says, so a rotation moves it sideways. A guessed
        path may be completely wrong, and the robot may have rotated there. Wheels that run faster than usual
        may have spun by the difference.
        """
        guessed_m = abs(ended.guessed_m - begun.guessed_m)
        unusual_m = ended.unusual_m - begun.unusual_m
        metres2 = (self._config.swing_m_per_rad * step[2]) ** 2 + guessed_m**2 + unusual_m**2
        return np.diag([metres2, metres2, (_TURN_PER_M * guessed_m) ** 2])

    def see(self, speed_m_s: float) -> None:
        """A robot seen at this speed may move twice as fast."""
        self._fastest_m_s = max(self._fastest_m_s, 2.0 * speed_m_s)

    def learn_scale(self, step: FloatArray, matched: FloatArray) -> None:
        """Learn the scale of the wheels from a step (3,) as returned by `motion` and as matched.

        Least squares over all steps on which both roughly agree. Without a gyroscope, it also estimates the
        rotation per metre of two wheels of different size.
        """
        (x, y, _), (true_x, true_y, _), scale = step.tolist(), matched.tolist(), float(self._scale[0])
        counted, true = math.hypot(x, y), math.hypot(true_x, true_y)
        if abs(true - counted) > self._config.distance_share * counted or x * true_x + y * true_y <= 0.0:
            return
        counted /= scale
        self._counted_m2 += counted * counted
        self._true_m2 += counted * true
        self._scale[:2] = self._true_m2 / self._counted_m2
        missed_rad = wrap(matched[2] - step[2])
        if (self._alone and self._alone[1]) or missed_rad**2 > gate() * self._missed_rad2:
            return
        self._turns_learned += 1
        self._missed_rad2 += (missed_rad**2 - self._missed_rad2) / self._turns_learned
        self._driven_m2 += step[0] ** 2
        self._driven_m_rad += step[0] * (missed_rad + self._yaw_rad_per_m * step[0])
        known_m2 = self._driven_m2 + self._missed_rad2 / self._config.turn_per_m_rad**2
        # Corrected only if it is significant, and larger than the allowed error per metre.
        aside_rad_m = self._driven_m_rad / known_m2
        least2 = max(self._config.turn_per_m_rad**2, gate() * self._missed_rad2 / known_m2)
        self._yaw_rad_per_m = aside_rad_m if aside_rad_m**2 > least2 else 0.0

    def pose_at(self, stamp_s: float, *, in_order: bool = True) -> FloatArray | None:
        """Return the pose (3,) in the odom frame at a stamp of the lidar's clock; None before any reading.

        The newest reading is extrapolated to a stamp shortly after it. For an earlier stamp, it is used as it
        is, since readings are in log order; unless the clocks are known to differ, or the stamp is not that
        of the log (not ``in_order``), such as that of a frame by the learned clock of its camera.
        """
        self._moment_s = stamp_s
        if not self._recent:
            return None
        pose = self._read_at(stamp_s + self._ahead_s, by_stamp=bool(self._ahead_s) or not in_order)
        return compose(self._T_odom_read, pose) if self.clock_was_used else pose

    def _read_at(self, asked_s: float, *, by_stamp: bool) -> FloatArray:
        """Return the pose (3,) by the wheels for a stamp of their own clock."""
        readings, number, shortest_s = self._recent, 0, 0.0
        if by_stamp:
            last = len(readings) - 1
            number = next((n for n, (read_s, _) in enumerate(readings) if read_s <= asked_s), last)
            # Then readings are extrapolated at every scan: a step without time would give any speed.
            shortest_s = SHORTEST_STEP_S
        read_s, pose = readings[number]
        ended_s, ended = readings[max(number - 1, 0)]
        older = (reading for reading in readings if ended_s - reading[0] > shortest_s)
        begun = readings[number] if number else next(older, None)
        if not by_stamp and not self._rising:
            return pose
        if begun is None or asked_s <= read_s or (not number and asked_s - read_s >= GAP_S):
            return pose
        return compose(pose, between(begun[1], ended) / (ended_s - begun[0]) * (asked_s - read_s))

    def _usual(self, step: FloatArray, step_s: float) -> bool:
        """Return whether ``step`` (3,) is usual for this robot, and learn from it."""
        time_s, way_m, turn_rad = self._time_s(step_s), math.hypot(step[0], step[1]), abs(float(step[2]))
        unusual = (
            self._speed.exceeded_by((way_m - self._config.floor_m) / time_s)
            or self._turning.exceeded_by((turn_rad - self._config.floor_rad) / time_s)
            or not self.plausible(step, step_s)
        )
        if not unusual:
            # Faster motions are ignored.
            self._unusual_m += max(way_m - self._speed.most * time_s, 0.0)
        self._speed.add(way_m / time_s)
        self._turning.add(turn_rad / time_s)
        return not unusual

    def _time_s(self, step_s: float) -> float:
        """Return the time that a step may have taken."""
        return max(step_s, self._gaps.period_s, SHORTEST_STEP_S) if step_s > 0.0 else _UNKNOWN_STEP_S

    def plausible(self, step: FloatArray, step_s: float) -> bool:
        """Return whether a robot can move by ``step`` (3,) in that time, or in the usual time of a reading.

        Stamps may be late by about as much: then two readings follow each other at once.
        """
        time_s = self._time_s(step_s)
        return bool(
            math.hypot(step[0], step[1]) <= self._fastest_m_s * time_s + self._config.floor_m
            and abs(step[2]) <= self._config.greatest_turn_rad_s * time_s + self._config.floor_rad
        )

    def covariance(self, step: FloatArray) -> FloatArray:
        """Return the covariance (3, 3) of a wheel motion ``step`` (3,): floor, path and rotation shares."""
        config = self._config
        path_m = math.hypot(step[0], step[1])
        turn_rad = abs(float(step[2]))
        sigma_m = config.floor_m + config.distance_share * path_m
        sigma_rad = config.floor_rad + config.turn_share * turn_rad + config.turn_per_m_rad * path_m
        return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])


def thrown_aside(motion: Motion) -> FloatArray:
    """Return the added covariance (3, 3) of a long motion: heading errors shift the rest of the path.

    The heading error may occur anywhere on the path: then a share of it, uniform from 0 to 1, is shifted; the
    mean of the share is one half, that of its square one third.
    """
    x, y, yaw_rad = motion.pose.tolist()
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    # Start relative to the end; rotated by 90 degrees, it is the lateral direction.
    lever_x, lever_y = sin * x - cos * y, cos * x + sin * y
    _, _, (xt, yt, variance) = motion.covariance.tolist()
    # A path error correlated with the heading error shifts together with it: otherwise a dispute, whose
    # covariance has one direction, would keep a wrong one.
    third, half = variance / 3, 0.5 * variance
    across = third * lever_x * lever_y + 0.5 * (lever_x * yt + lever_y * xt)
    return np.array(
        [
            [third * lever_x * lever_x + lever_x * xt, across, half * lever_x],
            [across, third * lever_y * lever_y + lever_y * yt, half * lever_y],
            [half * lever_x, half * lever_y, 0.0],
        ]
    )
