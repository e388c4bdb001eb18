"""Loops along a bare corridor: believed together, where the estimate leads into the corridor anyway."""

from __future__ import annotations

import numpy as np
import pytest

from slam.config.stages import LoopConfig
from slam.estimates import MotionEstimate
from slam.graph.consistent_sets import ClaimSets
from slam.graph.corridor_claims import CorridorClaims
from slam.graph.loop_candidate import LoopCandidate
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.measurements import FloatArray, pose2_from_row

CONFIG = LoopConfig()
# Twelve metres along a corridor; the same much later; and along one beside it.
KEYS, LATER, BESIDE = 12, 100, 50
SURE, KNOWN, OPEN = (np.diag(sigmas) ** 2 for sigmas in ([0.01] * 3, [2.0, 1.5, 0.05], [30.0, 0.01, 0.003]))


class Corridor:
    """Keyframes along it, as the closer, the stretches and the uncertainty know them."""

    def __init__(
        self, across_m: dict[int, float], length: int = KEYS, share: float = 0.0, determined: int = 0
    ) -> None:
        self.across_m, self.submaps = across_m, self
        self.keys = LATER + np.arange(length)
        poses = np.zeros((200, 3))
        poses[:, 0] = np.arange(200) % BESIDE
        self.poses, self.share, self.determined, self.wide = poses, share, determined, False

    def travelled_m(self, key: int) -> float:
        return float(key)

    def untied(self, loops: list[LoopCandidate], *, bare: bool) -> list[int]:
        assert bare
        return list(range(len(self.keys)))

    def propose(
        self, key: int, poses: FloatArray, known: Corridor, *, wide: bool
    ) -> list[tuple[int, FloatArray]]:
        self.wide = wide
        return [(first + key - LATER, KNOWN) for first in self.across_m]

    def verify(
        self, place: int, key: int, guess: FloatArray, covariance: FloatArray, *, confirming: bool
    ) -> LoopCandidate:
        assert confirming
        pose = guess + np.array([0.7, self.across_m[place // BESIDE * BESIDE], 0.0])
        motion = MotionEstimate(
            pose2_from_row(pose), OPEN, 0.9, 0.9, 0.01, True, key >= LATER + self.determined, np.zeros(3)
        )
        return LoopCandidate(place, key, 3.0, 0.1, 1.0, motion, True, "")

    def motion(self, start: int, end: int, poses: FloatArray) -> Motion:
        return Motion(between(poses[start], poses[end]), SURE if (start < LATER) is (end < LATER) else KNOWN)

    def contradicted(self, members: list[LoopCandidate]) -> float:
        return self.share

    def claims(self) -> CorridorClaims:
        sets = ClaimSets(self.poses, np.arange(200.0), self, 20.0)  # type: ignore[arg-type]
        return CorridorClaims(self, self, self, sets, CONFIG)  # type: ignore[arg-type]

    def believed(self) -> list[LoopCandidate]:
        return self.claims().believed(self.poses, self, [])  # type: ignore[arg-type]


def test_a_corridor_that_is_driven_again_is_closed_across() -> None:
    corridor = Corridor({0: 0.6})
    found = corridor.believed()
    assert corridor.wide and [(loop.place, loop.keyframe) for loop in found] == [
        (n, 100 + n) for n in range(12)
    ]
    assert all(loop.motion is not None and loop.motion.degenerate for loop in found)


@pytest.mark.parametrize(
    ("across_m", "changed"),
    [
        ({0: 2.0}, {}),  # the estimate leads beside it
        ({0: 0.6}, {"length": 6}),  # shorter than two places
        ({0: 0.6}, {"share": 0.2}),
        ({0: 0.6, BESIDE: -0.9}, {}),  # both corridors cannot be this one
    ],
)
def test_no_corridor_is_closed_in_doubt(across_m: dict[int, float], changed: dict[str, float]) -> None:
    assert Corridor(across_m, **changed).believed() == []  # type: ignore[arg-type]


def test_two_passes_that_agree_are_both_closed() -> None:
    assert len(Corridor({0: 0.6, BESIDE: 0.6}).believed()) == 2 * KEYS


@pytest.mark.parametrize(("determined", "expected"), [(1, KEYS - 1), (2, KEYS)])
def test_one_match_alone_does_not_say_where_along_a_corridor(determined: int, expected: int) -> None:
    assert len(Corridor({0: 0.6}, determined=determined).believed()) == expected


def test_what_was_rejected_since_is_not_returned_again() -> None:
    """Otherwise the search, which goes on as long as it finds something, would never end."""
    corridor = Corridor({0: 0.6})
    claims = corridor.claims()
    rejected = [one.refused("GNC") for one in claims.believed(corridor.poses, corridor, [])]  # type: ignore[arg-type]
    assert len(rejected) == KEYS
    assert claims.believed(corridor.poses, corridor, rejected) == []  # type: ignore[arg-type]
