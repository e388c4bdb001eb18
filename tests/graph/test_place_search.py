"""Which stretches are searched at which others where scans lie many metres apart."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.config.stages import GraphConfig, LoopConfig, MatchConfig
from slam.graph.place_search import PlaceSearch
from slam.measurements import BoolArray, FloatArray

# The keyframes of four stretches, the first three of one part of the way.
KEYS, PARTS = np.array([2, 4, 6, 8]), np.repeat([0, 1], [7, 3])


@pytest.mark.parametrize(
    ("untied", "asked"),
    [([], {6: [8], 8: [2, 4, 6]}), ([1], {4: [2, 4, 6, 8], 6: [8], 8: [2, 4, 6]})],
)
def test_a_tied_stretch_is_searched_in_other_parts_alone(
    monkeypatch: pytest.MonkeyPatch, untied: list[int], asked: dict[int, list[int]]
) -> None:
    closer: Any = SimpleNamespace(submaps=None)
    search, told = PlaceSearch(closer, LoopConfig(), MatchConfig(), GraphConfig()), dict[int, list[int]]()
    monkeypatch.setattr(search, "_possible", lambda *_: (np.ones(len(KEYS), np.bool_), np.zeros(len(KEYS))))

    def candidates(number: int, possible: BoolArray, apart_m: FloatArray) -> list[int]:
        told.setdefault(int(KEYS[number]), KEYS[possible].tolist())
        return []

    stretches: Any = SimpleNamespace(keys=KEYS, candidates=candidates, untied=lambda _: untied)
    followed: Any = SimpleNamespace(believed=lambda keys, *_: [] if keys == KEYS[untied].tolist() else None)
    faulty: Any = SimpleNamespace(known=None, loose=None, tied=PARTS)
    assert search._follow(stretches, followed, np.zeros((10, 3)), faulty, []) == []
    assert {key: places for key, places in told.items() if key in asked} == asked
