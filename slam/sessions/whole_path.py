"""A whole session followed through a map from one place: what its scans say for or against that place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.config import Config
from slam.localization.hypotheses import KeyframeLog, correction
from slam.localization.known_map import Walls
from slam.localization.planar_sensor import PlanarSensor
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row, row_from_pose2


@dataclass(frozen=True, slots=True)
class Sighting:
    """A keyframe of a session and where it is in the map.

    Attributes
    ----------
    keyframe
        Its number in the session.
    pose
        (3,) of its base in the map.
    T_map_session
        (3,) the motion of the session that this asks for.
    nats
        Evidence for it.
    """

    keyframe: int
    pose: FloatArray
    T_map_session: FloatArray
    nats: float


@dataclass(frozen=True, slots=True)
class Followed:
    """A way through the map: where its walls have confirmed it, and the evidence of all of it, nats."""

    anchors: Sequence[Sighting]
    nats: float


def follow(walls: Walls, session: Walls, start: Sighting, config: Config) -> Followed:
    """Follow a session from a place to both its ends, laid to the map's walls where there are any.

    The evidence is that over the best of the wrong places; every surface is weighed once. Who walked about in
    the session speaks against no place: only what stood by its own map is weighed.
    """
    sensor = PlanarSensor(walls, config)
    log = KeyframeLog(sensor, math.inf)
    poses = session.map.keyframe_poses
    anchors, total = [], 0.0
    for direction in (range(start.keyframe, len(poses)), range(start.keyframe - 1, -1, -1)):
        last, at = start.keyframe, start.pose
        for key in direction:
            view, pose = session.view(key), pose2_from_row(poses[key])
            if view is None or not log.due(view, pose):
                continue
            at, last = compose(at, between(poses[last], poses[key])), key
            motion = correction(sensor, view, pose2_from_row(at), config.localization)
            if motion is not None:
                at = row_from_pose2(motion.T_reference_base)
            log.add(view, pose)
            nats = sensor.weigh(pose2_from_row(at), log.keyframes[-1].novel)
            total += nats
            if motion is not None:
                anchors.append(Sighting(key, at, compose(at, between(poses[key], np.zeros(3))), nats))
    return Followed(anchors, total)
