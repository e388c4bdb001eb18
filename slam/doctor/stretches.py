"""Chooses readings of a long log: stretches of equal length, spread evenly over the log.

Detects repeated readings: the sensor is stuck, or readings are sent twice.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fusion.estimation import FEWEST
from fusion.time_alignment import GAP_S
from slam.config.stages import KeyframeConfig
from slam.datasets.corrections import repeats
from slam.doctor.finding import Finding
from slam.measurements import FloatArray, Measurement

# Duration of a stretch in s, and maximum number of stretches (at least half of it are kept).
LASTS_S, MOST = 2.0, 12
# Minimum interval of readings: 10 Hz, with a margin for jitter of stamps.
_LEAST_STEP_S = 0.09


@dataclass(slots=True)
class Stretches:
    """Decides which readings belong to a stretch.

    Stretches are consecutive; in a long log, every second one is dropped, then every second of the rest, etc.

    Attributes
    ----------
    begins
        Whether the last chosen reading starts a stretch.
    thinned
        Whether every second of the earlier stretches was dropped when it started.
    """

    begins: bool = False
    thinned: bool = False
    _begun_s: float = -math.inf
    _newest_s: float = -math.inf
    _number: int = -1
    _stride: int = 1

    def choose(self, stamps_s: Sequence[float]) -> list[bool]:
        """Which of the next readings are chosen, and still kept after the last of them."""
        looked_at = [(self.wants(stamp_s), self._number) for stamp_s in stamps_s]
        return [wanted and number % self._stride == 0 for wanted, number in looked_at]

    def wants(self, stamp_s: float) -> bool:
        """Whether the reading with this stamp is chosen."""
        since_s = stamp_s - self._newest_s
        self.begins = self.thinned = False
        if not 0.0 <= since_s < 2.0 * GAP_S or stamp_s - self._begun_s > LASTS_S:
            self._number += 1
            self._begun_s = self._newest_s = stamp_s
            if self._number % self._stride:
                return False
            self.begins = True
            if self._number // self._stride >= MOST:
                self.thinned = True
                self._stride *= 2
            return True
        if self._number % self._stride:
            self._newest_s = stamp_s
            return False
        if since_s < _LEAST_STEP_S:
            return False
        self._newest_s = stamp_s
        return True


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
