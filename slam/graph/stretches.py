"""Stretches of a path, each with what the sensors saw along it, and which of them look alike."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.submaps import SubmapStore
from slam.matching.correlative import SearchResult, search_window
from slam.matching.hough_spectrum import SpectrumBank, hough_spectrum
from slam.measurements import BoolArray, FloatArray


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
        self.spacing_m = submaps.wide_m(0.5 * config.reach_m, 1.0)
        # Scans so far apart that each pass sees a place once look alike too often for the likest few.
        self._most = config.near * (3 if self.spacing_m > config.reach_m else 1)
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

    def candidates(self, number: int, possible: BoolArray, apart_m: FloatArray) -> list[int]:
        """Earlier stretches that may be seen again in one: the likest, and the nearest by the estimate.

        Parameters
        ----------
        possible
            (K,) those that are not ruled out.
        apart_m
            (K,) their distance by the estimate.
        """
        earlier = self._way_m[number] - self._way_m > self._submaps.least_path_m
        (others,) = np.nonzero(possible & earlier & self._determined)
        likest = others[np.argsort(-self._bank.likeness(number, others), kind="stable")]
        near = others[apart_m[others] <= self.window_m]
        nearest = near[np.argsort(apart_m[near], kind="stable")]
        return [*dict.fromkeys([*self._of_neighbourhoods(likest), *self._of_neighbourhoods(nearest)])]

    def _of_neighbourhoods(self, ordered: NDArray[np.int64]) -> list[int]:
        """The first of each neighbourhood, as many as are tried."""
        chosen: list[int] = []
        for other in ordered.tolist():
            if len(chosen) == self._most:
                break
            if all(abs(self._way_m[other] - self._way_m[one]) > self._config.reach_m for one in chosen):
                chosen.append(other)
        return chosen

    def search(self, place: int, number: int) -> SearchResult:
        """The pose of the middle of a stretch in the frame of that of another, over the full turn."""
        match = self._match
        return search_window(
            self._submaps.field(int(self.keys[place])),
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
        return SpectrumBank(hough_spectrum(run.points, run.normals, bin_m) for run in self._runs)
