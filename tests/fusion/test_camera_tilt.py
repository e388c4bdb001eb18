import math

import gtsam
import numpy as np
import pytest

from tools.yang2021_camera_tilt import camera_tilt

OPTICAL = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def mount(height, pitch, roll):
    return gtsam.Pose3(gtsam.Rot3.Ypr(0.0, pitch, roll).compose(OPTICAL), np.array([0.0, 0.0, height]))


def clouds(rng, T_base_camera, floor_shares, table=False):
    """A floor before the robot, a wall at another distance in each image, and maybe a large table."""
    made = []
    for share in floor_shares:
        count = int(3000 * share)
        floor = np.column_stack([rng.uniform([0.8, -1.2], [3.5, 1.2], (count, 2)), np.zeros(count)])
        far, turn = rng.uniform(1.0, 4.0), rng.uniform(-0.6, 0.6)
        side, up = rng.uniform(-2, 2, 3000), rng.uniform(0, 1.5, 3000)
        wall = np.column_stack([far + turn * side, side, up])
        parts = [floor, wall]
        if table:
            parts.append(np.column_stack([rng.uniform([1, -1], [2.5, 1], (2500, 2)), np.full(2500, 0.4)]))
        points = np.concatenate(parts) + rng.normal(0, 0.004, (sum(map(len, parts)), 3))
        made.append(T_base_camera.transformTo(points.T).T)
    return made


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.26, 0.03), (0.5, -0.1), (-0.1, 0.0)])
@pytest.mark.parametrize("table", [False, True])
def test_height_and_tilt_are_found_among_walls_and_tables(pitch, roll, table):
    rng = np.random.default_rng(3)
    T = mount(0.68, pitch, roll)
    found = camera_tilt(clouds(rng, T, (1.0, 0.5, 0.0, 0.8, 0.3, 0.7), table), rng)
    assert found is not None
    assert found.height_m == pytest.approx(0.68, abs=0.004)
    assert found.pitch_rad == pytest.approx(pitch, abs=math.radians(0.15))
    assert found.roll_rad == pytest.approx(roll, abs=math.radians(0.15))
    np.testing.assert_allclose(found.R_level_camera(), T.rotation().matrix(), atol=0.004)
    assert found.spread_m < 0.006
    assert found.frame_share == pytest.approx(5 / 6)
    assert found.share_below < 0.01


def test_without_a_floor_nothing_is_made_up():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.full(500, 2.0)])
    assert camera_tilt([wall], rng) is None
    assert camera_tilt([], rng) is None
    assert camera_tilt([np.zeros((2, 3))], rng) is None
