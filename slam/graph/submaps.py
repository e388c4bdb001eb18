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
# So many scans of a run are enough to draw it, and so far around, in its cells.
_RUN_SCANS, _RUN_CELLS = 10, 75


class Submap:
    """The surroundings of one keyframe, in its frame; made when first looked at."""

    def __init__(self, build: Callable[[], LocalMap], cell_m: float) -> None:
        self._build = build
        self._cell_m = cell_m

    @cached_property
    def local_map(self) -> LocalMap:
        """The points and surfels."""
        return self._build()

    @cached_property
    def field(self) -> LikelihoodField:
        """Likelihood field of the local map."""
        return build_field(self.local_map.points.points, 0.5 * self._cell_m, self._cell_m)


class SubmapStore:
    """Keyframe scans with their odometry poses, and the submaps around them.

    While mapping, odometry places the scans of a submap, so no optimisation makes it stale; see also `lay`.
    """

    def __init__(self, loop: LoopConfig, match: MatchConfig) -> None:
        # What comes later on the way may come back here, and is no part of this place.
        self._half, self._path_m, self._reach_m = loop.half_keyframes, loop.least_path_m, loop.reach_m
        self._match, self._near = match, loop.near
        self._scans: list[OrientedPoints] = []
        self._surfaces: list[OrientedPoints] = []
        self._poses: list[FloatArray] = []
        self._travelled_m: list[float] = []
        self._sessions: list[int] = []
        self._begun: list[int] = []
        self._places: list[int] = []
        self._cache: OrderedDict[int, Submap] = OrderedDict()
        # Of each place that is tried, what a claim is followed along.
        self._most = loop.near * (2 * loop.half_keyframes + 1)
        self._surroundings: OrderedDict[tuple[int, int, int], LocalMap] = OrderedDict()
        self._fields: OrderedDict[int, LikelihoodField] = OrderedDict()

    def add(
        self,
        scan: OrientedPoints,
        pose: FloatArray,
        travelled_m: float,
        session: int = 0,
        surface: OrientedPoints | None = None,
    ) -> None:
        """Take the next keyframe: its scan, its pose (3,) in the odometry frame, the way so far.

        ``surface`` is what a map learns of the scan; the scan itself by default.

        Keyframes of different sessions, which have no odometry between them, share no submap.
        """
        # A place each so many keyframes; where they lie far apart, each as far as a place is seen.
        number = len(self._scans)
        if number % self._half == 0 or travelled_m - self._travelled_m[self._places[-1]] > self._reach_m:
            self._places.append(number)
        self._scans.append(scan)
        self._surfaces.append(scan if surface is None else surface)
        self._poses.append(pose)
        self._travelled_m.append(travelled_m)
        self._sessions.append(session)

    def __len__(self) -> int:
        return len(self._scans)

    def places(self, key: int) -> NDArray[np.int64]:
        """(P,) keyframes before one that stand for their surroundings."""
        return np.array(self._places[: bisect_left(self._places, key)], np.int64)

    def scan(self, key: int) -> OrientedPoints:
        """Oriented points of a keyframe, base frame."""
        return self._scans[key]

    def travelled_m(self, key: int | np.integer[Any]) -> float:
        """Way from the start to a keyframe."""
        return self._travelled_m[key]

    def submap(self, key: int) -> Submap:
        """The surroundings of a keyframe."""
        half, half_m = self._half, 0.5 * self.least_path_m
        members = [
            k
            for k in range(max(0, key - half), min(len(self._scans), key + half + 1))
            if self._sessions[k] == self._sessions[key]
            and abs(self._travelled_m[k] - self._travelled_m[key]) <= half_m
        ]
        # It does not hold the store that holds it: at the end of a run all of them go at once.
        build = partial(_local_map, self._surfaces, self._poses, key, members, self._match)
        # The next attempt looks at the same places; older ones come too seldom for what they take.
        return _newest(self._cache, key, self._near, lambda: Submap(build, self._match.cell_m))

    def wide_m(self, least_m: float, scans: float) -> float:
        """A length that holds so many scans as a rule, but no less than ``least_m``."""
        return max(least_m, scans * self._travelled_m[-1] / max(len(self), FEWEST))

    @property
    def sparse(self) -> bool:
        """Whether scans lie so far apart that each pass sees a place once."""
        return self.wide_m(0.0, 1.0) > self._reach_m

    @property
    def least_path_m(self) -> float:
        """Way round below which it is no loop: the surroundings of both ends would share scans.

        Where scans lie far apart, one alone sees too little of a corridor: each surroundings has a few.
        """
        return self.wide_m(self._path_m, 0.5 * _RUN_SCANS)

    def pose(self, key: int | np.integer[Any]) -> FloatArray:
        """(3,) of a keyframe, odometry frame."""
        return self._poses[key]

    def lay(self, poses: FloatArray, begun: Sequence[int]) -> None:
        """Place all scans by the estimate of a finished run: loops may have corrected wrong steps.

        Nothing saw the way to the keyframes in ``begun``: what was seen before may lie elsewhere.
        """
        self._poses = list(poses)
        self._begun = list(begun)
        self._cache.clear()

    def parted(self, one: int, other: int) -> bool:
        """Whether nothing saw the way between two keyframes."""
        return bisect_right(self._begun, one) != bisect_right(self._begun, other)

    def surroundings(self, key: int, *, own: bool = False) -> LocalMap:
        """What is seen on the way to a keyframe and on from it, and what those scans have looked through.

        ``own`` leaves out what may lie elsewhere, for nothing saw the way there.
        """
        members = [k for k in self._around(key) if not own or not self.parted(key, k)]

        def seen() -> LocalMap:
            images = []
            for k in members:
                points = self._surfaces[k].points
                pose = between(self._poses[key], self._poses[k])
                images.append(partial(RangeImage.of, points, pose, points))
            return replace(_local_map(self._surfaces, self._poses, key, members, self._match), images=images)

        return _newest(self._surroundings, (key, members[0], members[-1]), self._most, seen)

    def field(self, key: int) -> LikelihoodField:
        """Of what is seen on the way to a keyframe and on from it, coarse: for searches in wide windows."""
        sizes_m = 2.0 * self._match.cell_m, self._match.coarse_cell_m
        return _newest(self._fields, key, self._most, lambda: build_field(self.run(key).points, *sizes_m))

    def _around(self, key: int) -> list[int]:
        """Keyframes on the way to one and on from it, a few of them."""
        travelled_m = np.array(self._travelled_m)
        reach_m = self.wide_m(self._reach_m, 2.0)
        members = np.flatnonzero(np.abs(travelled_m - travelled_m[key]) <= reach_m)
        members = members[:: 1 + len(members) // _RUN_SCANS]
        return [k for k in members.tolist() if self._sessions[k] == self._sessions[key]]

    def run(self, key: int) -> OrientedPoints:
        """What is seen on the way to a keyframe and on from it, in its frame: a point a cell."""
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
    """What was made for a key, or is made now; so many of the newest stay."""
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
    """The scans of some keyframes in the frame of one."""
    parts = [surfaces[k].moved(between(poses[key], poses[k])) for k in members]
    return LocalMap.build(parts, match)
