"""Follow a whole session through a map from one place, and sum the evidence for and against that place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from slam.config import Config
from slam.localization.hypotheses import KeyframeLog, correction
from slam.localization.sensor import Sensor
from slam.measurements import Pose, composed, motion_between
from slam.sessions.sides import Side


@dataclass(frozen=True, slots=True)
class Sighting:
    """A keyframe of a session and its pose in the map.

    Attributes
    ----------
    keyframe
        Its number in the session.
    pose
        Pose of its base in the map.
    T_map_session
        The transform of the session that follows from it.
    nats
        Evidence for it.
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
