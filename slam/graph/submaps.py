"""Local maps around keyframes, built with the short-range accuracy of the odometry, in a small cache."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.config.stages import LoopConfig, MatchConfig
from slam.matching.correlative import LikelihoodField, build_field
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.planar import between
from slam.matching.visibility import RangeImage
from slam.measurements import FloatArray

_Key = TypeVar("_Key")
_Made = TypeVar("_Made")
# Number of scans of a run that suffice to draw it, and its radius in cells.
_RUN_SCANS, _RUN_CELLS = 10, 75


class Submap:
    """The surroundings of one keyframe, in its frame; built at first use."""

    def __init__(self, build: Callable[[], LocalMap], cell_m: float) -> None:
        self._build = build
        self._cell_m = cell_m

    @cached_property
    def local_map(self) -> LocalMap:
        """Return the points and surfels."""
        return self._build()

    @cached_property
    def field(self) -> LikelihoodField:
        """Return the likelihood field of the local map."""
        return build_field(self.local_map.points.points, 0.5 * self._cell_m, self._cell_m)


class SubmapStore:
    """Keyframe scans with their odometry poses, and the submaps around them.

    Until `lay`, a submap uses odometry poses only, so later optimisations do not invalidate it.
    """

    def __init__(self, loop: LoopConfig, match: MatchConfig) -> None:
        # Later parts of the path may return here, and are no part of this place.
        self._half, self._path_m, self._reach_m = loop.half_keyframes, loop.least_path_m, loop.reach_m
        self._match, self._near = match, loop.near
        self._scans: list[OrientedPoints] = []
        self._surfaces: list[OrientedPoints] = []
        self._poses: list[FloatArray] = []
        self._travelled_m = np.zeros(64)
        self._begun: list[int] = []
        self._places: list[int] = []
        self._cache: OrderedDict[int, Submap] = OrderedDict()
        # Points along which a claim is followed, for each place tried.
        self._most = loop.near * (2 * loop.half_keyframes + 1)
        self._surroundings: OrderedDict[tuple[int, int, int], LocalMap] = OrderedDict()
        self._fields: OrderedDict[int, LikelihoodField] = OrderedDict()

    def add(
        self,
        scan: OrientedPoints,
        pose: FloatArray,
        travelled_m: float,
        surface: OrientedPoints | None = None,
        *,
        begun: bool = False,
    ) -> None:
        """Store the next keyframe: its scan, its pose (3,) in the odometry frame, the path length so far.

        ``surface`` contains the points for a map; the scan itself by default. ``begun`` says that no scan
        measured the motion to it, or that it begins a session: it shares no submap with earlier keyframes.
        """
        # A place every few keyframes; if these are far apart, at each visibility distance.
        number = len(self._scans)
        if number % self._half == 0 or travelled_m - self._travelled_m[self._places[-1]] > self._reach_m:
            self._places.append(number)
        self._begun += [number] * begun
        self._scans.append(scan)
        self._surfaces.append(scan if surface is None else surface)
        self._poses.append(pose)
        if number == len(self._travelled_m):
            self._travelled_m = np.concatenate([self._travelled_m, np.zeros_like(self._travelled_m)])
        self._travelled_m[number] = travelled_m

    def __len__(self) -> int:
        return len(self._scans)

    def places(self, key: int) -> NDArray[np.int64]:
        """Return (P,) keyframes before one that represent their surroundings."""
        return np.array(self._places[: bisect_left(self._places, key)], np.int64)

    def scan(self, key: int) -> OrientedPoints:
        """Return the oriented points of a keyframe, base frame."""
        return self._scans[key]

    def travelled_m(self, key: int | np.integer[Any]) -> float:
        """Return the path length from the start to a keyframe."""
        return float(self._travelled_m[key])

    def ways_m(self) -> FloatArray:
        """Return (n,) the path lengths from the start to all keyframes."""
        return self._travelled_m[: len(self)]

    def submap(self, key: int) -> Submap:
        """Return the surroundings of a keyframe."""
        half, half_m = self._half, 0.5 * self.least_path_m
        members = [
            k
            for k in range(max(0, key - half), min(len(self._scans), key + half + 1))
            if not self.parted(k, key) and abs(self._travelled_m[k] - self._travelled_m[key]) <= half_m
        ]
        # No reference to the store, which refers to it: at the end of a run, all are freed at once.
        build = partial(_local_map, self._surfaces, self._poses, key, members, self._match)
        # The next attempt uses the same places; older ones are used too rarely for their memory.
        return _newest(self._cache, key, self._near, lambda: Submap(build, self._match.cell_m))

    def wide_m(self, least_m: float, scans: float) -> float:
        """Return a length that usually contains so many scans, but at least ``least_m``."""
        return max(least_m, scans * self.ways_m()[-1] / max(len(self), FEWEST))

    @property
    def sparse(self) -> bool:
        """Return whether scans are so far apart that each pass sees a place once."""
        return self.wide_m(0.0, 1.0) > self._reach_m

    @property
    def least_path_m(self) -> float:
        """Return the shortest path of a loop: below, the surroundings of both ends would share scans.

        If scans are far apart, one alone sees too little of a corridor: surroundings contain a few.
        """
        return self.wide_m(self._path_m, 0.5 * _RUN_SCANS)

    def pose(self, key: int | np.integer[Any]) -> FloatArray:
        """Return (3,) the pose of a keyframe, odometry frame."""
        return self._poses[key]

    def lay(self, poses: FloatArray, begun: Sequence[int]) -> None:
        """Use the poses of a finished run for all scans: loops may have corrected wrong steps.

        Nothing measured the motion to the keyframes in ``begun``: earlier points may be misplaced.
        """
        self._poses = list(poses)
        self._begun = list(begun)
        self._cache.clear()
        self._surroundings.clear()

    def parted(self, one: int, other: int) -> bool:
        """Return whether nothing measured the motion between two keyframes."""
        return bisect_right(self._begun, one) != bisect_right(self._begun, other)

    def surroundings(self, key: int, *, own: bool = False) -> LocalMap:
        """Return the points seen before and after a keyframe, and the space that these scans saw as free.

        ``own`` leaves out points beyond unobserved motion, which may be misplaced.
        """
        members = [k for k in self._around(key) if not own or not self.parted(key, k)] or [key]

        def seen() -> LocalMap:
            images = []
            for k in members:
                points = self._surfaces[k].points
                pose = between(self._poses[key], self._poses[k])
                images.append(partial(RangeImage.of, points, pose, points))
            return replace(_local_map(self._surfaces, self._poses, key, members, self._match), images=images)

        most = self._most if self.sparse else self._near  # each is as large as it sees far
        return _newest(self._surroundings, (key, members[0], members[-1]), most, seen)

    def field(self, key: int) -> LikelihoodField:
        """Return a coarse field of the points seen before and after a keyframe, for wide windows."""
        sizes_m = 2.0 * self._match.cell_m, self._match.coarse_cell_m
        return _newest(self._fields, key, self._most, lambda: build_field(self.run(key).points, *sizes_m))

    def _around(self, key: int) -> list[int]:
        """Return a few keyframes before and after one."""
        reach_m = self.wide_m(self._reach_m, 2.0)
        members = np.flatnonzero(np.abs(self.ways_m() - self._travelled_m[key]) <= reach_m)
        return members[:: 1 + len(members) // _RUN_SCANS].tolist()

    def run(self, key: int) -> OrientedPoints:
        """Return the points seen before and after a keyframe, in its frame: one per cell."""
        parts = [
            self._surfaces[k].moved(between(self._poses[key], self._poses[k])) for k in self._around(key)
        ]
        points = np.concatenate([part.points for part in parts])
        cells = np.floor(points / (2.0 * self._match.cell_m)).astype(np.int64)
        near = np.abs(cells).max(axis=1, initial=0) < _RUN_CELLS
        (first,) = np.nonzero(near)
        rows = cells[first] @ [2 * _RUN_CELLS, 1]
        first = first[np.unique(rows, return_index=True)[1]]
        return OrientedPoints(points[first], np.concatenate([part.normals for part in parts])[first])


def _newest(made: OrderedDict[_Key, _Made], key: _Key, most: int, make: Callable[[], _Made]) -> _Made:
    """Return the cached value of a key, or compute it; only the newest stay."""
    made[key] = found = made.pop(key) if key in made else make()
    if len(made) > most:
        made.popitem(last=False)
    return found


def _local_map(
    surfaces: Sequence[OrientedPoints],
    poses: Sequence[FloatArray],
    key: int,
    members: list[int],
    match: MatchConfig,
) -> LocalMap:
    """Return the scans of some keyframes in the frame of one."""
    parts = [surfaces[k].moved(between(poses[key], poses[k])) for k in members]
    return LocalMap.build(parts, match)
