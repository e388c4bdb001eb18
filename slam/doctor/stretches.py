"""Chooses readings of a long log: stretches of equal length, spread evenly over the log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fusion.time_alignment import GAP_S

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
