"""Simulates firing times and stamps of a sensor, and its lost readings."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from slam.measurements import BoolArray, FloatArray

# Jitter is clipped, so that the order of readings and stamps does not change.
_PERIOD_JITTER_LIMIT, _STAMP_JITTER_LIMIT = 0.2, 0.25  # of a period
_MICROSECOND = 6  # digits, as in file names and logs, so that all forms of a stamp agree


@dataclass(frozen=True, slots=True)
class Schedule:
    """All readings of one sensor on one drive.

    Attributes
    ----------
    sensor
        Its name.
    true_s
        (N,) firing times since the start, seconds, increasing.
    stamps_s
        (N,) stamps by its clock, increasing; whole microseconds.
    kept
        (N,) whether the reading arrives.
    clock_offset_s
        Offset of the clock from the true time, positive if ahead.
    """

    sensor: str
    true_s: FloatArray
    stamps_s: FloatArray
    kept: BoolArray
    clock_offset_s: float


def generator(seed: int, sensor: str, *stream: int) -> np.random.Generator:
    """Create the random generator of a sensor, so that disabling one sensor changes no other."""
    return np.random.default_rng([seed, zlib.crc32(sensor.encode()), *stream])


def schedule(
    sensor: str,
    rate_hz: float,
    duration_s: float,
    first_stamp_s: float,
    seed: int,
    *,
    clock_offset_s: float = 0.0,
    period_jitter_s: float = 0.0,
    stamp_jitter_s: float = 0.0,
    dropped_share: float = 0.0,
    dead_s: tuple[float, float] | None = None,
) -> Schedule:
    """Create the schedule of a free-running sensor: it starts anywhere within its first period.

    Parameters
    ----------
    first_stamp_s
        True time when the drive begins.
    dead_s
        Times when the sensor fails and recovers, seconds since the start.
    """
    period_s = 1.0 / rate_hz
    rng = generator(seed, sensor, 0)
    phase_s = period_s * float(rng.uniform(_PERIOD_JITTER_LIMIT, 1.0 - _PERIOD_JITTER_LIMIT))
    count = max(0, int(np.ceil((duration_s - phase_s) * rate_hz)))
    even_s = phase_s + period_s * np.arange(count, dtype=np.float64)
    noise = rng.standard_normal((count, 2))
    fires = np.clip(period_jitter_s * noise[:, 0], -_PERIOD_JITTER_LIMIT * period_s, None)
    true_s: FloatArray = even_s + np.minimum(fires, _PERIOD_JITTER_LIMIT * period_s)
    limit = _STAMP_JITTER_LIMIT * period_s
    missed = np.clip(stamp_jitter_s * noise[:, 1], -limit, limit)
    kept = rng.random(count) >= dropped_share
    if dead_s is not None:
        kept &= (true_s < dead_s[0]) | (true_s >= dead_s[1])
    stamps_s: FloatArray = np.round(first_stamp_s + true_s + clock_offset_s + missed, _MICROSECOND)
    inside = true_s <= duration_s
    return Schedule(sensor, true_s[inside], stamps_s[inside], kept[inside], clock_offset_s)
