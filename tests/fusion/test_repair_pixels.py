"""What an image itself supports is kept, what flies or lies behind in a patch is put right."""

from __future__ import annotations

import numpy as np
import prism_world as world
import pytest

import fusion
from fusion.alignment import Alignment, planar
from fusion.repair_pixels import _around, island_size

OFFSET = (0.1, 0.02)
POSE = (0.0, 0.0, 0.2)
FILLED = fusion.Provenance.FILLED


def rig(low_m=-0.6, high_m=-0.6):
    alignment = Alignment(planar(*OFFSET, 0.0), np.eye(3))
    return fusion.RigEstimate(0, 0.0, -0.6, (low_m, high_m), 0, 99, (alignment,), 0)


def size(image, row, col, most):
    depth = np.ascontiguousarray(image, dtype=np.float32)
    islands = (depth, np.zeros(depth.size, np.int32), np.empty(most + 1, np.int32))
    return island_size(row * depth.shape[1] + col, islands, 0.01), islands[1].reshape(depth.shape)


def test_an_island_is_as_large_as_what_hangs_together():
    image = np.full((9, 11), 2.0)
    image[3:5, 4:7] = 2.3
    image[5, 7] = 2.3  # touches at a corner only
    found, known = size(image, 4, 5, 20)
    assert found == 6
    assert (known[3:5, 4:7] == 6).all() and known[5, 7] == 0
    assert size(image, 0, 0, 20)[0] == 21
    assert size(image, 5, 7, 20)[0] == 1


def test_an_island_ends_at_holes_and_at_the_border_and_a_slant_is_one_surface():
    image = np.zeros((6, 6))
    image[0, :3] = 1.5
    assert size(image, 0, 1, 20)[0] == 3
    slanted = np.tile(2.0 + 0.015 * np.arange(30), (2, 1))
    assert size(slanted, 0, 0, 59)[0] == 60
    assert size(slanted, 0, 0, 58)[0] == 59


def kept_share(image, result):
    """Of the readings, those that are as they were."""
    good = image.depth_m > 0.0
    return 1.0 - (np.abs(result.depth_m[0] - image.depth_m)[good] > 0.05).mean()


@pytest.mark.parametrize("top_m", [0.302, 0.31, 0.32])
def test_a_top_at_the_height_of_the_lidar_is_kept(top_m):
    boxes = (*world.ROOM, (1.4, -0.7, 2.4, 0.9, top_m))
    scan, image = world.lidar(POSE, 0.3, boxes), world.camera(POSE, 0.9, boxes, OFFSET)
    assert kept_share(image, fusion.denoise(scan, image, rig(-0.66, -0.54))) > 0.9995


def test_the_wall_over_a_box_that_the_lidar_meets_is_kept():
    boxes = (*world.ROOM, (1.2, -0.5, 1.5, 0.2, 0.34), (1.3, 0.5, 1.5, 0.7, 0.33))
    scan, image = world.lidar(POSE, 0.3, boxes), world.camera(POSE, 0.33, boxes, OFFSET)
    found = fusion.RigEstimate(0, 0.0, -0.03, (-0.09, 0.05), 0, 99, rig().alignments, 0)
    assert kept_share(image, fusion.denoise(scan, image, found)) > 0.9999


@pytest.mark.parametrize("off_m", [-0.5, 0.4])
def test_a_pixel_that_flies_is_put_right(off_m):
    scan, image = world.lidar(POSE, 0.3), world.camera(POSE, 0.9, offset=OFFSET)
    rows = np.arange(world.SHAPE[0])[:, None]
    above = -(rows - world.INTRINSICS.cy) / world.INTRINSICS.fy * image.depth_m
    row = np.argmin(np.abs(above + 0.6), axis=0)
    depth = image.depth_m.copy()
    columns = np.arange(70, 130, 12)
    depth[row[columns], columns] += np.float32(off_m)
    result = fusion.denoise(scan, fusion.DepthImage(depth, image.intrinsics), rig())
    at = (row[columns], columns)
    assert (result.depth_source[0][at] == FILLED).mean() >= 0.8
    put_right = result.depth_source[0][at] == FILLED
    assert np.abs(result.depth_m[0] - image.depth_m)[at][put_right].max() < 0.05


def test_the_readings_above_and_below_show_how_far_they_are_off():
    pixels, ones = np.arange(5, dtype=np.int32)[:, None], np.ones((5, 1), np.float32)

    def beside(*depth):
        return _around(0, 2, 2.0, np.array(depth, np.float32), (pixels, ones, ones[:, 0]), 9.0, 0.025)

    off = np.log1p(1.0 / (0.04 + 0.025 * 2.0))
    assert beside(2.0, 0.0, 0.0, 0.0, 1.0) == pytest.approx((0.0, off))
    assert beside(0.0, 0.0, 0.0, 1.0, 2.0) == pytest.approx((off, off))  # nothing above: as below
    assert beside(0.0, 0.0, 0.0, 0.0, 0.0) == (0.0, 0.0)
