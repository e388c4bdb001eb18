"""Make the local map at the first cloud of a log, and estimate the motion there, before mapping starts.

In an empty map, the first clouds lean by what their noise shows, and all later ones with them. So the first
seconds are also tracked backward: the map is full when the first cloud is reached.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np

from fusion.height_band import thin_evenly
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.matching.cloud_points import at_middle_of_turn, deskewed, voxel_of
from slam.matching.local_cloud import moved
from slam.measurements import FloatArray, Measurement, PointCloud
from slam.odometry.cloud_tracker import NO_MAP, CloudTracker, FirstMap, TrackedCloud
from slam.odometry.cloud_velocity import LONGEST_STEP_S

# A car passes two local maps in this time.
_MAP_S = 10.0


def first_map(log: Iterable[Measurement], config: Config) -> FirstMap:
    """Return what the first seconds of a log show about its first cloud; `NO_MAP` if they do not fit."""
    clouds = _first_clouds(log, config)
    timed = bool(clouds) and deskewed(clouds[0], config.cloud_odometry)
    lidars = [cloud.T_base_lidar for cloud in clouds]
    tracker, tracked = CloudTracker(config, None), list[tuple[int, float, TrackedCloud]]()
    while clouds:
        cloud = clouds.pop()
        found = tracker.follow(cloud)
        if found.motion is None or not found.motion.converged or found.motion.degenerate:
            tracked.clear()
        tracked.append((len(clouds), -cloud.stamp_s, found))
        # Clouds between two keyframes add little; the last three show the twist.
        while len(clouds) > 3 and (step_s := clouds[-2].stamp_s - cloud.stamp_s) < GAP_S:
            if tracker.moves_on(step_s):
                break
            clouds.pop()
    if len(tracked) < 3:
        return NO_MAP
    keyframes = [(number, one) for number, _, one in tracked if one.new_keyframe]
    # The earlier half was matched to few clouds.
    newest = keyframes[len(keyframes) // 2 :][-config.match.local_map_keyframes :]
    T_first_map, fine_m = tracked[-1][2].pose.inverse(), 0.5 * tracker.voxel_m
    placed = []
    for number, one in newest:
        T_first_base = T_first_map.compose(one.pose)
        lidar = T_first_base.transformFrom(lidars[number].translation())
        placed.append((moved(thin_evenly(one.points, fine_m), T_first_base), lidar))
    return FirstMap(*_first_twist(tracked[-3:]), placed) if timed else FirstMap(keyframes=placed)


def _first_twist(last: list[tuple[int, float, TrackedCloud]]) -> tuple[FloatArray, FloatArray]:
    """Return the twist (6,) at the last of three clouds tracked backward, and its change per second."""
    steps = [
        (then_s - now_s, gtsam.Pose3.Logmap(now.pose.between(then.pose)) / (then_s - now_s))
        for (_, then_s, then), (_, now_s, now) in pairwise(last)
    ]
    (later_s, later), (step_s, mean) = steps
    change = np.asarray(2.0 * (later - mean) / (step_s + later_s))
    # Half a step before the middle of the first step.
    return mean - 0.5 * step_s * change, change


def _first_clouds(log: Iterable[Measurement], config: Config) -> list[PointCloud]:
    """Return the clouds before the first gap, thinned, with the time reversed."""
    clouds, begun_s, last_s, fine_m = list[PointCloud](), math.nan, math.nan, 0.0
    for item in log:
        if not isinstance(item, PointCloud):
            continue
        cloud = at_middle_of_turn(item, config.cloud_odometry)
        points = np.asarray(cloud.points_lidar).reshape(-1, 3).astype(np.float64)
        if not clouds:
            begun_s, fine_m = cloud.stamp_s, 0.5 * voxel_of(points, config.cloud_odometry)
        elif cloud.stamp_s <= last_s:
            continue
        elif cloud.stamp_s - last_s >= LONGEST_STEP_S or cloud.stamp_s - begun_s > _MAP_S:
            break
        last_s = cloud.stamp_s
        times_s = np.zeros(len(points)) if cloud.times_s is None else cloud.times_s
        rows = thin_evenly(np.column_stack([points, times_s]), fine_m)
        clouds.append(
            replace(
                cloud,
                stamp_s=-cloud.stamp_s,
                points_lidar=rows[:, :3].astype(np.float32),
                times_s=None if cloud.times_s is None else -rows[:, 3],
                intensities=None,
            )
        )
    return clouds
