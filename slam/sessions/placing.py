"""Where a session lies in a known map: stretches of either are localised in the other, and they vote.

One stretch may be mistaken, rooms are alike. Stretches of one share no scan, so that several that are
mistaken in the same way are unlikely; what they must agree on is one motion of the whole session. A session
that leads through a small map and on is found by the stretches of the map, one within a large map by its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.config import Config
from slam.localization.hypotheses import HypothesisSet
from slam.localization.known_map import KnownMap, Walls
from slam.localization.map_match import MapMatcher
from slam.localization.scan_view import ScanView
from slam.matching.planar import between, compose
from slam.measurements import FloatArray

# So many stretches must agree, and be so many times as many as those that disagree.
LEAST_PLACES = 3
_MAJORITY = 2
# Two votes agree where they put each other's keyframe within this; maps bend a little over their length.
_SAME_M = 0.4
_SAME_RAD = 0.1
_BEND_RAD = 0.02
# Of a long session so many places are looked for.
_MOST_PLACES = 24
_ORIGIN = np.zeros(3)


@dataclass(frozen=True, slots=True)
class Sighting:
    """A keyframe of the session and where it is in the map.

    Attributes
    ----------
    keyframe
        Its number in the session: the one that was found, or that is nearest to where the map's was found.
    pose
        (3,) of its base in the map.
    T_map_session
        (3,) the motion of the session that this asks for.
    """

    keyframe: int
    pose: FloatArray
    T_map_session: FloatArray


@dataclass(frozen=True, slots=True)
class Placing:
    """Where a session lies in a map.

    Attributes
    ----------
    agreeing
        The sightings that agree, in the order of the session.
    disagreeing
        How many do not agree with them.
    """

    agreeing: tuple[Sighting, ...]
    disagreeing: int

    @property
    def sure(self) -> bool:
        """Whether enough places agree, and few disagree."""
        count = len(self.agreeing)
        return count >= LEAST_PLACES and count >= _MAJORITY * self.disagreeing

    def nearest(self, pose: FloatArray, poses: FloatArray) -> tuple[FloatArray, float]:
        """The motion of the session by the sighting nearest to a pose (3,) of it, and how far that is, m.

        Parameters
        ----------
        poses
            (K, 3) of the session's keyframes, session frame.
        """
        distances = [math.dist(poses[one.keyframe, :2], pose[:2]) for one in self.agreeing]
        n = int(np.argmin(distances))
        return self.agreeing[n].T_map_session, distances[n]


def sightings_of(known: Walls, session: Walls, config: Config) -> list[Sighting]:
    """Look for stretches of a session in a map, and for stretches of the map in the session."""
    poses = session.map.keyframe_poses
    found = []
    for key, pose in _found_stretches(known, session.map, config):
        found.append(Sighting(key, pose, compose(pose, between(poses[key], _ORIGIN))))
    for key, pose in _found_stretches(session, known.map, config):
        T_map_session = compose(known.map.keyframe_poses[key], between(pose, _ORIGIN))
        nearest = int(np.hypot(*(poses[:, :2] - pose[:2]).T).argmin())
        found.append(Sighting(nearest, compose(T_map_session, poses[nearest]), T_map_session))
    return found


def _found_stretches(walls: Walls, way: KnownMap, config: Config) -> list[tuple[int, FloatArray]]:
    """Keyframes at the ends of stretches of a way that were found between walls, and (3,) where."""
    scans, poses = way.keyframe_scans, way.keyframe_poses
    hypotheses = HypothesisSet(walls, MapMatcher(walls, config), config.localization)
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    apart_m = way_m[-1] / _MOST_PLACES
    found = []
    begin_m = 0.0
    for key, scan in enumerate(scans):
        if scan is None or way_m[key] < begin_m or not hypotheses.due(poses[key]):
            continue
        hypotheses.add_station(ScanView.of(scan, config), poses[key], None)
        winner = hypotheses.winner()
        if winner is None:
            continue
        found.append((key, winner.pose))
        hypotheses.clear()
        begin_m = max(begin_m + apart_m, way_m[key])
    return found


def agree_on_placing(sightings: Sequence[Sighting], poses: FloatArray) -> Placing:
    """The largest set of sightings that ask for one motion of the session.

    Parameters
    ----------
    poses
        (K, 3) of the session's keyframes, session frame.
    """
    best: list[Sighting] = []
    for one in sightings:
        agreeing = [other for other in sightings if _agree(one, other, poses)]
        if len(agreeing) > len(best):
            best = agreeing
    return Placing(tuple(best), len(sightings) - len(best))


def _agree(one: Sighting, other: Sighting, poses: FloatArray) -> bool:
    """Whether one sighting puts the keyframe of another where that was found."""
    miss = between(compose(one.T_map_session, poses[other.keyframe]), other.pose)
    apart_m = math.dist(poses[one.keyframe, :2], poses[other.keyframe, :2])
    return math.hypot(miss[0], miss[1]) <= _SAME_M + _BEND_RAD * apart_m and abs(miss[2]) <= _SAME_RAD
