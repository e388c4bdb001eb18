"""Velocity, biases and gravity beside an odometry: GTSAM's preintegrated readings over the last seconds.

The graph of the map contains only poses. The other states that an IMU determines are valid for seconds: here
they are smoothed with the poses that the front end measures (Forster 2017). The map's graph gets steps with
their covariance, and the direction of gravity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from slam.matching.upright import upright_of
from slam.measurements import GRAVITY_M_S2, FloatArray

# Poses older than this are marginalised.
_LAG_S = 3.0
# Turn-on biases of a cheap sensor: one degree per second, and twenty milli-g (data sheets of the Bosch BMI085
# and BMI270).
_GYRO_BIAS_RAD_S, FORCE_BIAS_M_S2 = 0.017, 0.2
# Rotation of gravity in the odometry frame during one lag, by the drift of the odometry.
_DRIFT_RAD = 1e-3
# Prior sigmas of the reference pose: radians and metres.
_HELD = 1e-3
# GTSAM's keys: X of a pose, V of a velocity, B of the biases, G of a direction of gravity.


@dataclass(frozen=True, slots=True)
class ImuState:
    """The state at a stamp, of the IMU, not of the robot's base: at the start of a rotation, the base has
    another acceleration, which GTSAM's lever arm does not model.

    Attributes
    ----------
    pose
        ``T_odom_imu``.
    velocity_m_s
        (3,) odometry frame.
    bias
        Biases of both sensors, IMU frame.
    down
        (3,) unit vector along gravity, odometry frame.
    """

    stamp_s: float
    pose: gtsam.Pose3
    velocity_m_s: FloatArray
    bias: gtsam.imuBias.ConstantBias
    down: FloatArray

    def carried(self, integral: gtsam.PreintegratedCombinedMeasurements) -> tuple[gtsam.Pose3, FloatArray]:
        """Return pose and velocity (3,) after the integrated readings."""
        upright = upright_of(self.down)
        start = gtsam.NavState(
            gtsam.Pose3(upright, np.zeros(3)).compose(self.pose), upright.rotate(self.velocity_m_s)
        )
        end = integral.predict(start, self.bias)
        pose = gtsam.Pose3(upright, np.zeros(3)).inverse().compose(end.pose())
        return pose, np.asarray(upright.unrotate(end.velocity()))


@dataclass(frozen=True, slots=True)
class ImuSpread:
    """Uncertainty of a state without its pose.

    Attributes
    ----------
    velocity, bias
        (3, 3) and (6, 6) covariance.
    down_rad
        Standard deviation of the direction of gravity.
    """

    velocity: FloatArray
    bias: FloatArray
    down_rad: float

    @classmethod
    def of_guess(cls, velocity_m_s: float, down_rad: float) -> ImuSpread:
        """Create it from standard deviations, with the prior of the biases."""
        sigmas = np.repeat([FORCE_BIAS_M_S2, _GYRO_BIAS_RAD_S], 3)
        return cls(velocity_m_s**2 * np.eye(3), np.diag(sigmas**2), down_rad)


class ImuSmoother:
    """Fixed-lag smoother of the newest states.

    Parameters
    ----------
    start, spread
        The first state; its pose is fixed.
    """

    def __init__(self, start: ImuState, spread: ImuSpread) -> None:
        parameters = gtsam.LevenbergMarquardtParams()
        # After a long bridge, sigmas of metres and of millimetres are in one system.
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        # The next cloud solves the lag again; at the optimum, a second step would only be shortened.
        parameters.setMaxIterations(1)
        self._smoother = gtsam.BatchFixedLagSmoother(_LAG_S, parameters)
        self._marginals: gtsam.Marginals | None = None
        self._count, self._downs = 0, 0
        self._down_s = start.stamp_s
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise = gtsam.noiseModel.Gaussian.Covariance
        graph.add(gtsam.PriorFactorPose3(X(0), start.pose, noise(np.diag([_HELD**2] * 6))))
        graph.add(gtsam.PriorFactorVector(V(0), start.velocity_m_s, noise(spread.velocity)))
        graph.add(gtsam.PriorFactorConstantBias(B(0), start.bias, noise(spread.bias)))
        down, along = gtsam.Unit3(start.down), gtsam.noiseModel.Isotropic.Sigma(2, spread.down_rad)
        graph.add(gtsam.PriorFactorUnit3(G(0), down, along))
        self._insert(values, start)
        values.insert(G(0), down)
        self._state = start
        self._update(graph, values, start.stamp_s)

    @property
    def state(self) -> ImuState:
        """The newest."""
        return self._state

    def advance(
        self,
        stamp_s: float,
        integral: gtsam.PreintegratedCombinedMeasurements,
        pose: gtsam.Pose3 | None,
        covariance: FloatArray | None,
        step: tuple[gtsam.Pose3, FloatArray] | None = None,
    ) -> None:
        """Add a state.

        Parameters
        ----------
        integral
            Readings since the newest state.
        pose, covariance
            Measured ``T_odom_imu``, (6, 6) in its tangent; None without a measurement.
        step
            Motion since the newest state by other sensors, with its covariance (6, 6).

        Raises
        ------
        RuntimeError
            It cannot be solved.
        """
        guess, velocity = self._state.carried(integral)
        graph, values, before = gtsam.NonlinearFactorGraph(), gtsam.Values(), self._count
        self._count += 1
        key = self._count
        graph.add(
            gtsam.CombinedImuFactorWithGravityDirection(
                X(before), V(before), X(key), V(key), B(before), B(key), G(self._downs), integral,
                GRAVITY_M_S2,
            )
        )  # fmt: skip
        if pose is not None and covariance is not None:
            graph.add(gtsam.PriorFactorPose3(X(key), pose, noise_of(covariance)))
        if step is not None:
            graph.add(gtsam.BetweenFactorPose3(X(before), X(key), step[0], noise_of(step[1])))
        state = ImuState(stamp_s, guess, velocity, self._state.bias, self._state.down)
        self._insert(values, state)
        self._update(graph, values, stamp_s)
        if stamp_s - self._down_s > _LAG_S:
            self._renew_down(stamp_s)

    def spread(self) -> FloatArray:
        """Return (6, 6) the covariance of the newest pose, in its tangent."""
        return np.asarray(self._marginal(X(self._count)))

    def down_sigma_rad(self) -> float:
        """Return the sigma of the gravity direction in the base frame, along its worse axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self._marginal(G(self._downs)))[-1]))

    def restarted(self) -> ImuSmoother:
        """Return a smoother that starts at the newest state, where the odometry frame was restarted."""
        number = self._count
        spread = ImuSpread(self._marginal(V(number)), self._marginal(B(number)), self.down_sigma_rad())
        return ImuSmoother(self._state, spread)

    def _insert(self, values: gtsam.Values, state: ImuState) -> None:
        """Insert initial values of the newest state."""
        values.insert(X(self._count), state.pose)
        values.insert(V(self._count), state.velocity_m_s)
        values.insert(B(self._count), state.bias)

    def _renew_down(self, stamp_s: float) -> None:
        """Let gravity rotate slightly, since the odometry drifts."""
        self._downs, self._down_s = self._downs + 1, stamp_s
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise = gtsam.noiseModel.Isotropic.Sigma(3, _DRIFT_RAD)
        graph.add(gtsam.CustomFactor(noise, [G(self._downs - 1), G(self._downs)], _turned))
        values.insert(G(self._downs), gtsam.Unit3(self._state.down))
        self._update(graph, values, stamp_s)

    def _update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamp_s: float) -> None:
        """Solve, and marginalise what is older than the lag."""
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = dict.fromkeys(
            [*values.keys(), G(self._downs)], stamp_s
        )
        self._smoother.update(graph, values, stamps)
        self._marginals = None
        self._state = self._found(self._count, stamp_s)

    def _found(self, number: int, stamp_s: float) -> ImuState:
        """Return a smoothed state within the lag."""
        state = self._smoother.calculateEstimate()
        velocity = np.asarray(state.atVector(V(number)))
        down = np.asarray(state.atUnit3(G(self._downs)).unitVector())
        return ImuState(stamp_s, state.atPose3(X(number)), velocity, state.atConstantBias(B(number)), down)

    def _marginal(self, key: int) -> FloatArray:
        """Return the covariance of one variable."""
        # Marginalised directions keep the tangent axes of that time; GTSAM's axes of a downward direction
        # rotate by a right angle as it drifts.
        graph, estimate = self._smoother.getFactors(), self._smoother.getLinearizationPoint()
        try:
            # All queries between two updates use one factorisation.
            if self._marginals is None:
                self._marginals = gtsam.Marginals(graph, estimate)
            return np.asarray(self._marginals.marginalCovariance(key))
        except RuntimeError:
            # For a long bridge, the normal equations have too few digits; QR of the equations does not.
            rows = graph.linearize(estimate).jacobian()[0]
            sizes = {"x": 6, "v": 3, "b": 6, "g": 2}
            keys = sorted(estimate.keys())
            widths = [sizes[chr(gtsam.symbolChr(one))] for one in keys]
            begin = sum(widths[: keys.index(key)])
            unit = np.eye(rows.shape[1])[:, begin : begin + widths[keys.index(key)]]
            scale = 1.0 / np.linalg.norm(rows, axis=0)
            triangle: FloatArray = np.asarray(np.linalg.qr(rows * scale, mode="r"))
            half = np.linalg.solve(triangle.T, scale[:, None] * unit)
            return np.asarray(half.T @ half)


def noise_of(covariance: FloatArray) -> gtsam.noiseModel.Gaussian:
    """Return the noise of a covariance (N, N) in which one direction may be undetermined.

    Its inverse, which GTSAM would factorise, has too few digits: an undetermined direction became certain.
    """
    values, vectors = np.linalg.eigh(covariance)
    return gtsam.noiseModel.Gaussian.SqrtInformation((vectors / np.sqrt(values)).T)


def _turned(
    factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
) -> FloatArray:
    """Return the angle between two directions (3,); not in their tangents, whose axes may differ."""
    first, last = factor.keys()
    before, now = values.atUnit3(first), values.atUnit3(last)
    if jacobians is not None:
        jacobians[0], jacobians[1] = -before.basis(), now.basis()
    return np.asarray(now.unitVector() - before.unitVector())
