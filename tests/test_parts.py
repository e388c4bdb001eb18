"""The parts on plain arrays: they say what the mapper's own do, and refuse what is no scan or window."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flat_worlds import box, corridor, room, sweep

import slam
from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.loop_closure import LoopCloser
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.matching.local_map import OrientedPoints
from slam.matching.scan_points import extract_points, orient_points
from slam.measurements import FloatArray, row_from_pose2

NOW = np.array([0.25, -0.1, 0.15])


def pose_of(found: slam.MotionEstimate | slam.LoopCandidate) -> FloatArray:
    """(3,) x, y, yaw of what was found."""
    motion = found.motion if isinstance(found, slam.LoopCandidate) else found
    assert motion is not None
    return row_from_pose2(motion.T_reference_base)


class TestMatch:
    @pytest.mark.parametrize("mount", [gtsam.Pose2(), gtsam.Pose2(0.2, -0.1, 0.7)])
    def test_the_motion_between_two_scans(self, mount: gtsam.Pose2) -> None:
        motion = slam.match_scans(sweep(room(), (0, 0, 0), mount=mount), sweep(room(), NOW, mount=mount))
        np.testing.assert_allclose(pose_of(motion), NOW, atol=0.003)
        assert motion.inlier_share > 0.95 and not motion.degenerate

    @pytest.mark.parametrize("range_max_m", [40.0, 3.1])
    def test_points_say_what_their_scan_says(self, range_max_m: float) -> None:
        config = slam.load_config(overrides=[f"scan.range_max_m={range_max_m}"])
        before, now = sweep(room(), (0, 0, 0)), sweep(room(), NOW)
        of_scans = slam.match_scans(before, now, config=config)
        of_points = slam.match_scans(before.points_laser(), now.points_laser(), config=config)
        np.testing.assert_allclose(pose_of(of_points), pose_of(of_scans), atol=1e-6)
        np.testing.assert_allclose(of_points.covariance, of_scans.covariance, rtol=1e-4)

    def test_the_order_of_points_is_nothing(self) -> None:
        scan = sweep(room(), NOW)
        mixed = np.random.default_rng(0).permutation(scan.points_laser())
        expected, found = extract_points(scan, 0.1, 40.0, 4), orient_points(mixed, 0.1, 40.0, 4)
        np.testing.assert_array_equal(found.points_base, expected.points_base)
        np.testing.assert_allclose(found.normals_base, expected.normals_base, atol=1e-6)

    def test_a_guess_leads_to_the_match_that_is_near_it(self) -> None:
        square = box(-2, -2, 2, 2)
        before, now = sweep(square, (0, 0, 0)), sweep(square, (0.1, 0.0, 0.0))
        turned = slam.match_scans(before, now, (0.0, 0.1, np.pi / 2))  # a quarter turn is as good in a square
        np.testing.assert_allclose(pose_of(turned), (0.0, 0.1, np.pi / 2), atol=0.003)

    def test_several_references(self) -> None:
        poses = np.array([[4.0, 1.0, 0.5], [4.3, 1.2, 0.3]])  # in a frame far from the room's
        T_frame_room = gtsam.Pose2(*poses[0])
        stood = [T_frame_room.between(gtsam.Pose2(*pose)) for pose in poses]
        scans = [sweep(room(), (one.x(), one.y(), one.theta())) for one in stood]
        guess = T_frame_room.compose(gtsam.Pose2(0.2, 0.0, 0.1))
        motion = slam.match_scans(scans, sweep(room(), NOW), row_from_pose2(guess), reference_poses=poses)
        expected = row_from_pose2(T_frame_room.compose(gtsam.Pose2(*NOW)))
        np.testing.assert_allclose(pose_of(motion), expected, atol=0.003)

    def test_a_corridor_is_open_along_it(self) -> None:
        motion = slam.match_scans(sweep(corridor(), (0, 0, 0)), sweep(corridor(), (0.3, 0.1, 0.0)))
        assert motion.degenerate and abs(motion.weak_direction[0]) > 0.99
        assert motion.covariance[0, 0] > 0.2 > 1e-3 > motion.covariance[1, 1]

    def test_nothing_seen_is_no_match(self) -> None:
        assert slam.match_scans(sweep(room(), (0, 0, 0)), np.zeros((0, 2))).inlier_share == 0.0

    @pytest.mark.parametrize(
        ("arguments", "reported"),
        [
            (
                (np.zeros((5, 3)), np.ones((5, 2))),
                r"a scan is float64\[5, 3\]; give numbers of shape \(N, 2\)",
            ),
            ((np.full((5, 2), np.nan), np.ones((5, 2))), "a scan: 10 of 10 numbers are not finite"),
            (
                (np.ones((5, 2)), np.ones((5, 2)), (0.0, 0.0)),
                r"the guess is float64\[2\]; give numbers of shape \(3\)",
            ),
            (
                (np.ones((5, 2)), np.ones((5, 2)), (0.0, 0.0, np.inf)),
                "the guess: 1 of 3 numbers are not finite",
            ),
            (([np.ones((5, 2))] * 2, np.ones((5, 2))), "2 scans without poses make no place"),
            (([], np.ones((5, 2))), "0 scans without poses make no place"),
        ],
    )
    def test_what_is_no_scan_or_guess(self, arguments: tuple, reported: str) -> None:  # type: ignore[type-arg]
        with pytest.raises(slam.ScanweaveError, match=reported):
            slam.match_scans(*arguments)

    def test_a_pose_for_every_reference(self) -> None:
        with pytest.raises(slam.ScanweaveError, match=r"the poses of 2 scans is float64\[3, 3\]; give"):
            slam.match_scans([np.ones((5, 2))] * 2, np.ones((5, 2)), reference_poses=np.zeros((3, 3)))


class TestLoop:
    FAR = np.array([1.2, -0.8, 0.3])

    def test_a_place_seen_again_from_elsewhere(self) -> None:
        loop = slam.check_loop(sweep(room(), (0, 0, 0)), sweep(room(), self.FAR))
        assert loop.accepted and loop.reason == ""
        np.testing.assert_allclose(pose_of(loop), self.FAR, atol=0.005)
        far_off = slam.match_scans(sweep(room(), (0, 0, 0)), sweep(room(), self.FAR))
        assert np.hypot(*(pose_of(far_off) - self.FAR)[:2]) > 0.1, "else no search was needed"

    def test_it_judges_as_the_mapper_does(self) -> None:
        place, scan = sweep(room(), (0, 0, 0)), sweep(room(), self.FAR)
        closer = LoopCloser(LoopConfig(), MatchConfig())
        for number, one in enumerate((place, scan)):
            points = OrientedPoints.from_scan(extract_points(one, 0.1, 40.0, 4))
            closer.submaps.add(points, np.zeros(3), 100.0 * number)
        sigmas = np.array([0.5, 0.5, 0.1])  # three of them make the window below
        expected = closer.verify(0, 1, np.zeros(3), np.diag(sigmas**2))
        found = slam.check_loop(place, scan, half_width_m=1.5, half_yaw_rad=expected.half_yaw_rad)
        assert found.accepted and replace(found, motion=None) == replace(expected, motion=None)
        np.testing.assert_array_equal(pose_of(found), pose_of(expected))

    def test_another_place(self) -> None:
        loop = slam.check_loop(sweep(room(), (0, 0, 0)), sweep(box(-1, -4, 7, 1), self.FAR))
        assert not loop.accepted and loop.reason

    def test_the_window_lies_about_the_guess(self) -> None:
        place, turned = sweep(room(), (0, 0, 0)), sweep(room(), (0, 0, 1.0))
        window = {"half_width_m": 0.5, "half_yaw_rad": 0.4}
        assert not slam.check_loop(place, turned, **window).accepted
        loop = slam.check_loop(place, turned, (0.3, 0.0, 0.8), **window)
        assert loop.accepted
        np.testing.assert_allclose(pose_of(loop), (0.0, 0.0, 1.0), atol=0.005)

    def test_a_place_of_several_scans(self) -> None:
        poses = np.array([[0.0, 0.0, 0.0], [0.8, 0.3, 0.4]])
        place = [sweep(room(), pose) for pose in poses]
        loop = slam.check_loop(place, sweep(room(), self.FAR), place_poses=poses)
        assert loop.accepted
        np.testing.assert_allclose(pose_of(loop), self.FAR, atol=0.005)

    def test_too_few_points(self) -> None:
        scan, few = sweep(room(), (0, 0, 0)), np.ones((3, 2))
        assert slam.check_loop(few, scan).reason == "the place has too few points"
        assert slam.check_loop(scan, few).reason == "the scan has too few points"

    @pytest.mark.parametrize("window", [(-1.0, 0.1), (np.inf, 0.1), (1.0, np.nan), (1.0, 4.0)])
    def test_a_window_that_is_none(self, window: tuple[float, float]) -> None:
        scan = sweep(room(), (0, 0, 0))
        with pytest.raises(slam.ScanweaveError, match=r"cannot be searched|not finite"):
            slam.check_loop(scan, scan, half_width_m=window[0], half_yaw_rad=window[1])


class TestGrid:
    POSES = np.array([[0.0, 0.0, 0.0], [0.5, 0.4, 1.0]])

    def test_it_is_the_grid_of_a_map(self) -> None:
        scans = [sweep(room(), pose) for pose in self.POSES]
        config = slam.load_config(overrides=["grid.resolution_m=0.1"])
        grid, expected = (
            slam.grid_of_scans(scans, self.POSES, config),
            grid_of_keyframes(scans, self.POSES, config),
        )
        assert expected is not None and grid.resolution_m == 0.1
        np.testing.assert_array_equal(grid.states(), expected.states())
        rows, columns = (grid.states() == 100).nonzero()
        assert np.ptp(rows) * 0.1 == pytest.approx(6.0, abs=0.2)
        assert np.ptp(columns) * 0.1 == pytest.approx(6.0, abs=0.2)

    def test_what_makes_no_grid(self) -> None:
        with pytest.raises(slam.ScanweaveError, match="no scan was given"):
            slam.grid_of_scans([], np.zeros((0, 3)))
        with pytest.raises(slam.ScanweaveError, match=r"the poses of 1 scans is float64\[2, 3\]; give"):
            slam.grid_of_scans([sweep(room(), (0, 0, 0))], self.POSES)
        with pytest.raises(slam.ScanweaveError, match="the poses of 1 scans: 1 of 3 numbers are not finite"):
            slam.grid_of_scans([sweep(room(), (0, 0, 0))], [[0.0, np.nan, 0.0]])
