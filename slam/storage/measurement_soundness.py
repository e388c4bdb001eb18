"""Checks of a measurement that a program gives: arrays of the right types, values that a sensor can give."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from fusion.checks import numbers
from slam.errors import DatasetError, MapFileError
from slam.measurements import LaserScan, Measurement, PointCloud, RgbdFrame
from slam.storage.map_soundness import require, sound

_ARRAYS: dict[str, tuple[Any, ...]] = {  # type and shape by field; None is any length
    "ranges_m": ("f4", None),
    "depth_m": ("f4", None, None),
    "color": ("u1", None, None, 3),
    "points_lidar": ("f4", None, 3),
    "intensities": ("f4", None),
    "times_s": ("f8", None),
    "gyro_rad_s": ("f8", 3),
    "specific_force_m_s2": ("f8", 3),
    "covariance_m2": ("f8", 3, 3),
    "antenna_m": ("f8", 3),
}
_OPEN = ("ranges_m", "depth_m", "intensities")  # NaN and infinity have a meaning there


def checked(measurement: Any, name: str) -> Any:
    """Return a measurement with arrays of the types that a map keeps, if its values are possible.

    Raises
    ------
    DatasetError
        If it is no measurement, or has a field that no sensor gives; the message begins with ``name``.
    """
    kind = type(measurement).__name__
    if not isinstance(measurement, Measurement):
        raise DatasetError(f"{name} is a {kind}; give scans, wheels, clouds or frames")
    measurement = _with_arrays(measurement, name)
    try:
        sound(measurement)
        if isinstance(measurement, LaserScan):
            turn_rad = measurement.step_rad * (measurement.ranges_m.size - 1)
            require(turn_rad < 7, f"its beams span {turn_rad:.4g} rad")  # a turn, and what is rounded
            require(turn_rad > 0.0 or measurement.ranges_m.size == 1, "its step_rad is 0")
        if isinstance(measurement, RgbdFrame):
            lens, color, depth = measurement.intrinsics, measurement.color.shape, measurement.depth_m.shape
            fits = color == (*depth, 3) and (lens.height, lens.width) in (depth, (0, 0))
            require(fits, f"colour {color}, depth {depth}, lens {(lens.height, lens.width)}: other sizes")
        if isinstance(measurement, PointCloud):
            optional = (measurement.times_s, measurement.intensities)
            lengths = [len(values) for values in optional if values is not None]
            points = len(measurement.points_lidar)
            require(set(lengths) <= {points}, f"{points} points, and times or intensities of {lengths}")
    except MapFileError as error:
        raise DatasetError(f"{name}: {error}; help(slam.{kind}) shows what it must be") from None
    return measurement


def _with_arrays(measurement: Any, name: str) -> Any:
    """Return the measurement with arrays of the types that a map keeps, made of lists and other numbers."""
    changed: dict[str, Any] = {}
    for item in fields(measurement):
        value = getattr(measurement, item.name)
        if item.name not in _ARRAYS or (value is None and item.default is None):
            continue
        kind, *shape = _ARRAYS[item.name]
        try:
            array = numbers(value, tuple(shape), item.name, finite=item.name not in _OPEN)
        except ValueError as fault:
            raise DatasetError(f"{name}: {fault}") from None
        if kind == "u1" and (array.dtype.kind == "f" or array.max(initial=0) > 255):
            raise DatasetError(f"{name}: {item.name} is {array.dtype}; give uint8 of 0 to 255")
        if item.name == "depth_m" and array.dtype == np.uint16:
            raise DatasetError(
                f"{name}: {item.name} is uint16, as files in millimetres; give metres as float32"
            )
        if item.name == "ranges_m" and np.isneginf(array).any():
            array = np.where(np.isneginf(array), np.nan, array)  # nearer than the least range (REP-117)
        if array is not value or array.dtype != kind:
            changed[item.name] = array.astype(kind)
    return replace(measurement, **changed) if changed else measurement
