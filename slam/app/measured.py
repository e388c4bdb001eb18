"""Measurements of a program's own as a log: what the mapper reads again and again, from memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from slam.datasets.dataset import ReadReport
from slam.errors import DatasetError
from slam.mapper.protocol import SENSORS
from slam.measurements import Measurement, Trajectory


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
        once = iter(measurements) is measurements
        self._measurements = list(measurements) if once else measurements
        self.name, self.path = name, Path(name)
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
            report.observe(measurement, number)
            if count:
                report.note_share(number / count)
            yield measurement
        if report.measurement_count == 0:
            raise DatasetError("there is no measurement; give scans, clouds or frames")

    def groundtruth(self) -> Trajectory | None:
        """None: a program that knows the truth compares with `slam.evaluate`."""
        return None

    def fingerprint(self) -> str:
        """Digest of the stamps and sensors, by which a map tells what it was made of."""
        digest = hashlib.blake2b(digest_size=16)
        for measurement in self:
            digest.update(f"{measurement.sensor}\0{measurement.stamp_s!r}\0".encode())
        return digest.hexdigest()
