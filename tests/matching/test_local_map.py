"""The local map: scans in one frame, coarse and fine, and directions that a scan leaves open."""

import math

import gtsam
import numpy as np
import pytest
from flat_worlds import corridor, moved, points_at, room

from slam.config.stages import MatchConfig
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import weak_direction
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, pose2_from_row

CONFIG = MatchConfig()
FRAMES = [(0.0, 0.0, 0.0), (-40.0, 15.0, 2.6)]
NOTHING = OrientedPoints(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))


def scan_at(segments: FloatArray, pose: FloatArray, **options: object) -> OrientedPoints:
    return OrientedPoints.from_scan(points_at(segments, pose, **options))


def map_of(segments: FloatArray, *poses: FloatArray, first_seed: int = 0, **options: object) -> LocalMap:
    parts = [
        scan_at(segments, pose, seed=first_seed + n, **options).moved(pose) for n, pose in enumerate(poses)
    ]
    return LocalMap.build(parts, CONFIG)


def test_oriented_points_are_those_with_a_normal() -> None:
    points = np.array([[1, 0], [2, 0], [3, 0]], dtype=np.float32)
    normals = np.array([[-1, 0], [0, 0], [0, 1]], dtype=np.float32)
    oriented = OrientedPoints.from_scan(ScanPoints(points, normals))
    assert len(oriented) == 2
    np.testing.assert_array_equal(oriented.points, points[[0, 2]])
    np.testing.assert_array_equal(oriented.normals, normals[[0, 2]])


def test_moved_points_and_normals() -> None:
    scan = scan_at(room(), np.array([0.3, -0.2, 0.1]))
    T = gtsam.Pose2(5.0, -4.0, 1.2)
    there = scan.moved(np.array([5.0, -4.0, 1.2]))
    np.testing.assert_allclose(
        there.points, [T.transformFrom(p) for p in scan.points.astype(float)], atol=1e-5
    )
    np.testing.assert_allclose(there.normals, scan.normals @ T.rotation().matrix().T, atol=1e-6)
    assert there.points.dtype == np.float32


@pytest.mark.parametrize("count", [1, 7, 120, 300, 361, 5000])
def test_thinned_is_at_most_the_count_and_in_beam_order(count: int) -> None:
    scan = scan_at(room(), np.array([0.3, -0.2, 0.1]))
    thinned = scan.thinned(count)
    assert min(count, len(scan)) / 2 <= len(thinned) <= count
    stride = np.flatnonzero((scan.points == thinned[1]).all(axis=1))[0] if len(thinned) > 1 else 1
    np.testing.assert_array_equal(thinned, scan.points[::stride][: len(thinned)])
    assert NOTHING.thinned(count).shape == (0, 2)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(
    "displacement", [(0.0, 0.0, 0.0), (0.2, -0.15, 0.08), (0.4, -0.3, 0.15), (-0.5, 0.0, 0.2)]
)
def test_coarse_to_fine_reaches_farther_than_a_fine_cell(
    frame: tuple[float, ...], displacement: tuple[float, ...]
) -> None:
    segments = moved(room(), frame)
    home = compose(np.array(frame), np.array([0.3, -0.2, 0.1]))
    truth = compose(home, np.array(displacement))
    result = map_of(segments, home, beams=1441).align(scan_at(segments, truth), home)
    error = between(truth, result.pose)
    assert math.hypot(error[0], error[1]) < 4e-3
    assert abs(error[2]) < 1e-3
    assert result.converged
    assert result.inlier_share > 0.9


@pytest.mark.parametrize("sigma_m", [0.0, 0.01])
@pytest.mark.parametrize("frame", FRAMES)
def test_a_corridor_keeps_the_guess_along_it(frame: tuple[float, ...], sigma_m: float) -> None:
    segments = moved(corridor(), frame)
    truth = compose(np.array(frame), np.array([0.4, 0.1, 0.05]))
    local_map = map_of(segments, np.array(frame), compose(truth, np.array([0.2, 0, 0])), sigma_m=sigma_m)
    scan = scan_at(segments, truth, sigma_m=sigma_m, seed=9)
    guess = compose(truth, np.array([0.25, 0.05, 0.02]))
    result = local_map.align(scan, guess)
    assert weak_direction(result, CONFIG.degenerate_share) is not None
    wanted, found = (between(np.array(frame), pose) for pose in (guess, result.pose))
    assert found[0] == pytest.approx(wanted[0], abs=0.05)
    assert found[1] == pytest.approx(0.1, abs=0.01)
    assert found[2] == pytest.approx(0.05, abs=0.01)


def test_noise_does_not_decide_along_a_corridor() -> None:
    """Without a hold the noise of the normals moves the scan by up to a centimetre; with it, by none."""
    truth = np.array([0.4, 0.1, 0.05])
    guess = compose(truth, np.array([0.25, 0.05, 0.02]))
    found = [
        map_of(corridor(), np.zeros(3), truth, sigma_m=0.03, first_seed=3 * seed)
        .align(scan_at(corridor(), truth, sigma_m=0.03, seed=500 + seed), guess)
        .pose[0]
        for seed in range(8)
    ]
    assert np.std(found) < 1e-3


def test_a_held_scan_turns_but_hardly_moves() -> None:
    home = np.array([0.3, -0.2, 0.1])
    local_map = map_of(room(), home)
    scan = scan_at(room(), home)
    guess = compose(home, np.array([0.1, 0.0, 0.05]))
    held, free = local_map.align_held(scan, guess), local_map.align(scan, guess)
    assert math.hypot(*(free.pose - home)[:2]) < 2e-3
    assert math.hypot(*(held.pose - home)[:2]) > 0.04
    assert math.hypot(*(held.pose - guess)[:2]) < 0.06
    assert held.pose[2] == pytest.approx(home[2], abs=0.02)
    assert held.fit < free.fit


@pytest.mark.parametrize("frame", FRAMES)
def test_judging_does_not_move(frame: tuple[float, ...]) -> None:
    segments = moved(room(), frame)
    home = compose(np.array(frame), np.array([0.3, -0.2, 0.1]))
    local_map = map_of(segments, home)
    scan = scan_at(segments, home)
    good = local_map.judge(scan, home)
    beside = compose(home, np.array([0.04, 0.0, 0.0]))
    bad = local_map.judge(scan, beside)
    np.testing.assert_array_equal(good.pose, home)
    np.testing.assert_array_equal(bad.pose, beside)
    assert good.residual_m < 0.005
    # Half the walls stand across the shift.
    assert 0.015 < bad.residual_m < 0.04
    assert bad.fit < good.fit


def test_maps_and_scans_of_nothing() -> None:
    home = np.array([0.3, -0.2, 0.1])
    scan = scan_at(room(), home)
    for result in (
        LocalMap.build([NOTHING], CONFIG).align(scan, home),
        LocalMap.build([NOTHING, NOTHING], CONFIG).judge(scan, home),
        map_of(room(), home).align(NOTHING, home),
        map_of(room(), home).align_held(NOTHING, home),
    ):
        np.testing.assert_allclose(result.pose, home, atol=1e-9)
        assert result.inlier_share == 0.0
    assert NOTHING.moved(home).points.shape == (0, 2)


def test_results_know_their_frame() -> None:
    """What align gives is the base's pose in the map's frame: the scan moved there lies on the walls."""
    frame = np.array(FRAMES[1])
    segments = moved(room(), frame)
    truth = compose(frame, np.array([-0.5, 0.4, 2.0]))
    result = map_of(segments, truth).align(scan_at(segments, truth), truth)
    T = pose2_from_row(between(frame, result.pose))
    world = np.array([T.transformFrom(p) for p in scan_at(segments, truth).points.astype(float)])
    assert (np.abs(np.abs(world).max(axis=1) - 3.0) < 5e-3).mean() > 0.6
