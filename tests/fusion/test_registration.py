"""Curves from scans and images, and where they meet, in a world of closed form."""

from __future__ import annotations

import math

import numpy as np
import prism_world as world
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fusion
from fusion.curves import FORWARD, resample
from fusion.likelihood import log_ratio_map
from fusion.panorama import height_slices, join, lookup_of, yaw_of
from fusion.registration import HEIGHTS_M
from tools.xu2024_rows import register_rows, row_curves

STEP = math.radians(1.0)


def tilted(pitch, yaw=0.0):
    """A level rotation for a camera that looks down by a pitch and to the left by a yaw."""
    c, s = math.cos(pitch), math.sin(pitch)
    return world.turned(yaw) @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ FORWARD


@settings(max_examples=20, deadline=None)
@given(st.integers(20, 700), st.floats(0.5, 6.2), st.booleans())
def test_resampling_keeps_a_linear_curve_whichever_way_it_was_swept(beams, aperture, clockwise):
    step = aperture / (beams - 1)
    bearings = -0.5 * aperture + step * np.arange(beams)
    ranges = (2.0 + 0.3 * bearings).astype(np.float32)
    scan = fusion.LidarCurve(ranges, bearings[0], step)
    if clockwise:
        scan = fusion.LidarCurve(ranges[::-1].copy(), bearings[-1], -step)
    curve = resample(scan, STEP)
    assert curve.ranges_m.size == int(aperture / STEP + 1e-6) + 1
    assert curve.ranges_m == pytest.approx(2.0 + 0.3 * curve.bearings_rad(), abs=0.3 * (step + STEP))


def test_every_kind_of_invalid_reading_is_masked():
    scan = fusion.LidarCurve(np.array([1.0, 0.0, -1.0, np.nan, np.inf, 9.0, 2.0], np.float32), 0.0, STEP, 8.0)
    assert np.isfinite(scan.valid_ranges_m()).tolist() == [True, *5 * [False], True]
    with pytest.raises(ValueError, match="turn"):
        resample(fusion.LidarCurve(np.ones(800, np.float32), 0.0, STEP))


@pytest.mark.parametrize("pitch", [0.0, 0.2])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_height_slice_is_what_a_lidar_at_the_cameras_place_and_that_height_sees(pitch, yaw):
    image = world.camera(R_level_camera=tilted(pitch, yaw))
    stack = height_slices(image, HEIGHTS_M)
    v = int(np.argmin(np.abs(HEIGHTS_M + 0.3)))
    piece = stack.curve(v)
    bearings = piece.bearings_rad()
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(bearings.size)])
    truth = world.cast(np.array([0.0, 0.0, 0.6]), directions)
    seen = np.isfinite(piece.ranges_m)
    assert seen.mean() > 0.4
    apart = np.abs(piece.ranges_m - truth)[seen]
    # A pixel is 6 mrad wide: a sample beside an edge may lie on its other side.
    assert np.median(apart) < 0.02
    assert (apart < 0.1).mean() > 0.9
    assert yaw_of(image) == pytest.approx(yaw)


def test_a_pinholes_depths_become_ranges_of_a_frontal_wall():
    image = fusion.DepthImage(np.full(world.SHAPE, 2.0, np.float32), world.INTRINSICS)
    stack = row_curves(image, 5)
    middle = stack.curve(2)
    assert middle.ranges_m == pytest.approx(2.0 / np.cos(middle.bearings_rad()), rel=1e-2)
    found = lookup_of(image, STEP)
    assert found.slopes[0] > 0.0 > found.slopes[-1]


def test_a_panorama_joins_cameras_where_each_looks():
    yaws = (0.6, -0.4)
    images = [world.camera(R_level_camera=tilted(0.0, yaw)) for yaw in yaws]
    joined = join([height_slices(image, HEIGHTS_M) for image in images])
    apart = yaws[0] - yaws[1]
    single = join([height_slices(images[0], HEIGHTS_M)])
    assert joined.ranges_m.shape[1] - single.ranges_m.shape[1] == pytest.approx(apart / STEP, abs=1.5)
    assert joined.start_angle_rad == pytest.approx(-0.4 - 0.5 * 2 * math.atan(100 / 160), abs=2 * STEP)


@pytest.mark.parametrize("mount_yaw", [0.0, 0.3, -0.5])
def test_the_rig_finds_yaw_height_and_offset(mount_yaw):
    rig = fusion.Rig()
    assert rig.estimate() is None
    found = []
    for pose in world.POSES:
        scan = world.lidar(pose, mount_yaw=mount_yaw)
        pair = fusion.register(scan, world.camera(pose, offset=(0.12, -0.05)))
        rig.add(pair)
        found.append(abs(pair.yaw_rad + mount_yaw) < 2.1 * STEP)
    estimate = rig.estimate()
    assert np.mean(found) > 0.6
    assert estimate.pairs == len(world.POSES)
    assert abs(estimate.yaw_rad + mount_yaw) < STEP
    T = estimate.alignments[0].T_laser_level
    c, s = math.cos(mount_yaw), math.sin(mount_yaw)
    assert T[:2, 2] == pytest.approx([0.12 * c - 0.05 * s, -0.12 * s - 0.05 * c], abs=0.015)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(-mount_yaw, abs=0.006)


def test_low_furniture_shows_the_height():
    boxes = (*world.ROOM, world.CUPBOARD, (1.2, -1.6, 1.7, -0.9, 0.55), (2.4, 1.6, 3.0, 2.6, 0.2))
    rig = fusion.Rig()
    for pose in world.POSES:
        rig.add(fusion.register(world.lidar(pose, 0.3, boxes), world.camera(pose, 0.9, boxes)))
    assert rig.estimate().height_m == pytest.approx(-0.6, abs=0.1)


def test_rows_are_registered_as_published():
    pose = (0.0, 0.0, 0.5)
    image = world.camera(pose)
    pair = register_rows(world.lidar(pose), [image])
    assert pair.score == pair.score_map.max() == pair.score_map[pair.v, pair.u]
    # The same sums of one row alone, which BLAS may add in another order.
    assert pair.pcc == pytest.approx(pair.score, abs=1e-6)
    assert pair.grade == fusion.Grade.HIGH


def test_a_lone_wall_is_no_high_grade():
    wall = ((2.0, -9.0, 2.2, 9.0, 2.5),)
    pair = fusion.register(world.lidar(boxes=wall), world.camera(boxes=wall))
    pillar = fusion.register(world.lidar(), world.camera())
    assert pillar.confidence > pair.confidence or pair.grade == fusion.Grade.HIGH


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000))
def test_the_log_ratio_of_all_windows_is_that_of_each(seed):
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0.5, 4.0, (2, 15)).astype(np.float32)
    curve = rng.uniform(0.5, 4.0, 21).astype(np.float32)
    rows[rng.random(rows.shape) < 0.3] = np.nan
    curve[rng.random(curve.shape) < 0.3] = np.nan
    scores = log_ratio_map(rows, curve)
    for u in range(7):
        alone = log_ratio_map(rows, curve[u : u + 15])
        assert scores[:, u] == pytest.approx(alone[:, 0], abs=1e-3)


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ValueError, match="depth is empty"):
        fusion.register(world.lidar(), [])
    narrow = world.lidar(beams=40, aperture=0.3)
    with pytest.raises(ValueError, match="lidar"):
        fusion.register(narrow, world.camera())
    with pytest.raises(ValueError, match="shape"):
        fusion.DepthImage(np.ones(5, np.float32), world.INTRINSICS)
    with pytest.raises(ValueError, match="rotation"):
        fusion.DepthImage(np.ones((5, 5), np.float32), world.INTRINSICS, R_level_camera=2.0 * np.eye(3))
    rig = fusion.Rig()
    rig.add(fusion.register(world.lidar(), world.camera()))
    with pytest.raises(ValueError, match="one way"):
        rig.add(fusion.register(world.lidar(), world.camera(), heights_m=np.arange(-1.0, 0.0, 0.02)))
