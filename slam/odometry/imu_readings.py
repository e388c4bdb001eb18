"""The newest readings of an inertial measurement unit, and their integration."""

from __future__ import annotations

from collections import deque
from statistics import median

import gtsam
import numpy as np

from fusion.estimation import FEWEST, median_to_sigma
from slam.measurements import GRAVITY_M_S2, FloatArray, ImuReading

# A step between readings of so many times the usual one is a gap.
_GAP = 10.0
_KEPT_S = 30.0
# Lower limit of the noise: a tenth of that of a phone's sensors (Woodman 2007).
_GYRO_DENSITY, _FORCE_DENSITY = 2e-5, 1e-3
# Random walk of biases: ten times that of a tactical gyroscope (Forster 2017, Sec. VIII), and that of EuRoC's
# accelerometer (Burri 2016): with less, its wander on a straight road looks like a lean.
GYRO_WALK, FORCE_WALK = 1e-4, 3e-3
# Prior sigmas of a gyroscope: bias in rad/s, scale error (of cheap ones, by their data sheets).
GYRO_UNKNOWN = np.diag([0.1, 0.03])


class ImuReadings:
    """Stamps, angular rates and forces of one IMU."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, FloatArray]] = deque()
        self._steps_s: deque[float] = deque(maxlen=FEWEST * FEWEST)
        self.T_base_imu = gtsam.Pose3()
        self._gyro_density: float | None = None
        # Usual time between two readings, and number of readings until it is computed again.
        self._usual_s, self._until_median = 0.0, 0

    def add(self, reading: ImuReading) -> bool:
        """Take the next reading; one that is not later than the one before is left out.

        Returns
        -------
        Whether its clock was set back: previous readings are discarded.
        """
        step_s = reading.stamp_s - self.newest_s
        set_back = self.is_gap(-step_s)
        if set_back:
            self._rows.clear()
        elif step_s <= 0.0:
            return False
        elif self._rows:
            self._steps_s.append(step_s)
            # There are hundreds per second: a median for each would be too slow.
            self._until_median -= 1
            if self._until_median <= 0:
                self._usual_s, self._until_median = median(self._steps_s), min(len(self._steps_s), FEWEST)
        self.T_base_imu = reading.T_base_imu or gtsam.Pose3()
        row = np.concatenate([reading.gyro_rad_s, reading.specific_force_m_s2])
        self._rows.append((reading.stamp_s, row))
        while self._rows[-1][0] - self._rows[0][0] > _KEPT_S:
            self._rows.popleft()
        return set_back

    @property
    def newest_s(self) -> float:
        """Return the stamp of the newest reading."""
        return self._rows[-1][0] if self._rows else -np.inf

    @property
    def gyro_density(self) -> float:
        """Return the noise density of angular rates, from the first readings that determine it."""
        if self._gyro_density is None and len(self._steps_s) == self._steps_s.maxlen:
            self._gyro_density = self._densities()[0]
        return self._gyro_density or _GYRO_DENSITY

    @property
    def weightless(self) -> bool:
        """Return whether forces are unknown: all are zero."""
        return bool(self._rows) and not self._rows[-1][1][3:].any()

    def covers(self, begin_s: float, end_s: float) -> bool:
        """Return whether readings cover the time, up to a few steps after the newest."""
        if len(self._rows) < 2 or end_s < begin_s:
            return False
        if self.is_gap(self._rows[0][0] - begin_s) or self.is_gap(end_s - self.newest_s):
            return False
        stamps_s = self._between(begin_s, end_s)[0]
        return not self.is_gap(float(np.diff([begin_s, *stamps_s, end_s]).max()))

    def is_gap(self, step_s: float) -> bool:
        """Return whether the time between two readings is unusually long."""
        return bool(self._steps_s) and step_s > _GAP * self._usual_s

    def mean(self, begin_s: float, end_s: float) -> FloatArray:
        """Return (6,) the mean angular rate and force, IMU frame; in a gap, those at its ends."""
        rows = self._between(begin_s, end_s)[1]
        return np.asarray((rows if len(rows) else self._with_ends(begin_s, end_s)[1]).mean(axis=0))

    def parameters(self) -> gtsam.PreintegrationCombinedParams:
        """Return the parameters of GTSAM's preintegration, with noise from neighbouring readings.

        Without forces, any acceleration is possible: wheels and feet exert at most about the weight.
        """
        parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
        gyro, force = self._densities()
        force = GRAVITY_M_S2 if self.weightless else force
        parameters.setGyroscopeCovariance(gyro**2 * np.eye(3))
        parameters.setAccelerometerCovariance(force**2 * np.eye(3))
        parameters.setIntegrationCovariance(1e-8 * np.eye(3))
        parameters.setBiasOmegaCovariance(GYRO_WALK**2 * np.eye(3))
        parameters.setBiasAccCovariance(FORCE_WALK**2 * np.eye(3))
        return parameters

    def integrated(
        self,
        begin_s: float,
        end_s: float,
        parameters: gtsam.PreintegrationCombinedParams,
        bias: gtsam.imuBias.ConstantBias,
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Integrate the readings between two stamps; outside, the nearest reading is used."""
        integral = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
        stamps_s, rows = self._with_ends(begin_s, end_s)
        # A scale error is no bias: it changes sign with the rotation.
        noise, rates = parameters.getGyroscopeCovariance(), rows[:, :3].mean(axis=0) - bias.gyroscope()
        parameters.setGyroscopeCovariance(
            noise + (end_s - begin_s) * np.diag(GYRO_UNKNOWN[1, 1] * rates) ** 2
        )
        for step_s, row in zip(np.diff(stamps_s), 0.5 * (rows[1:] + rows[:-1]), strict=True):
            if step_s > 0.0:
                integral.integrateMeasurement(row[3:], row[:3], float(step_s))
        parameters.setGyroscopeCovariance(noise)
        return integral

    def turns(self, times_s: FloatArray, at_s: float, gyro_bias: FloatArray) -> FloatArray:
        """Return (n, 3, 3) rotations of the IMU at increasing stamps (n,), in its frame at another stamp."""
        spans = np.array([min(times_s[0], at_s), max(times_s[-1], at_s)])
        stamps_s, rows = self._with_ends(*spans)
        rates = rows[:, :3] - gyro_bias
        turn, turns = gtsam.Rot3(), [gtsam.Rot3()]
        for step_s, rate in zip(np.diff(stamps_s), 0.5 * (rates[1:] + rates[:-1]), strict=True):
            turn = turn.compose(gtsam.Rot3.Expmap(rate * step_s))
            turns.append(turn)

        def turned(stamp_s: float) -> gtsam.Rot3:
            last = min(max(int(np.searchsorted(stamps_s, stamp_s, side="right")) - 1, 0), len(turns) - 1)
            return turns[last].compose(gtsam.Rot3.Expmap(rates[last] * (stamp_s - stamps_s[last])))

        back = turned(at_s).inverse()
        return np.array([back.compose(turned(float(time_s))).matrix() for time_s in times_s])

    def _between(self, begin_s: float, end_s: float) -> tuple[FloatArray, FloatArray]:
        """Return stamps (n,) and readings (n, 6) within a span, including its ends."""
        rows = []
        for stamp_s, values in reversed(self._rows):
            if stamp_s < begin_s:
                break
            if stamp_s <= end_s:
                rows.append((stamp_s, values))
        rows.reverse()
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows]).reshape(-1, 6)

    def _with_ends(self, begin_s: float, end_s: float) -> tuple[FloatArray, FloatArray]:
        """Return `_between` with linearly interpolated readings at both ends."""
        stamps_s, rows = self._between(begin_s - self._around_s, end_s + self._around_s)
        if not len(stamps_s):
            stamps_s, rows = np.array([self._rows[-1][0]]), self._rows[-1][1][None]
        within = stamps_s[(stamps_s > begin_s) & (stamps_s < end_s)]
        times_s = np.array([begin_s, *within, end_s])
        return times_s, np.column_stack([np.interp(times_s, stamps_s, column) for column in rows.T])

    @property
    def _around_s(self) -> float:
        """Return a span that contains the readings next to a stamp."""
        return _GAP * self._usual_s

    def _densities(self) -> tuple[float, float]:
        """Return the noise densities of angular rates and forces."""
        rows = np.array([row[1] for row in self._rows])
        # Second differences remove the motion; for white noise their variance is six times its own.
        differences = np.abs(np.diff(rows, n=2, axis=0))
        root_s = float(np.sqrt(self._usual_s / 6.0))
        noise = median_to_sigma() * np.median(differences, axis=0) * root_s
        return max(noise[:3].max(), _GYRO_DENSITY), max(noise[3:].max(), _FORCE_DENSITY)
