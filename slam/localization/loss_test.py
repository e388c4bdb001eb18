"""Test how long a tracked pose is accepted, until the readings contradict it (Page 1954)."""

from __future__ import annotations

import math

from slam.config.localization import LocalizationConfig

# Evidence of one reading is at most so many nats: a person may be in front of the sensor.
_GREATEST_NATS = 2.0


class LossTest:
    """Log-odds of the pose: a bounded sum of evidence, so that doubt is not delayed."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._bound = config.lost_nats
        self._lost_after_s = config.lost_after_s
        self._moment_nats = config.nowhere_nats
        self.reset(self._bound)

    @property
    def lost(self) -> bool:
        """Return whether the pose has been contradicted for long enough."""
        return self._log_odds <= 0.0 and abs(self._stamp_s - self._sound_s) >= self._lost_after_s

    @property
    def confidence(self) -> float:
        """Return the probability of the pose; one contradicting reading causes doubt, but not loss.

        A recently correct pose has a prior in its favour against the newest reading.
        """
        return 0.5 + 0.5 * math.tanh(0.5 * self._balance)

    @property
    def doubted(self) -> bool:
        """Return whether the pose is more likely wrong than correct."""
        return self._balance < 0.0

    @property
    def _balance(self) -> float:
        """Return the evidence for the pose in nats."""
        return min(self._log_odds, self._newest + self._moment_nats)

    def reset(self, log_odds: float) -> None:
        """Restart with a pose that was just found or given, with this probability."""
        self._log_odds = min(self._bound, log_odds)
        self._newest = self._bound
        self._sound_s = math.nan
        self._stamp_s = math.nan

    def add(self, stamp_s: float, evidence: float, new_share: float = 1.0) -> None:
        """Add the evidence of a reading for the pose, nats.

        Parameters
        ----------
        new_share
            Share of it that is new compared with the last reading: two readings from one place count once.
        """
        self._stamp_s, self._newest = stamp_s, evidence
        added = min(max(new_share * evidence, -_GREATEST_NATS), _GREATEST_NATS)
        self._log_odds = min(self._bound, self._log_odds + added)
        if self._log_odds == self._bound or math.isnan(self._sound_s):
            self._sound_s = stamp_s
