"""Heights compared two by two: the right one wins though others are seen in easier places."""

from __future__ import annotations

import math

import numpy as np

from fusion.curves import Curve
from fusion.panorama import CurveStack
from fusion.rig import HeightContest

STEP = math.radians(1.0)


def contest(rows, lidar, times=1):
    result = HeightContest(len(rows))
    ranges = np.array(rows, dtype=np.float32)
    stack = CurveStack(ranges, 0.0, STEP, -0.1 * np.arange(len(rows))[::-1])
    for _ in range(times):
        result.add(stack, Curve(np.array(lidar, dtype=np.float32), 0.0, STEP), np.eye(3))
    return result


def test_the_height_that_sees_what_the_lidar_sees_wins():
    lidar = np.where(np.arange(60) < 30, 2.0, 3.0)
    wrong = np.full(60, 3.0)  # over a low cupboard
    assert contest([wrong, lidar, wrong], lidar).winner()[0] == 1


def test_a_height_that_is_seen_only_where_it_is_easy_does_not_win():
    lidar = np.full(60, 2.0)
    right = lidar.copy()
    right[30:] += 0.5  # where nothing fits at any height
    wrong = np.full(60, np.nan)
    wrong[:30] = 2.0
    wrong[:2] += 0.5  # on average far better than the other, and worse where both are seen
    assert contest([wrong, right], lidar).winner()[0] == 1
    assert contest([right, wrong], lidar, times=3).winner()[0] == 0


def test_heights_at_which_all_is_the_same_are_reported_as_equals():
    lidar = np.where(np.arange(60) < 30, 2.0, 3.0)
    other = np.full(60, 2.5)
    best, first, last = contest([other, lidar, lidar, lidar, other], lidar).winner()
    assert first <= best <= last
    assert (first, last) == (1, 3)
