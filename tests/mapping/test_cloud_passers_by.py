"""What passed by in clouds: it goes, and what is fixed stays."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from fusion.voxel_hash import AXIS_BITS, index_keys, table_for
from slam.mapping.cloud_passers_by import PassedBy, count_looks, passed_by, spread
from slam.mapping.elevation import elevation
from slam.matching.local_cloud import moved
from slam.measurements import BoolArray, FloatArray

LIDAR_M = 1.5
COUNT = 12


def rays() -> FloatArray:
    """Beams of a lidar, unit vectors."""
    turn, up = np.meshgrid(np.radians(np.arange(-180.0, 180.0, 0.8)), np.radians(np.arange(-25.0, 8.0, 0.8)))
    level = np.cos(up)
    return np.column_stack(
        [(level * np.cos(turn)).ravel(), (level * np.sin(turn)).ravel(), np.sin(up).ravel()]
    )


def seen_from(x: float, box_x: float | None) -> tuple[FloatArray, BoolArray]:
    """Ground, walls at y = +-8 and x = 20, a box of 2 x 1 x 1.6 m at y = 3: points, and which are on it."""
    beams, start = rays(), np.array([x, 0.0, LIDAR_M])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = [(0.0 - start[2]) / beams[:, 2], (20.0 - x) / beams[:, 0], 8.0 / np.abs(beams[:, 1])]
        away = np.min([np.where(one > 0.0, one, np.inf) for one in far], axis=0)
        on_box = np.zeros(len(beams), np.bool_)
        if box_x is not None:
            corners = np.array([[box_x, 2.5, 0.0], [box_x + 2.0, 3.5, 1.6]]) - start
            near, back = np.sort(corners[:, None] / beams, axis=0)
            enter, leave = near.max(axis=1), back.min(axis=1)
            on_box = (enter > 0.0) & (enter < leave) & (enter < away)
            away = np.where(on_box, enter, away)
    kept = away < 40.0
    return (beams * away[:, None])[kept], on_box[kept]


def gone(boxes: list[float | None]) -> tuple[PassedBy, list[FloatArray], list[BoolArray], list[gtsam.Pose3]]:
    """What is taken out of a drive along x, the box where it is reported."""
    steps = 0.8 * np.arange(len(boxes))
    clouds, marks = zip(*(seen_from(x, box) for x, box in zip(steps, boxes, strict=True)), strict=True)
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, LIDAR_M])) for x in steps]
    ground = elevation(clouds, poses, -LIDAR_M, 15.0)
    assert ground is not None
    surface = [moved(points, pose) for points, pose in zip(clouds, poses, strict=True)]
    found = passed_by(surface, surface, poses, gtsam.Pose3(), ground, 50.0)
    return found, list(clouds), list(marks), poses


def left_of(
    found: PassedBy, clouds: list[FloatArray], marks: list[BoolArray], poses: list[gtsam.Pose3]
) -> tuple[float, float]:
    """Shares of points that stay: of the box above its foot, of all else."""
    boxes = [
        points[mark & (points[:, 2] > 0.5 - LIDAR_M)] for points, mark in zip(clouds, marks, strict=True)
    ]
    others = [points[~mark] for points, mark in zip(clouds, marks, strict=True)]
    box, other = (
        1.0
        - sum(np.count_nonzero(found.holds(moved(*one))) for one in zip(parts, poses, strict=True))
        / max(sum(map(len, parts)), 1)
        for parts in (boxes, others)
    )
    return box, other


@pytest.mark.parametrize("backward", [False, True], ids=["goes", "comes"])
def test_a_car_that_drives_by_goes(backward: bool) -> None:
    boxes: list[float | None] = [2.0 + 2.5 * n if n < 6 else None for n in range(COUNT)]
    box, other = left_of(*gone(boxes[::-1] if backward else boxes))
    assert box < 0.1
    assert other > 0.995


def test_a_parked_car_and_the_walls_stay() -> None:
    box, other = left_of(*gone([6.0] * COUNT))
    assert box > 0.99
    assert other > 0.999


def test_of_what_is_fixed_nearly_nothing_goes() -> None:
    found, clouds, marks, poses = gone([None] * COUNT)
    assert left_of(found, clouds, marks, poses)[1] > 0.9999
    ground = elevation(clouds, poses, -LIDAR_M, 15.0) or pytest.fail()
    empty = passed_by([], [], [], gtsam.Pose3(), ground, 50.0)
    assert not empty.holds(clouds[0]).any()
    assert not len(empty.keys)


@pytest.mark.parametrize(("aside", "passed"), [(0, 0), (4, 0), (9, 1)])
def test_a_voxel_is_passed_by_all_beams_through_it_or_not_at_all(aside: int, passed: int) -> None:
    # 20 cm at 3 m are 7 pixels of half a degree each way from the middle.
    picture = np.full((361, 720), 20.0)
    picture[180, 360 + aside] = 3.0 if aside else 3.18
    counts, at = np.zeros((1, 4), np.int32), (np.array([180]), np.array([360]), np.array([3.0]))
    newest = np.array([-1], np.int32)
    count_looks(np.array([0]), 0.17, np.radians(0.5), 0, newest, *at, picture, counts)
    assert counts[0, 3] == passed


def test_what_hangs_together_goes_together_where_it_may() -> None:
    keys = (np.array([4, 5, 6, 7, 9]) << 2 * AXIS_BITS) + (9 << AXIS_BITS) + 9
    table, gone = table_for(len(keys)), np.array([True, False, False, False, False])
    index_keys(keys, table)
    spread(keys, table, np.array([True, True, True, False, True]), gone)
    assert gone.tolist() == [True, True, True, False, False]
