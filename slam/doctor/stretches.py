"""Which readings of a long log are looked at: stretches of even length, spread over it as it goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fusion.time_alignment import GAP_S

# Seconds of a stretch, stretches that are kept: between half as many and so many.
LASTS_S, MOST = 2.0, 12
# Readings lie no nearer: ten a second, with slack for stamps that jitter.
_LEAST_STEP_S = 0.09


@dataclass(slots=True)
class Stretches:
    """Says which readings belong to a stretch.

    A stretch follows the other; of a log that is long every second is left out, then of the rest, and so on.

    Attributes
    ----------
    begins
        Whether the reading that was last wanted begins a stretch.
    thinned
        Whether, as it began, every second of those before was given up.
    """

    begins: bool = False
    thinned: bool = False
    _begun_s: float = -math.inf
    _newest_s: float = -math.inf
    _number: int = -1
    _stride: int = 1

    def choose(self, stamps_s: Sequence[float]) -> list[bool]:
        """Which of the next readings are looked at and not given up again when the last of them has come."""
        looked_at = [(self.wants(stamp_s), self._number) for stamp_s in stamps_s]
        return [wanted and number % self._stride == 0 for wanted, number in looked_at]

    def wants(self, stamp_s: float) -> bool:
        """Whether the reading of a stamp is looked at."""
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
