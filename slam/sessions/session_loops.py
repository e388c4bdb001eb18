"""Loops between the keyframes of a session and those of the map that it is joined to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.graph.loop_closure import LoopCandidate, closer_of
from slam.matching.planar import between, compose
from slam.measurements import FloatArray
from slam.outputs.finished_map import Map
from slam.sessions.placing import BEND_RAD, SIGHT_SIGMA_M, SIGHT_SIGMA_RAD, Placing


def find_loops(known: Map, session: Map, placing: Placing, config: Config) -> list[LoopCandidate]:
    """Try to match keyframes along a session to places of the map near where they are expected.

    Returns
    -------
    Every candidate, its ``place`` a keyframe of the map, its ``keyframe`` numbered after those of the map.
    """
    both = ((known, 0), (session, len(known.sessions)))
    closer = closer_of(
        [scan for part, _ in both for scan in part.keyframe_scans],
        np.concatenate([part.keyframe_poses for part, _ in both]),
        np.concatenate([part.contents.path_m for part, _ in both]),
        np.concatenate([first + _session_numbers(part) for part, first in both]),
        config,
    )
    tried, poses = [], session.keyframe_poses
    next_m, session_m = -np.inf, session.contents.path_m
    for key, scan in enumerate(session.keyframe_scans):
        if scan is None or session_m[key] < next_m:
            continue
        next_m = session_m[key] + config.loops.every_m
        T_map_session, distance_m = placing.nearest(poses[key], poses)
        expected = compose(T_map_session, poses[key])
        sigma_m = SIGHT_SIGMA_M + BEND_RAD * distance_m
        covariance = np.diag([sigma_m**2, sigma_m**2, SIGHT_SIGMA_RAD**2])
        for place in _places_near(known, expected, config):
            guess = between(known.keyframe_poses[place], expected)
            tried.append(closer.verify(place, len(known.keyframe_poses) + key, guess, covariance))
    return tried


def _session_numbers(saved: Map) -> NDArray[np.int64]:
    """(K,) the number of the session of each keyframe."""
    return np.repeat(np.arange(len(saved.sessions)), [session.keyframes for session in saved.sessions])


def _places_near(known: Map, expected: FloatArray, config: Config) -> Iterator[int]:
    """Keyframes of the map around a pose (3,), the nearest of each pass first."""
    loops, poses, path_m = config.loops, known.keyframe_poses, known.contents.path_m
    sessions = _session_numbers(known)
    turns = np.abs((poses[:, 2] - expected[2] + np.pi) % (2.0 * np.pi) - np.pi)
    distances = np.hypot(*(poses[:, :2] - expected[:2]).T)
    chosen: list[int] = []
    # A quarter turn apart counts as a metre: a lidar does not see all around.
    for place in np.argsort(distances + turns / (0.5 * np.pi), kind="stable").tolist():
        if len(chosen) == loops.near:
            return
        if distances[place] > loops.reach_m or known.keyframe_scans[place] is None:
            continue
        if all(
            sessions[place] != sessions[other] or abs(path_m[place] - path_m[other]) > loops.least_path_m
            for other in chosen
        ):
            chosen.append(place)
            yield place
