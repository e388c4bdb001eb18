"""Simulates an IMU on a moving body, and writes its files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml
from scipy import spatial

from slam.measurements import GRAVITY_M_S2, FloatArray
from slam.simulation import ros_messages as ros
from slam.simulation.sensor_clock import generator, schedule
from slam.storage.files import write_lines

# Function from times (N,) to rotations (N, 3, 3) and positions (N, 3) of a body in a map with z up.
PosesAt = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


@dataclass(frozen=True, slots=True)
class ImuModel:
    """A gyroscope and an accelerometer.

    Attributes
    ----------
    rate_hz
        Readings per second.
    gyro_density, force_density
        White noise density in rad/s and m/s^2 per square root of a hertz.
    gyro_walk, force_walk
        Random walk of the biases, in rad/s and m/s^2 per square root of a second.
    most_gyro_rad_s, most_force_m_s2
        Range limit of an axis.
    """

    rate_hz: float
    gyro_density: float = 0.0
    force_density: float = 0.0
    gyro_walk: float = 0.0
    force_walk: float = 0.0
    most_gyro_rad_s: float = np.inf
    most_force_m_s2: float = np.inf


# The sensor of EuRoC (Burri et al. 2016): noise by its sensor.yaml, ranges by the data sheet, 1000 degrees/s
# and 18 g.
ADIS_16448 = ImuModel(200.0, 1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3, np.radians(1000.0), 18.0 * GRAVITY_M_S2)


@dataclass(frozen=True, slots=True)
class MountedImu:
    """An IMU and its mounting on the body with known poses."""

    model: ImuModel
    T_body_imu: gtsam.Pose3


@dataclass(frozen=True, slots=True)
class ImuFaults:
    """Errors of an IMU.

    Attributes
    ----------
    gyro_bias_rad_s, force_bias_m_s2
        Length of the biases when it is switched on; their direction is drawn.
    clock_offset_s
        Offset of its clock, positive if ahead.
    gyro_excess
        Scale error of its angular rates.
    """

    gyro_bias_rad_s: float = 0.0
    force_bias_m_s2: float = 0.0
    clock_offset_s: float = 0.0
    gyro_excess: float = 0.0


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """All readings of a drive.

    Attributes
    ----------
    true_s
        (N,) seconds since the drive began.
    stamps_s
        (N,) stamps by the IMU's clock.
    gyro_rad_s, specific_force_m_s2
        (N, 3) IMU frame.
    """

    true_s: FloatArray
    stamps_s: FloatArray
    gyro_rad_s: FloatArray
    specific_force_m_s2: FloatArray

    def messages(self, first_stamp_s: float, frame: str) -> Iterator[tuple[float, Any]]:
        """Yield arrival time in a bag, seconds, and message of each reading."""
        rows = zip(
            self.true_s.tolist(),
            self.stamps_s.tolist(),
            self.gyro_rad_s,
            self.specific_force_m_s2,
            strict=True,
        )
        for true_s, stamp_s, gyro, force in rows:
            yield first_stamp_s + true_s, ros.imu(stamp_s, gyro, force, frame)


def record_imu(
    imu: MountedImu,
    poses_at: PosesAt,
    faults: ImuFaults,
    duration_s: float,
    first_stamp_s: float,
    seed: int,
    *stream: int,
) -> ImuRecord:
    """Simulate the readings of a drive.

    A reading is the mean over its period, as of a sensor with an internal filter.

    Parameters
    ----------
    poses_at
        Poses of the body, twice differentiable, slightly beyond the drive at both ends.
    first_stamp_s
        True time when the drive begins.
    stream
        Additional numbers, beside the seed, on which the noise depends.
    """
    model, period_s = imu.model, 1.0 / imu.model.rate_hz
    rng = generator(seed, "imu", *stream)
    times = schedule(
        "imu", model.rate_hz, duration_s, first_stamp_s, seed, clock_offset_s=faults.clock_offset_s
    )
    gyro, force = _felt(poses_at, imu.T_body_imu, times.true_s, 0.5 * period_s)
    gyro *= 1.0 + faults.gyro_excess
    for signal, density, walk, bias, most in (
        (gyro, model.gyro_density, model.gyro_walk, faults.gyro_bias_rad_s, model.most_gyro_rad_s),
        (force, model.force_density, model.force_walk, faults.force_bias_m_s2, model.most_force_m_s2),
    ):
        towards = rng.standard_normal(3)
        signal += bias * towards / np.linalg.norm(towards)
        signal += walk * period_s**0.5 * np.cumsum(rng.standard_normal(signal.shape), axis=0)
        signal += density / period_s**0.5 * rng.standard_normal(signal.shape)
        np.clip(signal, -most, most, out=signal)
    return ImuRecord(times.true_s, times.stamps_s, gyro, force)


def write_euroc(folder: Path, record: ImuRecord, T_base_imu: gtsam.Pose3) -> None:
    """Write ``data.csv`` in the format of EuRoC, and the IMU's mounting in ``calibration.yaml``."""
    folder.mkdir()
    rows = np.hstack([record.gyro_rad_s, record.specific_force_m_s2]).tolist()
    lines = [
        f"{round(stamp_s * 1e6)}000," + ",".join(f"{value:.9g}" for value in row)
        for stamp_s, row in zip(record.stamps_s.tolist(), rows, strict=True)
    ]
    write_lines(folder / "data.csv", [_HEAD, *lines])
    turn = spatial.transform.Rotation.from_matrix(T_base_imu.rotation().matrix()).as_quat()
    mounting = {"translation_m": T_base_imu.translation().tolist(), "quaternion_xyzw": turn.tolist()}
    write_lines(folder / "calibration.yaml", yaml.safe_dump({"T_base_imu": mounting}).splitlines())


def _felt(
    poses_at: PosesAt, T_body_imu: gtsam.Pose3, times_s: FloatArray, half_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return angular rates and specific forces (N, 3), by differences over one period."""
    turned, places = [], []
    for late_s in (-half_s, 0.0, half_s):
        rotations, positions = poses_at(times_s + late_s)
        turned.append(rotations @ T_body_imu.rotation().matrix())
        places.append(positions + rotations @ T_body_imu.translation())
    (before, now, after), (behind, here, ahead) = turned, places
    steps = before.transpose(0, 2, 1) @ after
    gyro: FloatArray = spatial.transform.Rotation.from_matrix(steps).as_rotvec() / (2.0 * half_s)
    force = (ahead - 2.0 * here + behind) / half_s**2 + [0.0, 0.0, GRAVITY_M_S2]
    return gyro, np.einsum("nji,nj->ni", now, force)
