"""Loops between the keyframes of a session and those of the map that it is joined to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.graph.loop_closure import LoopCandidate, LoopCloser
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, compose
from slam.matching.scan_points import extract_points
from slam.measurements import FloatArray, LaserScan
from slam.outputs.finished_map import Map
from slam.sessions.placing import BEND_RAD, SIGHT_SIGMA_M, SIGHT_SIGMA_RAD, Placing


@dataclass(frozen=True, slots=True)
class KeyframeScans:
    """K keyframes: sweeps, poses (K, 3) in one frame, and the number (K,) of the session of each."""

    scans: Sequence[LaserScan | None]
    poses: FloatArray
    sessions: NDArray[np.int64]

    @classmethod
    def of_saved(cls, saved: Map) -> KeyframeScans:
        """Those of a map."""
        counts = [session.keyframes for session in saved.sessions]
        return cls(saved.keyframe_scans, saved.keyframe_poses, np.repeat(np.arange(len(counts)), counts))

    def __len__(self) -> int:
        return len(self.scans)

    def path_m(self) -> FloatArray:
        """(K,) way from the first to each."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.poses[:, :2], axis=0).T))])


def find_loops(
    known: KeyframeScans, session: KeyframeScans, placing: Placing, config: Config
) -> list[LoopCandidate]:
    """Try to match keyframes along a session to places of the map near where they are expected.

    Returns
    -------
    Every candidate, its ``place`` a keyframe of the map, its ``keyframe`` numbered after those of the map.
    """
    closer = LoopCloser(config.loops, config.match)
    known_m, session_m = known.path_m(), session.path_m()
    for part, path_m, first in ((known, known_m, 0), (session, session_m, int(known.sessions[-1]) + 1)):
        for scan, pose, travelled_m, number in zip(
            part.scans, part.poses, path_m, part.sessions, strict=True
        ):
            closer.add_keyframe(_points(scan, config), pose, travelled_m, first + number)
    tried = []
    next_m = -np.inf
    for key, scan in enumerate(session.scans):
        if scan is None or session_m[key] < next_m:
            continue
        next_m = session_m[key] + config.loops.every_m
        T_map_session, distance_m = placing.nearest(session.poses[key], session.poses)
        expected = compose(T_map_session, session.poses[key])
        sigma_m = SIGHT_SIGMA_M + BEND_RAD * distance_m
        covariance = np.diag([sigma_m**2, sigma_m**2, SIGHT_SIGMA_RAD**2])
        for place in _places_near(known, expected, known_m, config):
            guess = between(known.poses[place], expected)
            tried.append(closer.verify(place, len(known) + key, guess, covariance))
    return tried


def _places_near(
    known: KeyframeScans, expected: FloatArray, path_m: FloatArray, config: Config
) -> Iterator[int]:
    """Keyframes of the map around a pose (3,), the nearest of each pass first."""
    loops = config.loops
    turns = np.abs((known.poses[:, 2] - expected[2] + np.pi) % (2.0 * np.pi) - np.pi)
    distances = np.hypot(*(known.poses[:, :2] - expected[:2]).T)
    chosen: list[int] = []
    # A quarter turn apart counts as a metre: a lidar does not see all around.
    for place in np.argsort(distances + turns / (0.5 * np.pi), kind="stable").tolist():
        if len(chosen) == loops.near:
            return
        if distances[place] > loops.reach_m or known.scans[place] is None:
            continue
        if all(
            known.sessions[place] != known.sessions[other]
            or abs(path_m[place] - path_m[other]) > loops.least_path_m
            for other in chosen
        ):
            chosen.append(place)
            yield place


def _points(scan: LaserScan | None, config: Config) -> OrientedPoints:
    """The oriented points of a sweep."""
    if scan is None:
        return OrientedPoints.none()
    settings = config.scan
    return OrientedPoints.from_scan(
        extract_points(scan, settings.range_min_m, settings.range_max_m, settings.neighbours)
    )
