"""Detects repeated readings: the sensor is stuck, or readings are sent twice."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from fusion.estimation import FEWEST
from slam.config.stages import KeyframeConfig
from slam.datasets.corrections import repeats
from slam.doctor.finding import Finding
from slam.measurements import FloatArray, Measurement


@dataclass(slots=True)
class Repeats:
    """Number of readings that are bit-identical to the previous one, with start and end of each run."""

    count: int = 0
    _runs_s: array[float] = field(default_factory=lambda: array("d"))

    def take(self, newest: Measurement | None, reading: Measurement) -> bool:
        """Add a reading; returns whether it repeats the newest one."""
        if newest is None or not repeats(newest, reading):
            return False
        self.count += 1
        if self._runs_s and self._runs_s[-2] == newest.stamp_s:
            self._runs_s[-1] = reading.stamp_s
        else:
            self._runs_s.extend((newest.stamp_s, reading.stamp_s))
        return True

    def driven(self, rows: FloatArray) -> bool:
        """Whether the wheels move during a run; (N, 4) stamps, x, y, unwrapped headings."""
        if not (self._runs_s and len(rows)):
            return False
        poses = np.stack([np.interp(self._runs_s, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)
        return any(KeyframeConfig().due(*moved) for moved in (poses[1::2] - poses[::2]).tolist())

    def findings(self, kind: str, name: str, count: int, what: str, *, enough: bool) -> list[Finding]:
        """Findings for ``count`` readings; if few repeats are not ``enough``, most readings must repeat."""
        if self.count < (1 if enough else max(FEWEST, count // 2 + 1)):
            return []
        same = "identical to the one before" + (", or have its stamp" if what == "clouds" else "")
        return [
            Finding(
                name,
                f"repeated {what}",
                f"{self.count} of {count} {what} are {same}",
                "the robot seems to stand still",
                ({kind: {name: {"drop_repeated": True}}},),
                sure=self.count + 1 < count,  # otherwise nothing would be left
                value=self.count / count,
            )
        ]
