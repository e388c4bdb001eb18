"""A session followed through a map: who walked about in it speaks against no place, what stood does."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from flat_worlds import box, room, sweep

from slam.config import Config
from slam.localization.known_map import Walls
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.measurements import FloatArray
from slam.sessions.placing import Followed, Sighting, follow
from slam.sessions.sides import Side

CONFIG = Config()


def driven(world: Callable[[int], FloatArray]) -> Walls:
    """The map of a drive to and fro through a world that may be another in each of its scans."""
    mapper = Mapper(CONFIG, PlanarRobot(CONFIG))
    for n, x_m in enumerate([*np.linspace(-1.5, 1.0, 40), *np.linspace(1.0, -1.5, 40)]):
        mapper.add(sweep(world(n), [x_m, -1.0, 0.0], stamp_s=0.1 * n))
    return Walls(mapper.finish().map, CONFIG)


def with_a_box(west: float) -> FloatArray:
    return np.concatenate([room(), box(west, 1.0, west + 0.5, 1.3)])


@pytest.fixture(scope="module")
def known() -> Walls:
    return driven(lambda _: room())


def followed(known: Walls, session: Walls) -> Followed:
    one, other = (Side.of_walls(walls, CONFIG) for walls in (known, session))
    return follow(one.sensor(), other, Sighting(0, gtsam.Pose2(), gtsam.Pose2(), 0.0), CONFIG)


def test_who_walked_about_speaks_against_no_place(known: Walls) -> None:
    empty = followed(known, known)
    session = driven(lambda n: with_a_box(-2.5 + 0.5 * (n // 5 % 9)))
    walked = followed(known, session)
    assert len(walked.anchors) == len(empty.anchors) > 5
    assert walked.nats == pytest.approx(empty.nats, rel=0.2)
    assert walked.nats > 5.0


def test_what_stood_all_the_time_does(known: Walls) -> None:
    stood = followed(known, driven(lambda _: with_a_box(-0.5)))
    assert stood.nats < followed(known, known).nats - 1.0
