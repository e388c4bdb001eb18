"""Evidence of several stations for a pose, and what it makes of rival poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from slam.measurements import FloatArray, MotionEstimate

P = TypeVar("P")

# An alignment may correct a hypothesis by so much a station; what moves farther is another place.
_GREATEST_CORRECTION_M, _GREATEST_CORRECTION_RAD = 0.3, 0.15
# Hypotheses nearer than this are one.
_SAME_M, _SAME_RAD = 0.3, 0.15
# A hypothesis this much worse than the best is dropped, in nats.
_HOPELESS_NATS = 15.0


@dataclass(slots=True)
class Hypothesis(Generic[P]):
    """A pose that may be the robot's.

    Attributes
    ----------
    pose
        ``T_map_base`` at the newest station.
    evidence
        Nats by station, oldest first, as many as there are stations.
    motion
        The alignment of the newest station; None where there was nothing to align to.
    prior
        Nats in favour before anything was seen.
    """

    pose: P
    evidence: list[float]
    motion: MotionEstimate | None
    prior: float = 0.0

    def total(self, kidnap_nats: float) -> float:
        """Evidence of the way, or of its end alone if the robot was carried off in between."""
        return self.prior + way_nats(self.evidence, kidnap_nats)


def way_nats(evidence: Sequence[float], kidnap_nats: float) -> float:
    """Evidence of a way, station by station, or of its end alone if the robot was carried off in between."""
    whole = best = 0.0
    for nats in reversed(evidence):
        whole += nats
        best = max(best, whole)
    return max(whole, best - kidnap_nats)


def posterior(totals: FloatArray, nowhere_nats: float) -> FloatArray:
    """Probabilities of hypotheses (N,) by their evidence; what is left to one is that of none being right."""
    greatest = max(nowhere_nats, totals.max(initial=-math.inf))
    weights = np.exp(totals - greatest)
    return np.asarray(weights / (weights.sum() + math.exp(nowhere_nats - greatest)))


def pruned(
    members: Sequence[Hypothesis[P]], most: int, kidnap_nats: float, same: Callable[[P, P], bool]
) -> list[Hypothesis[P]]:
    """The likeliest first, without another's double, the hopeless, and what is beyond so many.

    Parameters
    ----------
    same
        Whether two poses are one place.
    """
    totals = [member.total(kidnap_nats) for member in members]
    kept: list[Hypothesis[P]] = []
    for n in sorted(range(len(totals)), key=lambda n: -totals[n]):
        if len(kept) == most or totals[n] < max(totals) - _HOPELESS_NATS:
            break
        if not any(same(members[n].pose, other.pose) for other in kept):
            kept.append(members[n])
    return kept


def is_correction(moved_m: float, turned_rad: float) -> bool:
    """Whether an alignment corrects the pose that it began at, and has not found another place."""
    return moved_m <= _GREATEST_CORRECTION_M and turned_rad <= _GREATEST_CORRECTION_RAD


def is_same_place(apart_m: float, turned_rad: float) -> bool:
    """Whether two poses so far apart are one hypothesis."""
    return apart_m < _SAME_M and turned_rad < _SAME_RAD
