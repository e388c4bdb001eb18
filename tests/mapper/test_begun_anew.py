"""A robot without wheels that scans have lost: it begins anew where it is."""

from __future__ import annotations

import numpy as np
import pytest
from flat_worlds import box, room, sweep

from slam.config import Config, load_config
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.planar_odometry import Moment, PlanarOdometry
from slam.measurements import WheelOdometry, pose2_from_row
from slam.odometry import STANDARD

ELSEWHERE = np.concatenate([box(-6.0, -1.5, 9.0, 4.0), box(1.0, 1.0, 3.0, 2.0)])


def moments(config: Config, *, wheels: bool) -> list[Moment]:
    """It stands in a room for a second, and for two somewhere else."""
    odometry, found, key = PlanarOdometry(config, Checkpoint(), STANDARD), list[Moment](), 0
    for n in range(30):
        if wheels:
            odometry.observe(WheelOdometry(0.1 * n, pose2_from_row(np.zeros(3))))
        world = room() if n < 10 else ELSEWHERE
        moment = odometry.observe(sweep(world, (0.3, 0.2, 0.1), sigma_m=0.005, seed=n, stamp_s=0.1 * n))
        assert moment is not None
        found.append(moment)
        if moment.new_keyframe:
            odometry.step(key)
            key += 1
    return found


def test_after_half_a_second_without_a_match_it_begins_anew() -> None:
    found = moments(load_config(), wheels=False)
    (first, second) = [n for n, moment in enumerate(found) if moment.new_keyframe]
    assert first == 0
    assert 0.1 * (second - 9) == pytest.approx(0.6, abs=0.11)
    assert all(moment.motion is None for moment in found[10 : second + 1])
    assert all(moment.motion is not None for moment in found[second + 1 :])


def test_wheels_lead_on_where_no_scan_matches() -> None:
    assert [moment.new_keyframe for moment in moments(load_config(), wheels=True)].count(True) == 1
