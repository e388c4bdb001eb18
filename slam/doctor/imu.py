"""Examines an IMU alone, and its rotation and clock compared with a lidar on the same robot."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy import special

from fusion.estimation import FEWEST, SETTLED, gate, half_interval, median_to_sigma
from fusion.time_alignment import GAP_S, STEP_S
from slam.doctor.camera_samples import SPREAD, SensorStep
from slam.doctor.finding import Finding, Remedy, mounting_entry
from slam.doctor.pair import IN_ORDER, interval
from slam.doctor.paired_motions import turns_of
from slam.doctor.relation import Linear, fit_linear
from slam.measurements import GRAVITY_M_S2, BoolArray, FloatArray, ImuReading

# Harmless errors of clock and mounting: 0.01 rad when turning at 1 rad/s.
_CLOCK_S, _ANGLE_RAD = 0.005, math.radians(2.0)
# Minimum ratio of rotations about a second axis to those about the first, to determine the mounting.
_SECOND_AXIS = 0.05


@dataclass(slots=True)
class ImuSamples:
    """All readings of one IMU."""

    T_base_imu: gtsam.Pose3 | None = None
    _rows: array[float] = field(default_factory=lambda: array("d"))

    def add(self, reading: ImuReading) -> None:
        """Add the next reading."""
        self.T_base_imu = reading.T_base_imu
        self._rows.append(reading.stamp_s)
        self._rows.extend(reading.gyro_rad_s)
        self._rows.extend(reading.specific_force_m_s2)

    def rows(self) -> FloatArray:
        """(N, 7) stamp, angular rate, specific force, with increasing stamps; older readings are skipped."""
        return rising(np.array(self._rows).reshape(-1, 7))


def rising(rows: FloatArray) -> FloatArray:
    """Rows that start with a stamp, without those older than an earlier one."""
    newest = np.maximum.accumulate(np.concatenate([[-np.inf], rows[:-1, 0]]))
    return np.asarray(rows[rows[:, 0] > newest])


@dataclass(frozen=True, slots=True)
class TurnFit:
    """Rotation of an IMU compared with a lidar.

    Attributes
    ----------
    ahead_s, ahead_sigma_s
        How far its stamps are ahead of the lidar's.
    R_lidar_imu
        (3, 3).
    sigma_rad
        Of the least certain axis of the rotation; infinite if the motion does not determine it.
    left_share
        Share of the lidar's rotation that the IMU does not explain.
    """

    ahead_s: float
    ahead_sigma_s: float
    R_lidar_imu: FloatArray
    sigma_rad: float
    left_share: float


def imu_findings(
    name: str,
    samples: ImuSamples,
    steps: Sequence[SensorStep],
    T_base_lidar: gtsam.Pose3 | None,
    untimed_s: float = 0.0,
) -> list[Finding]:
    """Findings about an IMU, alone and compared with the motions of a lidar.

    For a 2D lidar, whose ``T_base_lidar`` is None, the mounting has no effect. Revolutions of ``untimed_s``
    without point times may be matched as of any time within them.
    """
    rows = samples.rows()
    if len(rows) < FEWEST:
        return []
    same = _frozen(rows, steps)
    text = f"{np.count_nonzero(same)} of {len(rows)} readings are identical to the one before"
    once: Remedy = {"imus": {name: {"drop_repeated": True}}}
    hangs = Finding(name, "frozen", text, "the robot seems to go on turning", (once,), sure=True)
    found = [hangs] if same.any() else []
    rows = rows[~same]
    found += _saturated(name, rows)
    unit = _unit(rows, steps)
    rows[:, 1:4] *= unit
    if T_base_lidar is None:
        return [*found, *_in_the_plane(name, samples.T_base_imu, rows, steps, unit)]
    fit, turns = turn_fit(rows, steps), _turns(rows, steps)
    known = fit is not None and turns is not None and fit.left_share <= SPREAD
    slope = _slope(turns[1](fit.ahead_s) @ fit.R_lidar_imu.T, turns[0]) if fit and turns and known else None
    found += [*_turn_rates(name, unit, 1.0, slope), *_without_gravity(name, rows)]
    if fit is None or not known:
        return found
    return [*found, *_clock(name, fit, untimed_s), *_sits(name, samples, fit, T_base_lidar)]


def clock_sigma_s(samples: ImuSamples, steps: Sequence[SensorStep]) -> float:
    """Sigma of the clock offset between an IMU and a lidar; infinite if rotations do not determine it."""
    fit = _agreeing(samples, steps)
    return math.inf if fit is None else fit.ahead_sigma_s


def up_by_imu(samples: ImuSamples, steps: Sequence[SensorStep]) -> FloatArray | None:
    """(3,) vertical of the base in the lidar's frame, by an IMU that rotates about it with the lidar."""
    fit = _agreeing(samples, steps)
    if fit is None or samples.T_base_imu is None:
        return None
    axis = np.linalg.eigh(np.cov(samples.rows()[:, 1:4].T))[1][:, 2]
    along = float(np.asarray(samples.T_base_imu.rotation().matrix())[2] @ axis)
    return fit.R_lidar_imu @ axis * math.copysign(1.0, along) if abs(along) > math.cos(_ANGLE_RAD) else None


def _agreeing(samples: ImuSamples, steps: Sequence[SensorStep]) -> TurnFit | None:
    """The `turn_fit` of an IMU, in the right unit; None unless it explains the rotations of the lidar."""
    rows = samples.rows()
    if len(rows) < FEWEST:
        return None
    rows[:, 1:4] *= _unit(rows, steps)
    fit = turn_fit(rows, steps)
    return None if fit is None or fit.left_share > SPREAD else fit


def handed(found: Sequence[Finding]) -> float:
    """Whether IMUs turn in the same direction as a 2D lidar (1) or opposite (-1), by findings; 0: unknown."""
    by_kind = {one.kind: one for one in found}
    if by_kind.keys() & {"axes", "no agreement"}:
        return 0.0
    return math.copysign(1.0, by_kind["turn rates"].value or 1.0) if "turn rates" in by_kind else 1.0


def turn_fit(rows: FloatArray, steps: Sequence[SensorStep]) -> TurnFit | None:
    """Clock offset and rotation with the best fit of `ImuSamples.rows` to a lidar; None if too few."""
    turns = _turns(rows, steps)
    if turns is None:
        return None
    lidar_turns, imu_turns = turns

    def error(ahead_s: float) -> float:
        # Not the median, because most steps may be straight.
        return float(np.linalg.norm(_apart(lidar_turns, imu_turns(ahead_s))[0], axis=1).sum())

    coarse = np.arange(-GAP_S, GAP_S + 0.5 * STEP_S, STEP_S)
    best_s = float(min(coarse, key=error))
    for step_s in (0.1 * STEP_S, 0.01 * STEP_S):
        best_s = float(min(best_s + step_s * np.arange(-10, 11), key=error))
    residuals, rotation, spread = _apart(lidar_turns, imu_turns(best_s))
    sigma = median_to_sigma(3) * math.sqrt(float(np.median(np.sum(residuals**2, axis=1))))
    slope = (imu_turns(best_s + STEP_S) - imu_turns(best_s - STEP_S)) / (2.0 * STEP_S)
    slope = (slope - slope.mean(axis=0)) @ rotation.T
    moved = np.sum(slope**2, axis=1)
    if not moved.any():
        return None
    # Most steps may be straight without information: final estimate by least squares, with a covariance from
    # the residuals of the informative steps (White 1980).
    pulls = np.einsum("ij,ij->i", slope, residuals)
    left_s = float(pulls.sum() / moved.sum())
    ahead_sigma_s = float(np.linalg.norm(pulls - left_s * moved) / moved.sum())
    # Widened to Student's interval, because three or four steps may have all the weight.
    steps_used = float(moved.sum() ** 2 / (moved @ moved))
    student = float(special.stdtrit(max(steps_used - 1.0, 1.0), float(special.ndtr(half_interval(1.0)))))
    ahead_sigma_s *= student / half_interval(1.0)
    best_s += float(np.clip(left_s, -STEP_S, STEP_S))
    # A rotation about an axis is determined by rotations about the other two.
    information = np.linalg.eigvalsh(np.trace(spread) * np.eye(3) - spread)[0]
    main = np.linalg.eigvalsh(spread)
    open_ = main[1] < _SECOND_AXIS**2 * main[2]
    axis_rad = math.inf if open_ or information <= 0.0 else sigma / math.sqrt(float(information))
    turned = max(float(np.abs(lidar_turns - lidar_turns.mean(axis=0)).sum()), SETTLED)
    return TurnFit(best_s, ahead_sigma_s, rotation, axis_rad, float(np.abs(residuals).sum()) / turned)


def _turns(
    rows: FloatArray, steps: Sequence[SensorStep]
) -> tuple[FloatArray, Callable[[float], FloatArray]] | None:
    """Rotations (K, 3) of the lidar, and those of the IMU by clock offset; None if there are too few."""
    spans = np.array([[step.begun_s, step.ended_s] for step in steps]).reshape(-1, 2)
    within = (spans[:, 0] - GAP_S > rows[0, 0]) & (spans[:, 1] + GAP_S < rows[-1, 0])
    within &= np.diff(np.searchsorted(rows[:, 0], spans))[:, 0] > 0  # excluding gaps
    if within.sum() < FEWEST:
        return None
    lidar_turns = turns_of(steps)[within]
    spans = spans[within]
    turned = np.zeros((len(rows), 3))
    turned[1:] = np.cumsum(0.5 * (rows[1:, 1:4] + rows[:-1, 1:4]) * np.diff(rows[:, 0])[:, None], axis=0)

    def imu_turns(ahead_s: float) -> FloatArray:
        begun, ended = (
            np.column_stack([np.interp(spans[:, n] + ahead_s, rows[:, 0], axis) for axis in turned.T])
            for n in (0, 1)
        )
        return np.asarray(ended - begun)

    return lidar_turns, imu_turns


def _apart(lidar_turns: FloatArray, imu_turns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals of rotations (N, 3), the best rotation (3, 3) between them (Kabsch 1976), and their spread.

    Means are subtracted, because the gyroscope has a bias.
    """
    first, second = lidar_turns - lidar_turns.mean(axis=0), imu_turns - imu_turns.mean(axis=0)
    left, _, right = np.linalg.svd(first.T @ second)
    flip = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    rotation = left @ flip @ right
    return first - second @ rotation.T, rotation, second.T @ second


def _unit(rows: FloatArray, steps: Sequence[SensorStep]) -> float:
    """Factor from angular rates to rad/s: total rotation does not depend on clock, sign and axes."""
    turns = _turns(rows, steps)
    if turns is None:
        return 1.0
    seen, own = (float(np.linalg.norm(one.std(axis=0))) for one in (turns[0], turns[1](0.0)))
    ratio = max(own, SETTLED) / max(seen, SETTLED)
    return math.radians(1.0) if abs(math.log(ratio * math.radians(1.0))) < 0.5 else 1.0


def _in_the_plane(
    name: str, T_base_imu: gtsam.Pose3 | None, rows: FloatArray, steps: Sequence[SensorStep], unit: float
) -> list[Finding]:
    """Findings about a gyroscope on a robot that turns only about the vertical axis."""
    fit, turns = turn_fit(rows, steps), _turns(rows, steps)
    if turns is None or float(np.std(turns[0][:, 2])) < IN_ORDER:
        return []
    turned = turns[0][:, 2:] - turns[0][:, 2].mean()
    about = np.zeros_like(turned) if fit is None else turns[1](fit.ahead_s) @ fit.R_lidar_imu[2:].T
    slope = _slope(about, turned)
    remedy: Remedy = {"imus": {name: {"use": False}}}
    unexplained = 0.0 if slope is None else np.abs(turned - slope.values[0] * (about - about.mean())).sum()
    if fit is None or slope is None or 2.0 * unexplained > np.abs(turned).sum():
        text = "its rotation does not agree with the lidar's for any unit, sign, axis or clock"
        return [Finding(name, "no agreement", text, "it misleads", (remedy,), sure=True)]
    found, up = _clock(name, fit), np.median(rows[:, 4:7], axis=0)
    force_m_s2 = np.median(np.linalg.norm(rows[:, 4:7], axis=1))
    if not (weighed := 2.0 * np.linalg.norm(up) > force_m_s2 > 0.5 * GRAVITY_M_S2):
        found += _without_gravity(name, rows)
        up = (T_base_imu or gtsam.Pose3()).rotation().matrix()[2]
    facing = float(fit.R_lidar_imu[2] @ up) / float(np.linalg.norm(up))
    if abs(facing) < 0.5:
        text = f"its rotation axis is not the vertical of its {'accelerometer' if weighed else 'mounting'}"
        return [*found, Finding(name, "axes", text, "it misleads", (remedy,), sure=True)]
    return [*found, *_turn_rates(name, unit, facing, slope)]


def _slope(about: FloatArray, turned: FloatArray) -> Linear | None:
    """Scale of the rotations of an IMU to those of a lidar, both (N, K) about the same axes."""
    about, turned = about - about.mean(axis=0), turned - turned.mean(axis=0)
    return fit_linear(about.reshape(-1, 1), turned.ravel(), np.arange(float(turned.size)))


def _turn_rates(name: str, unit: float, facing: float, slope: Linear | None) -> list[Finding]:
    """Return an error of the angular rates: of unit, sign and scale."""
    scale, sigma = (1.0, 0.0) if slope is None else (slope.values[0], math.sqrt(slope.covariance[0, 0]))
    off = scale > 0.0 and abs(math.log(scale)) > IN_ORDER + math.sqrt(gate()) * sigma / scale
    what = ["in degrees"] if unit != 1.0 else []
    what += ["of the wrong sign"] if facing < 0.0 else []
    what += [f"{1.0 / scale:.2f} times too large"] if off else []
    if not what:
        return []
    factor = math.copysign(unit, facing) * (float(scale) if off else 1.0)
    return [
        Finding(
            name,
            "turn rates",
            f"its turn rates are {' and '.join(what)}",
            "rotations of the robot are wrong",
            ({"imus": {name: {"gyro_scale": float(f"{factor:.6g}")}}},),
            sure=True,
            value=factor,
            interval=interval(factor, sigma * unit),
        )
    ]


def _clock(name: str, fit: TurnFit, untimed_s: float = 0.0) -> list[Finding]:
    """A clock offset to the lidar."""
    half_s = half_interval(fit.ahead_sigma_s)
    return [] if half_s > GAP_S / FEWEST else clock_findings(name, fit.ahead_s, half_s + 0.5 * untimed_s)


def clock_findings(name: str, ahead_s: float, half_s: float) -> list[Finding]:
    """Return that a clock is ahead of the lidar's, unless its interval contains a harmless offset."""
    if abs(ahead_s) <= _CLOCK_S + half_s:
        return []
    return [
        Finding(
            name,
            "clock",
            f"its stamps are {1e3 * ahead_s:+.1f} +- {1e3 * half_s:.1f} ms ahead of the lidar's",
            "clouds are deskewed with the motion of another time",
            ({"imus": {name: {"clock_offset_s": round(ahead_s, 4)}}},),
            sure=True,
            value=ahead_s,
            interval=(ahead_s - half_s, ahead_s + half_s),
        )
    ]


def _sits(name: str, samples: ImuSamples, fit: TurnFit, T_base_lidar: gtsam.Pose3) -> list[Finding]:
    """A rotation that is missing in the log or wrong; the position is not estimated."""
    if not math.isfinite(fit.sigma_rad):
        return []
    rotation = T_base_lidar.rotation().compose(gtsam.Rot3(fit.R_lidar_imu))
    stated, half_rad = samples.T_base_imu, half_interval(fit.sigma_rad)
    place = (T_base_lidar if stated is None else stated).translation()
    mounting = mounting_entry(rotation, place.tolist())
    remedy: Remedy = {"imus": {name: {"T_base_imu": mounting}}}
    interval = f"+- {math.degrees(half_rad):.2f} degrees"
    turns = ", ".join(f"{axis} {mounting[f'{axis}_deg']:.1f}" for axis in ("roll", "pitch", "yaw"))
    angles = f"{turns} {interval}"
    if stated is None:
        text, value = f"the log does not tell how it sits; it turns as if at {angles}, at the lidar", half_rad
    else:
        value = float(np.linalg.norm(gtsam.Rot3.Logmap(stated.rotation().between(rotation))))
        # If the robot hardly turns, the residual is noise, and an interval of tens of degrees is useless.
        if value <= _ANGLE_RAD + half_rad or half_rad >= 2.0 * _ANGLE_RAD:
            return []
        text = f"it turns as if it sat {math.degrees(value):.1f} degrees otherwise: {angles}"
    effect = "its readings are assigned to the wrong axes"
    # Without a stated rotation, one with an error of some degrees is better than none.
    sure = half_rad < (_ANGLE_RAD if stated is not None else 2.0 * _ANGLE_RAD)
    return [Finding(name, "mounting", text, effect, (remedy,), sure=sure, value=math.degrees(value))]


def _frozen(rows: FloatArray, steps: Sequence[SensorStep]) -> BoolArray:
    """Rows (N, 7) bit-identical to the previous one; none unless this lasts while the lidar turns."""
    same = np.append(False, (rows[1:, 1:] == rows[:-1, 1:]).all(axis=1))
    new_s = np.maximum.accumulate(np.where(same, -np.inf, rows[:, 0]))
    hung_s = rows[rows[:, 0] - new_s > GAP_S, 0]
    within = [step for step in steps if np.ptp(np.searchsorted(hung_s, (step.begun_s, step.ended_s)))]
    return same & bool(np.linalg.norm(turns_of(within).sum(axis=0)) > _ANGLE_RAD)


def _without_gravity(name: str, rows: FloatArray) -> list[Finding]:
    """Return that the accelerations in rows (N, 7), if any, are not mostly gravity, or in another unit."""
    force_m_s2 = float(np.median(np.linalg.norm(rows[:, 4:7], axis=1)))
    if 0.5 < force_m_s2 / GRAVITY_M_S2 < 2.0 or not rows[:, 4:7].any():
        return []
    text = f"the median of its accelerations is {force_m_s2:.3g} m/s^2 where gravity is {GRAVITY_M_S2:.1f}"
    remedy: Remedy = {"imus": {name: {"force_scale": 0.0}}}
    return [Finding(name, "forces", text, "poses would be predicted in free fall", (remedy,), sure=True)]


def _saturated(name: str, rows: FloatArray) -> list[Finding]:
    """Saturated readings: the largest value of an axis repeats."""
    found = []
    for what, columns in (("turn rates", rows[:, 1:4]), ("forces", rows[:, 4:7])):
        greatest = np.abs(columns).max()
        count = int(np.count_nonzero(np.abs(columns).max(axis=1) == greatest))
        if count >= FEWEST * 2 and greatest > 0.0 and np.unique(columns).size > FEWEST * FEWEST:
            text = f"{count} of its {what} are the same greatest one, {greatest:.4g}: it saturates"
            found.append(Finding(name, "saturation", text, "its motion is wrong there", value=float(count)))
    return found
