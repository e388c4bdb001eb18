"""Stretches of a run's way, each with what is seen along it, and which of them look alike."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from fusion.estimation import FEWEST
from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.loop_closure import LoopCandidate
from slam.graph.submaps import SubmapStore
from slam.matching.correlative import SearchResult, build_field, search_window
from slam.matching.hough_spectrum import SpectrumBank, hough_spectrum
from slam.measurements import BoolArray


class Stretches:
    """Overlapping stretches, in the order of the way.

    Attributes
    ----------
    keys
        (K,) the keyframe in the middle of each.
    spacing_m
        Way from one middle to the next.
    """

    def __init__(self, submaps: SubmapStore, config: LoopConfig, match: MatchConfig) -> None:
        self._config, self._match, self._submaps = config, match, submaps
        way_m = np.array([submaps.travelled_m(key) for key in range(len(submaps))])
        self.spacing_m = 0.5 * config.reach_m
        middles_m = np.arange(0.0, way_m[-1] + config.reach_m, self.spacing_m)
        self.keys = np.unique(np.searchsorted(way_m, np.minimum(middles_m, way_m[-1])))
        self._way_m = way_m[self.keys]
        self._runs = [submaps.run(key) for key in self.keys.tolist()]

    def untied(self, loops: Sequence[LoopCandidate]) -> list[int]:
        """The stretches that no loop ties to an earlier place, and that could tell one."""
        ends = np.sort([self._submaps.travelled_m(loop.keyframe) for loop in loops if loop.accepted])
        ends = np.concatenate([[-np.inf], ends, [np.inf]])
        after = np.searchsorted(ends, self._way_m)
        apart_m = np.minimum(self._way_m - ends[after - 1], ends[after] - self._way_m)
        return np.flatnonzero((apart_m > self._config.reach_m) & self._determined).tolist()

    def between(self, first_m: float, last_m: float) -> list[int]:
        """Keyframes in the middle of those stretches within a part of the way that could tell a place."""
        within = (self._way_m >= first_m) & (self._way_m <= last_m) & self._determined
        return self.keys[within].tolist()

    def alike(self, number: int, possible: BoolArray) -> list[int]:
        """Earlier stretches that look most like one, the best of each neighbourhood.

        Parameters
        ----------
        possible
            (K,) those that are not ruled out.
        """
        way_m, config = self._way_m, self._config
        earlier = way_m[number] - way_m > config.least_path_m
        (others,) = np.nonzero(possible & earlier & self._determined)
        likeness = self._bank.likeness(number, others)
        chosen: list[int] = []
        for other in others[np.argsort(-likeness, kind="stable")].tolist():
            if len(chosen) == config.near:
                break
            if all(abs(way_m[other] - way_m[one]) > config.reach_m for one in chosen):
                chosen.append(other)
        return chosen

    def search(self, place: int, number: int) -> SearchResult:
        """The pose of the middle of a stretch in the frame of that of another, over the full turn."""
        match = self._match
        return search_window(
            build_field(self._runs[place].points, 2.0 * match.cell_m, match.coarse_cell_m),
            self._runs[number].thinned(match.search_points),
            np.zeros(3),
            self.window_m,
            np.pi,
            match.search_least_score,
        )

    @property
    def window_m(self) -> float:
        """Half size of the window of a search: two stretches that overlap."""
        return 2.0 * self._config.reach_m

    @cached_property
    def _determined(self) -> BoolArray:
        """(K,) whether the walls of a stretch face more than one way: along a bare corridor all is alike."""
        least = []
        for run in self._runs:
            spread = run.normals.astype(np.float64).T @ run.normals
            least.append(np.linalg.eigvalsh(spread)[0] / max(len(run), 1) if len(run) >= FEWEST else 0.0)
        return np.asarray(np.array(least) > self._match.degenerate_share)

    @cached_property
    def _bank(self) -> SpectrumBank:
        """How all of them look."""
        bin_m = self._match.coarse_cell_m
        return SpectrumBank([hough_spectrum(run.points, run.normals, bin_m) for run in self._runs])
