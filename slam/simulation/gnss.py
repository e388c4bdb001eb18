"""Simulates fixes of a moving GNSS receiver: noise, drift, multipath."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.earth import TangentPlane
from slam.measurements import FloatArray, GnssFix
from slam.simulation.sensor_clock import generator

# Origin of every simulated town.
TOWN = TangentPlane(49.0, 8.4, 116.0)
_RATE_HZ = 5.0
# The height error is twice the horizontal one (typical of receivers without corrections).
_UP = 2.0


@dataclass(frozen=True, slots=True)
class GnssFaults:
    """Errors of a receiver.

    Attributes
    ----------
    noise_m, drift_m
        Horizontal sigmas of white noise, and of the drift over ``drift_s`` (Gauss-Markov).
    mirrored_share
        Share of the time with an unreported multipath error of ``mirrored_m``, 5 s each.
    """

    noise_m: float = 0.01
    drift_m: float = 0.01
    drift_s: float = 60.0
    mirrored_share: float = 0.0
    mirrored_m: float = 20.0


def record_gnss(
    antenna_m: FloatArray,
    poses_at: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    faults: GnssFaults,
    end_s: float,
    begin_s: float,
    seed: int,
    home: int,
) -> list[GnssFix]:
    """Return the fixes of a drive, five per second, with the covariance of noise and drift.

    Parameters
    ----------
    antenna_m
        (3,) position of the antenna on the robot.
    poses_at
        Rotations (n, 3, 3) and positions (n, 3) of the robot at times (n,) of the drive; the world's axes are
        east, north, up.
    begin_s
        Stamp of time zero.
    """
    rng = generator(seed, "gnss", home)
    times_s = np.arange(int(end_s * _RATE_HZ) + 1) / _RATE_HZ
    rotations, positions = poses_at(times_s)
    scale = np.array([1.0, 1.0, _UP])
    stays = np.exp(-1.0 / (_RATE_HZ * faults.drift_s))
    drift = rng.normal(size=(len(times_s), 3))
    drift[1:] *= np.sqrt(1.0 - stays**2)
    for n in range(1, len(drift)):
        drift[n] += stays * drift[n - 1]
    errors_m = scale * (faults.drift_m * drift + faults.noise_m * rng.normal(size=drift.shape))
    blocks = (times_s // 5.0).astype(np.int64)
    for block in np.flatnonzero(rng.random(blocks[-1] + 1) < faults.mirrored_share):
        bearing = rng.uniform(-np.pi, np.pi)
        errors_m[blocks == block, :2] += faults.mirrored_m * np.array([np.cos(bearing), np.sin(bearing)])
    variance = (faults.noise_m**2 + faults.drift_m**2) * np.diag(scale**2)
    return [
        GnssFix(begin_s + time_s, *TOWN.geodetic(place), variance, antenna_m)
        for time_s, place in zip(times_s.tolist(), positions + rotations @ antenna_m + errors_m, strict=True)
    ]
