"""Find the pose of a session in a known map: collect candidates, and weight them by all readings on the path.

Stretches of each are searched in the other: a session that passes through a small map is found by the places
of the map, a session within a large map by its own. A stretch only proposes a pose, because rooms look alike;
each proposal is followed along the whole session, where every surface counts once for or against it.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from fusion.estimation import gate
from slam.config import Config
from slam.localization.hypotheses import HypothesisSet, KeyframeLog, correction
from slam.localization.poses import separation
from slam.localization.sensor import Sensor
from slam.measurements import Pose, composed, motion_between
from slam.sessions.sides import Side

# Uncertainty of a sighting, and distortion of maps over their length.
SIGHT_SIGMA_M = 0.12
SIGHT_SIGMA_RAD = 0.03
BEND_RAD = 0.02
# Maximum length of a stretch without a certain place; maximum number of stretches for a long session or map.
_STRETCH_M = 8.0
_MOST_STRETCHES = 24
# Maximum number of proposals that are followed.
_FOLLOWED = 8


@dataclass(frozen=True, slots=True)
class Placing:
    """Pose of a session in a map.

    Attributes
    ----------
    anchors
        Keyframes of the session along the most likely path, where the map has confirmed it.
    nats
        Evidence for that path over the best of the wrong ones.
    rival_nats
        Evidence for the best other place; minus infinity if there is none.
    least_nats, lead_nats
        Required evidence, and required lead over the other place: the same as for a certain localiser.
    """

    anchors: Sequence[Sighting] = ()
    nats: float = -math.inf
    rival_nats: float = -math.inf
    least_nats: float = math.inf
    lead_nats: float = math.inf

    @property
    def confident(self) -> bool:
        """Return whether there is enough evidence, and no other place like it."""
        return bool(self.anchors) and self.nats >= max(self.least_nats, self.rival_nats + self.lead_nats)

    def nearest(self, pose: Pose, poses: Sequence[Pose]) -> tuple[Pose, float]:
        """Return the transform of the session by the anchor nearest to a pose, and its distance, m.

        Parameters
        ----------
        poses
            K of the session's keyframes, session frame.
        """
        distances = [separation(poses[anchor.keyframe], pose)[0] for anchor in self.anchors]
        least_m = min(distances)
        return self.anchors[distances.index(least_m)].T_map_session, least_m


def place(known: Side, session: Side, config: Config) -> Placing:
    """Find the pose of a session in a map."""
    poses = session.bases
    paths: list[tuple[Sighting, Followed]] = []
    sensor = known.sensor()
    proposals = _distinct(_proposals(sensor, known, session, config), poses)[:_FOLLOWED]
    # Free the session's sensor, which its caches keep in memory by reference cycles.
    gc.collect()
    for proposal in proposals:
        path = follow(sensor, session, proposal, config)
        paths.append((path.anchors[len(path.anchors) // 2] if path.anchors else proposal, path))
    if not paths:
        return Placing()
    winner, best = max(paths, key=lambda item: item[1].nats)
    rivals = [path.nats for sighting, path in paths if not _agree(winner, sighting, poses)]
    settings = config.localization
    confident_nats = math.log(settings.confident_probability / (1.0 - settings.confident_probability))
    return Placing(
        best.anchors,
        best.nats,
        max(rivals, default=-math.inf),
        settings.nowhere_nats + confident_nats,
        confident_nats,
    )


def _proposals(sensor: Sensor[Any, Any], known: Side, session: Side, config: Config) -> list[Sighting]:
    """Return candidate poses of stretches of each in the other, as keyframes of the session in the map."""
    poses, sightings = session.bases, []
    for key, pose, nats in _stretches(sensor, session, config):
        sightings.append(Sighting.of(key, pose, poses[key], nats))
    for key, pose, nats in _stretches(session.sensor(), known, config):
        T_map_session = composed(known.bases[key], pose.inverse())
        nearest = session.nearest(pose)
        sightings.append(Sighting(nearest, composed(T_map_session, poses[nearest]), T_map_session, nats))
    return sightings


def _stretches(sensor: Sensor[Any, Any], path: Side, config: Config) -> Iterator[tuple[int, Pose, float]]:
    """Yield for each stretch of a path a keyframe, its candidate poses in a map, and the evidence."""
    hypotheses = HypothesisSet(sensor, config.localization)
    kidnap_nats = config.localization.nowhere_nats
    path_m = path.path_m
    apart_m = path_m[-1] / _MOST_STRETCHES
    begin_m = 0.0
    likeliest: list[tuple[int, Pose, float]] = []
    for key, pose in enumerate(path.bases):
        if path_m[key] < begin_m:
            continue
        view = path.view(key)
        if view is None or not hypotheses.due(view, pose):
            continue
        hypotheses.add_keyframe(view, pose, None)
        # There is no next reading to process, so finish the search.
        while hypotheses.seeking:
            hypotheses.seek()
        members = sorted(hypotheses.members, key=lambda member: -member.total(kidnap_nats))
        now = [(key, member.pose, member.total(kidnap_nats)) for member in members[: config.loops.near]]
        if now and (not likeliest or now[0][2] > likeliest[0][2]):
            likeliest = now
        winner = hypotheses.winner()
        if winner is not None:
            likeliest = [(key, winner.pose, winner.total(kidnap_nats))]
        if winner is not None or path_m[key] > begin_m + _STRETCH_M:
            yield from likeliest
            likeliest = []
            hypotheses.clear()
            begin_m = max(begin_m + apart_m, path_m[key])
    yield from likeliest


def _distinct(proposals: Sequence[Sighting], poses: Sequence[Pose]) -> list[Sighting]:
    """Return the most likely of all candidates that agree with each other, by their common evidence."""
    groups: list[list[Sighting]] = []
    for sighting in sorted(proposals, key=lambda sighting: -sighting.nats):
        for group in groups:
            if _agree(group[0], sighting, poses):
                group.append(sighting)
                break
        else:
            groups.append([sighting])
    groups.sort(key=lambda group: -sum(max(sighting.nats, 0.0) for sighting in group))
    return [group[0] for group in groups]


def _agree(one: Sighting, other: Sighting, poses: Sequence[Pose]) -> bool:
    """Return whether one sighting predicts the keyframe of another where that was found."""
    miss_m, miss_rad = separation(composed(one.T_map_session, poses[other.keyframe]), other.pose)
    apart_m, _ = separation(poses[one.keyframe], poses[other.keyframe])
    sigmas = math.sqrt(gate())
    position_fits = miss_m <= sigmas * SIGHT_SIGMA_M + BEND_RAD * apart_m
    return position_fits and miss_rad <= sigmas * SIGHT_SIGMA_RAD


@dataclass(frozen=True, slots=True)
class Sighting:
    """A keyframe of a session and its pose in the map.

    Attributes
    ----------
    pose
        Pose of its base in the map.
    T_map_session
        The transform of the session that follows from it.
    """

    keyframe: int
    pose: Pose
    T_map_session: Pose
    nats: float

    @classmethod
    def of(cls, keyframe: int, pose: Pose, own: Pose, nats: float) -> Sighting:
        """Create the sighting of a keyframe at ``own`` in the session, and at ``pose`` in the map."""
        return cls(keyframe, pose, composed(pose, own.inverse()), nats)


@dataclass(frozen=True, slots=True)
class Followed:
    """A path through the map: where its walls have confirmed it, and its total evidence, nats."""

    anchors: Sequence[Sighting]
    nats: float


def follow(sensor: Sensor[Any, Any], session: Side, start: Sighting, config: Config) -> Followed:
    """Follow a session from a place to both its ends, aligned to the map wherever its sensor can.

    The evidence is relative to the best of the wrong places; every surface counts once. People in the session
    are no evidence against a place: only what is static in its own map counts.
    """
    log = KeyframeLog(sensor, math.inf)
    poses = session.bases
    anchors, total = [], 0.0
    for direction in (range(start.keyframe, len(poses)), range(start.keyframe - 1, -1, -1)):
        last, at = start.keyframe, start.pose
        for key in direction:
            view = session.view(key)
            if view is None or not log.due(view, poses[key]):
                continue
            at, last = composed(at, motion_between(poses[last], poses[key])), key
            motion = correction(sensor, view, at, config.localization)
            if motion is not None:
                at = motion.T_reference_base
            log.add(view, poses[key])
            nats = sensor.weigh(at, log.keyframes[-1].novel, motion)
            total += nats
            if motion is not None:
                anchors.append(Sighting.of(key, at, poses[key], nats))
    return Followed(anchors, total)
