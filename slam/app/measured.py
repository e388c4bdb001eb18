"""Measurements of a program as a log, which the mapper reads several times from memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from slam.datasets.dataset import ReadReport
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.mapper.protocol import SENSORS
from slam.measurements import Measurement
from slam.storage.measurement_soundness import checked


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
            if type(measurement) not in SENSORS:
                measurement = checked(measurement, f"number {number}")
            report.observe(measurement, number)
            if count:
                report.note_share(number / count)
            yield measurement
        if report.measurement_count == 0:
            raise DatasetError("there is no measurement; give scans, clouds or frames")

    def groundtruth(self) -> Trajectory | None:
        """None: a program that knows the truth compares with `slam.evaluate`."""
        return None
