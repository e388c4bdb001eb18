"""Laws of evidence that distinguishes the heights of a cell."""

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fusion.bayes import FREE, OCCUPIED, UNKNOWN
from fusion.height_band import HeightBand
from slam.config import Config
from slam.mapping.depth_grid import DepthModel
from slam.mapping.evidence_tiles import TILE_BYTES, Board, EvidenceTiles
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.view_coverage import free_heights, holes_cleared
from slam.measurements import CameraIntrinsics, RgbdFrame
from tools.layer_building import build_layers

CAMERA = CameraIntrinsics(240.0, 240.0, 159.5, 119.5, 320, 240)
OPTICAL = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
DEPTH = DepthModel(HeightBand(0.0, 0.5, 0.02), 4.0, least_neighbours=2, voxel_m=0.0, pixel_stride=1)
SETTINGS = replace(layer_settings(Config()), depth=DEPTH, robot_radius_m=0.0)
AT = np.array([[1.52, 0.02]])


def mount(pitch_deg):
    return gtsam.Pose3(
        gtsam.Rot3.Ypr(0.0, math.radians(pitch_deg), 0.0).compose(OPTICAL), np.array([0.0, 0.0, 0.5])
    )


def frame(stamp, pitch_deg=12.0, box_m=None, rows=slice(None)):
    """Floor, a wall at x = 3 and a box from x = 1.5 of that height, in some rows of the image."""
    at = mount(pitch_deg)
    u, v = np.meshgrid((np.arange(320) - 159.5) / 240.0, (np.arange(240) - 119.5) / 240.0)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ at.rotation().matrix().T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.minimum(np.where(rays[:, 2] < 0, -0.5 / rays[:, 2], np.inf), 3.0 / rays[:, 0])
        if box_m is not None:
            low, high = np.array([1.5, -0.3, 0.0]), np.array([1.7, 0.3, box_m])
            start = np.array([0.0, 0.0, 0.5])
            one, other = (low - start) / rays, (high - start) / rays
            enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            depth = np.where((enter <= leave) & (enter > 0), np.minimum(depth, enter), depth)
    image = np.zeros((240, 320), np.float32)
    image[rows] = depth.reshape(240, 320)[rows]
    return RgbdFrame(stamp, np.zeros((240, 320, 3), np.uint8), image, CAMERA, at)


def state(frames):
    built = build_layers(frames, [gtsam.Pose2()] * len(frames), SETTINGS)
    row, col = built.grid("depth").cells_of(AT)[0]
    return built.states("depth")[row, col]


# Two parts of the image that together hold all rays through the cell and neither of them all heights.
UPPER, LOWER = slice(0, 130), slice(130, 240)


def test_what_no_image_saw_whole_is_free_when_together_they_did():
    def seen(*parts):
        return state([frame(float(i), rows=parts[i % len(parts)]) for i in range(6)])

    assert seen(slice(None)) == FREE
    assert seen(UPPER) == seen(LOWER) == UNKNOWN
    assert seen(UPPER, LOWER) == FREE


@pytest.mark.parametrize("order", [1, -1])
def test_who_left_is_cleared_by_images_that_each_see_a_part(order):
    gone = [frame(1.0 + i, rows=(UPPER, LOWER)[i % 2]) for i in range(16)]
    assert state([frame(0.0, box_m=1.5), *gone][::order]) == FREE


def test_a_low_box_stays_however_often_rays_pass_over_it():
    assert state([frame(0.0, box_m=0.1), *(frame(1.0 + i, box_m=0.1, rows=UPPER) for i in range(30))]) == (
        OCCUPIED
    )
    # Seen away at its own heights, its top's too, it goes.
    own = slice(120, 240)
    assert state([frame(0.0, box_m=0.1), *(frame(1.0 + i, rows=own) for i in range(8))]) != OCCUPIED


def test_a_height_seen_in_part_is_not_free():
    mask = np.array([[0b1111111, 0b1110111, 0b1111110]], np.uint64)
    board = np.zeros((1, 3, 4), np.int16)
    free_heights(mask, board, -7)
    assert board.tolist() == [[[-7, -7, -7, -7], [-7, -7, 0, -7], [0, -7, -7, -7]]]


def test_a_hole_is_free_as_far_as_what_is_below_and_above_it():
    image = np.array([[0, 3, 3, 2], [2, 0, 0, 0], [0, 0, 4, 0], [1, 2, 0, 0]], np.float32)
    assert holes_cleared(image).tolist() == [[0, 3, 3, 2], [2, 2, 3, 0], [1, 2, 4, 0], [1, 2, 0, 0]]


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, -90.0, 180.0])
def test_beyond_the_reach_of_the_camera_a_room_is_free(roll_deg):
    """The wall is too far to be measured in the image's middle; its lowest and highest rows are not."""
    whole = frame(0.0)
    depth = whole.depth_m.copy()
    depth[60:126] = 0.0
    turns = int(roll_deg) // 90
    image = np.ascontiguousarray(np.rot90(depth, turns))
    roll = gtsam.Pose3(gtsam.Rot3.Rz(math.radians(roll_deg)), np.zeros(3))
    camera = CameraIntrinsics(240.0, 240.0, *(0.5 * (n - 1) for n in image.shape[::-1]), *image.shape[::-1])

    def turned(stamp_s, image):
        color = np.zeros((*image.shape, 3), np.uint8)
        return RgbdFrame(stamp_s, color, image, camera, whole.T_base_camera.compose(roll))

    assert state([turned(float(i), image) for i in range(4)]) == FREE
    # Where nothing is above a hole, nobody knows what hangs there.
    depth[:60] = 0.0
    image = np.ascontiguousarray(np.rot90(depth, turns))
    assert state([turned(float(i), image) for i in range(4)]) == UNKNOWN


def test_a_height_that_nothing_measured_keeps_a_cell_unknown():
    tiles = EvidenceTiles(heights=5)
    steps = np.full((1, 2, 5), -300, np.int16)
    steps[0, 1, 3] = 0
    tiles.add(Board(steps, 4, 7))
    assert tiles.clipped((4, 7, 1, 2), -1000, 1000).tolist() == [[-300, 0]]
    # What says nothing of heights, as the robot's own body, counts for all.
    tiles.add(Board(np.full((1, 2), -50, np.int16), 4, 7))
    assert tiles.clipped((4, 7, 1, 2), -1000, 1000).tolist() == [[-350, -50]]
    steps[:] = 0
    steps[0, 0, 2] = 900
    tiles.add(Board(steps, 4, 7))
    assert tiles.clipped((4, 7, 1, 2), -1000, 1000).tolist() == [[550, -50]]


@pytest.mark.parametrize("heights", [1, 7, 31])
def test_tiles_with_heights_keep_to_the_memory_and_lose_nothing(heights):
    rng = np.random.default_rng(3)
    small, large = EvidenceTiles(5 * TILE_BYTES / 1e6, heights), EvidenceTiles(500.0, heights)
    for _ in range(40):
        steps = rng.integers(-900, 900, (90, 70, heights)).astype(np.int16)
        board = Board(steps, *map(int, rng.integers(-900, 900, 2)))
        small.add(board)
        large.add(board)
    assert sum(tile.nbytes for tile in small._loaded.values()) <= 5 * TILE_BYTES
    assert small._spilled
    box = (-1000, -1000, 2100, 2100)
    np.testing.assert_array_equal(small.clipped(box, -4000, 4000), large.clipped(box, -4000, 4000))
