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
from slam.matching.local_map import OrientedPoints
from slam.measurements import BoolArray, FloatArray


class Stretches:
    """Overlapping stretches, in path order.

    Attributes
    ----------
    keys
        (K,) the keyframe in the middle of each.
    spacing_m
        Path length from one middle to the next.
    """

    def __init__(self, submaps: SubmapStore, config: LoopConfig, match: MatchConfig) -> None:
        self._config, self._match, self._submaps = config, match, submaps
        path_m = submaps.ways_m()
        self.spacing_m = submaps.wide_m(0.5 * config.reach_m, 1.0)
        # If each pass sees a place once, scans look alike too often to try only the most similar.
        self._most = config.near * (3 if self.spacing_m > config.reach_m else 1)
        middles_m = np.arange(0.0, path_m[-1] + config.reach_m, self.spacing_m)
        self.keys = np.unique(np.searchsorted(path_m, np.minimum(middles_m, path_m[-1])))
        self._path_m = path_m[self.keys]
        # Computed on demand: few are needed if loops connect the map.
        self._points: dict[int, OrientedPoints] = {}
        self._walls = np.full(len(self.keys), -1, np.int8)

    def untied(self, loops: Sequence[LoopCandidate], *, bare: bool = False) -> list[int]:
        """Return the stretches that no loop connects to an earlier place: distinctive ones, or also bare."""
        ends = np.sort([self._submaps.travelled_m(loop.keyframe) for loop in loops if loop.accepted])
        ends = np.concatenate([[-np.inf], ends, [np.inf]])
        after = np.searchsorted(ends, self._path_m)
        apart_m = np.minimum(self._path_m - ends[after - 1], ends[after] - self._path_m)
        untied = apart_m > self._config.reach_m
        return np.flatnonzero(untied if bare else self._determined(untied)).tolist()

    def between(self, first_m: float, last_m: float) -> list[int]:
        """Return middle keyframes of the distinctive stretches within a part of the path."""
        within = (self._path_m >= first_m) & (self._path_m <= last_m)
        return self.keys[self._determined(within)].tolist()

    def candidates(self, number: int, possible: BoolArray, apart_m: FloatArray) -> list[int]:
        """Return earlier stretches that may be seen again in one: the most similar, and the nearest.

        Parameters
        ----------
        possible
            (K,) those that are possible.
        apart_m
            (K,) their distance by the estimate.
        """
        earlier = self._path_m[number] - self._path_m > self._submaps.least_path_m
        (others,) = np.nonzero(self._determined(possible & earlier))
        if not others.size:
            return []
        likest = others[np.argsort(-self._bank.likeness(number, others), kind="stable")]
        in_window = others[apart_m[others] <= self.window_m]
        nearest = in_window[np.argsort(apart_m[in_window], kind="stable")]
        return [*dict.fromkeys([*self._of_neighbourhoods(likest), *self._of_neighbourhoods(nearest)])]

    def _of_neighbourhoods(self, ordered: NDArray[np.int64]) -> list[int]:
        """Return the first of each neighbourhood, up to the number tried."""
        chosen: list[int] = []
        for other in ordered.tolist():
            if len(chosen) == self._most:
                break
            if all(abs(self._path_m[other] - self._path_m[one]) > self._config.reach_m for one in chosen):
                chosen.append(other)
        return chosen

    def search(self, place: int, number: int) -> SearchResult:
        """Search the pose of the middle of a stretch relative to that of another, with walls parallel."""
        match, (turns, half_yaw_rad) = self._match, self._bank.turns(number, place)
        return search_window(
            self._submaps.field(int(self.keys[place])),
            self._run(number).thinned(match.search_points),
            np.zeros(3),
            self.window_m,
            half_yaw_rad,
            match.search_least_score,
            turns,
        )

    @property
    def window_m(self) -> float:
        """Return the half size of the search window: two overlapping stretches."""
        return 2.0 * self._config.reach_m

    def _run(self, number: int) -> OrientedPoints:
        """Return the points seen along a stretch."""
        if number not in self._points:
            self._points[number] = self._submaps.run(int(self.keys[number]))
        return self._points[number]

    def _determined(self, asked: BoolArray) -> BoolArray:
        """Return (K,) which of the requested (K,) have walls in more than one direction.

        Along a bare corridor, all places look alike.
        """
        for number in np.flatnonzero(asked & (self._walls < 0)).tolist():
            run = self._run(number)
            spread = run.normals.astype(np.float64).T @ run.normals
            least = np.linalg.eigvalsh(spread)[0] / max(len(run), 1) if len(run) >= FEWEST else 0.0
            self._walls[number] = least > self._match.degenerate_share
        return asked & (self._walls > 0)

    @cached_property
    def _bank(self) -> SpectrumBank:
        """Return the descriptors of all stretches."""
        bin_m, runs = self._match.coarse_cell_m, map(self._run, range(len(self.keys)))
        return SpectrumBank(hough_spectrum(run.points, run.normals, bin_m) for run in runs)
