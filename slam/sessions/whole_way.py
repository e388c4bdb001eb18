"""What a whole session says for or against lying somewhere in a map: every surface is weighed once."""

from __future__ import annotations

import math
from collections.abc import Sequence

from slam.config import Config
from slam.localization.known_map import Walls
from slam.localization.map_match import MapMatcher
from slam.localization.scan_view import ScanView
from slam.localization.stations import StationLog
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, LaserScan, row_from_pose2

# An alignment may correct the way by so much a station; what moves farther is another place.
_GREATEST_CORRECTION_M = 0.3
_GREATEST_CORRECTION_RAD = 0.15
# Longer than any way.
_ENDLESS_M = 1e9


def weigh_whole_way(
    walls: Walls,
    scans: Sequence[LaserScan | None],
    poses: FloatArray,
    start: int,
    pose: FloatArray,
    config: Config,
) -> float:
    """Evidence that a session lies where one keyframe was found, over the best of the wrong places, nats.

    From that keyframe the way is followed to both ends, and laid to the map's walls where there are any.

    Parameters
    ----------
    scans, poses
        K keyframes of the session, poses (K, 3) in its own frame.
    start, pose
        Number of a keyframe, and its pose (3,) in the map.
    """
    matcher = MapMatcher(walls, config)
    log = StationLog(config.localization.model_copy(update={"window_m": _ENDLESS_M}))
    nats = 0.0
    for way in (range(start, len(scans)), range(start - 1, -1, -1)):
        last, at = start, pose
        for key in way:
            scan = scans[key]
            if scan is None or (log.stations and not log.due(poses[key])):
                continue
            view = ScanView.of(scan, config)
            at = _laid(matcher, view, compose(at, between(poses[last], poses[key])), config)
            last = key
            log.add(view, poses[key])
            nats += matcher.weigh(at, view.laser, log.stations[-1].news)
    return nats


def _laid(matcher: MapMatcher, view: ScanView, expected: FloatArray, config: Config) -> FloatArray:
    """An expected pose (3,) in the map, corrected by the walls if enough of the scan agrees with them."""
    motion = matcher.align(view, expected)
    if motion is None or motion.inlier_share < config.localization.least_inlier_share:
        return expected
    aligned = row_from_pose2(motion.T_reference_base)
    moved = between(expected, aligned)
    near = math.hypot(moved[0], moved[1]) <= _GREATEST_CORRECTION_M
    return aligned if near and abs(float(moved[2])) <= _GREATEST_CORRECTION_RAD else expected
