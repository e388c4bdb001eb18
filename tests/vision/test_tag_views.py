"""Tags in images: poses as sure as they are, and the two of a square distinguished where they can be."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest
from tag_world import LENS, SIDE_M, seen, tag_at

from slam.config.tags import KnownPlaces
from slam.simulation.home_model import WallTag
from slam.simulation.rigs import camera_pose
from slam.vision.tags import _detector, find_tags

PLACES = KnownPlaces(size_m=SIDE_M)
CAMERA = camera_pose((0.0, 0.0, 0.5))
# Of corners: what the mean over a pixel, noise and the rounding of grey leave.
SIGMA_PX = 0.06


def off(tag: WallTag, pose: gtsam.Pose3) -> np.ndarray:
    return np.asarray(gtsam.Pose3.Logmap(CAMERA.between(tag.T_map_tag).between(pose)))


def test_poses_are_as_sure_as_they_claim() -> None:
    rng, squares = np.random.default_rng(1), []
    for number in range(25):
        x, slant = rng.uniform(0.7, 1.8), rng.uniform(0.4, 0.9) * rng.choice([-1.0, 1.0])
        tag = tag_at(number, x, rng.uniform(-0.2, 0.2) * x, math.pi + slant)
        (view,) = find_tags(seen([tag], CAMERA, number), LENS, PLACES)
        assert view.number == number
        error = off(tag, view.T_camera_tag)
        assert np.linalg.norm(error[3:]) < 0.006
        squares.append(error @ np.linalg.solve(view.covariance(SIGMA_PX), error) / 6)
    assert 0.2 < np.mean(squares) < 2.0
    assert max(squares) < 6.0


def test_a_tag_that_may_be_tilted_either_way_shows_its_place_alone() -> None:
    tag = tag_at(3, 2.2, 0.0, math.pi + 0.3)
    (view,) = find_tags(seen([tag], CAMERA), LENS, PLACES)
    covariance = view.covariance(0.3)
    assert covariance[:3, :3] == pytest.approx(math.pi**2 * np.eye(3))
    error = off(tag, view.T_camera_tag)[3:]
    assert error @ np.linalg.solve(covariance[3:, 3:], error) < 16.0
    near = tag_at(3, 0.8, 0.0, math.pi + 0.8)
    (sure,) = find_tags(seen([near], CAMERA), LENS, PLACES)
    assert math.sqrt(np.linalg.eigvalsh(sure.covariance(0.3)[:3, :3])[-1]) < 0.1


@pytest.mark.parametrize("family", ["16h5", "25h9", "4x4_50", "6x6_250", "mip_36h12", "original"])
def test_families(family: str) -> None:
    tag = tag_at(5, 1.0, 0.1, math.pi + 0.5, family)
    image = seen([tag], CAMERA)
    numbers = [view.number for view in find_tags(image, LENS, PLACES.model_copy(update={"family": family}))]
    assert numbers == [5]
    assert find_tags(image, LENS, PLACES) == []
    assert find_tags(image, LENS, KnownPlaces()) == []


def test_a_tag_of_another_size_is_as_far_as_it_is() -> None:
    tag = replace(tag_at(7, 1.5, 0.0, math.pi + 0.5), side_m=0.3)
    image = seen([tag], CAMERA)
    (view,) = find_tags(image, LENS, PLACES.model_copy(update={"sizes_m": {7: 0.3}}))
    assert np.linalg.norm(off(tag, view.T_camera_tag)[3:]) < 0.006
    (wrong,) = find_tags(image, LENS, PLACES)
    assert wrong.T_camera_tag.z() == pytest.approx(1.5 * SIDE_M / 0.3, rel=0.01)


def test_a_tag_that_is_too_small_to_show_its_edges_is_left_out() -> None:
    """OpenCV finds it, with corners of whole pixels, which are farther off than those of other tags."""
    tag = tag_at(3, 3.4, 0.3, math.pi + 0.9)
    image = seen([tag], CAMERA)
    (_,), (number,), _ = _detector("36h11").detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    assert number == 3
    assert find_tags(image, LENS, PLACES) == []
