"""Measurements of a program as a log, which the mapper reads several times from memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets.dataset import ReadReport
from slam.errors import DatasetError, MapFileError
from slam.estimates import Trajectory
from slam.mapper.protocol import SENSORS
from slam.measurements import LaserScan, Measurement, RgbdFrame, WheelOdometry
from slam.storage.map_soundness import require, sound, sound_stamp


class Measured:
    """Measurements as a dataset; see `slam.datasets.dataset.Dataset`.

    Parameters
    ----------
    measurements
        In the order in which they came. What can be iterated only once is gathered in memory first.
    name
        For people.
    """

    def __init__(self, measurements: Iterable[Measurement], name: str = "measurements") -> None:
        if not isinstance(measurements, Iterable) or isinstance(measurements, str):
            raise DatasetError(f"{measurements!r} is no list of measurements; slam.map_log maps a log")
        once = iter(measurements) is measurements
        self._measurements = list(measurements) if once else measurements
        # It lies in no file, whatever files there are.
        self.name, self.path = name, Path("memory:") / name
        self.report = ReadReport()

    def __iter__(self) -> Iterator[Measurement]:
        """The measurements, with a new report.

        Raises
        ------
        DatasetError
            There is none, or something that is no measurement.
        """
        report = self.report = ReadReport()
        count = len(self._measurements) if isinstance(self._measurements, Sequence) else 0
        for number, measurement in enumerate(self._measurements, start=1):
            if not isinstance(measurement, Measurement) and type(measurement) not in SENSORS:
                kind = type(measurement).__name__
                raise DatasetError(f"number {number} is a {kind}; give scans, wheels, clouds or frames")
            measurement = checked(measurement, number)
            report.observe(measurement, number)
            if count:
                report.note_share(number / count)
            yield measurement
        if report.measurement_count == 0:
            raise DatasetError("there is no measurement; give scans, clouds or frames")

    def groundtruth(self) -> Trajectory | None:
        """None: a program that knows the truth compares with `slam.evaluate`."""
        return None


def _with_arrays(measurement: Any, number: int) -> Any:
    """The measurement with arrays of the types that a map keeps, made of lists and other numbers."""
    if not isinstance(measurement, Measurement):
        return measurement
    pose = getattr(measurement, "T_odom_base", None)
    if isinstance(measurement, WheelOdometry) and not isinstance(pose, gtsam.Pose2):
        raise DatasetError(f"number {number}: T_odom_base is {pose!r}; give gtsam.Pose2(x_m, y_m, yaw_rad)")
    changed: dict[str, Any] = {}
    singles = (("ranges_m", 1), ("points_lidar", 2), ("intensities", 1), ("depth_m", 2))
    doubles = (("times_s", 1), ("gyro_rad_s", 1), ("specific_force_m_s2", 1))
    kinds = ((np.float32, singles), (np.float64, doubles), (np.uint8, (("color", 3),)))
    for kind, name, axes in ((kind, *one) for kind, names in kinds for one in names):
        given = getattr(measurement, name, None)
        needed = name in ("ranges_m", "points_lidar", "depth_m") and hasattr(measurement, name)
        if (given is None and not needed) or (
            isinstance(given, np.ndarray) and given.dtype == kind and given.ndim == axes
        ):
            continue
        found = np.asarray(given)
        if found.dtype.kind not in ("iu" if kind == np.uint8 else "iuf") or found.ndim != axes:
            told = f"{name} is {found.dtype}{list(found.shape)}"
            raise DatasetError(f"number {number}: {told}; give {np.dtype(kind)} of {axes} dimension(s)")
        changed[name] = found.astype(kind)
    return replace(measurement, **changed) if changed else measurement


def checked(measurement: Any, number: int) -> Any:
    """The measurement with such arrays, if its values are such as sensors give."""
    measurement = _with_arrays(measurement, number)
    try:
        sound_stamp(measurement.stamp_s)
        if isinstance(measurement, LaserScan):
            sound(measurement)
            turn_rad = measurement.step_rad * (measurement.ranges_m.size - 1)
            require(turn_rad < 7, f"its beams span {turn_rad:.4g} rad")  # a turn, and what is rounded
        if isinstance(measurement, RgbdFrame):
            sound(lens := measurement.intrinsics)
            color, depth = measurement.color.shape, measurement.depth_m.shape
            alike = color == (*depth, 3) and (lens.height, lens.width) in (depth, (0, 0))
            require(alike, f"colour {color}, depth {depth}, lens {(lens.height, lens.width)}: other sizes")
    except MapFileError as error:
        kind = type(measurement).__name__
        raise DatasetError(f"number {number}: {error}; help(slam.{kind}) tells what belongs there") from None
    return measurement
