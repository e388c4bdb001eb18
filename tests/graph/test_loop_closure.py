"""Loops: the start is recognised after a drifting round, other places are not, every verdict is reported."""

import itertools
import logging

import numpy as np
import pytest
from flat_worlds import corridor, points_at

from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import LoopCloser
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, row_from_pose2
from slam.simulation.floor_plan import TOUR_M, walls

NOTHING = OrientedPoints(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
MATCH = MatchConfig()
STEP_SIGMAS = np.array([0.03, 0.03, 0.01])
# The first round of the tour: along the corridor, through two rooms, and back to the first point.
ROUND = TOUR_M[:6]


def round_trip(spacing_m: float = 0.25) -> FloatArray:
    """True poses on the first round of the building's tour, and a little into the second, (N, 3)."""
    poses = []
    corners = np.vstack([ROUND, ROUND[1]])
    for n, (a, b) in enumerate(itertools.pairwise(corners)):
        way = np.linalg.norm(b - a)
        yaw = np.arctan2(*(b - a)[::-1])
        last = n == len(corners) - 2
        for s in np.arange(0.0, 1.5 if last else way, spacing_m):
            poses.append([*(a + (b - a) * s / way), yaw])
    return np.array(poses)


class Drive:
    """Keyframes fed to a loop closer one by one, with a drift that the chain's covariances admit."""

    def __init__(
        self,
        drift: tuple[float, ...] = (0.0, 0.0, 0.0),
        match: MatchConfig = MATCH,
        **settings: object,
    ) -> None:
        self.closer = LoopCloser(LoopConfig(**settings), match)
        self.uncertainty = UncertaintyGraph()
        self.drift = np.array(drift)
        self.poses = np.zeros((0, 3))
        self.truth = np.zeros((0, 3))
        self.travelled_m = 0.0

    def add(self, truth: FloatArray, scan: OrientedPoints) -> list[LoopCandidate]:
        """The next keyframe and what it closes."""
        key = len(self.poses)
        self.uncertainty.add_node()
        if key == 0:
            pose = np.array([5.0, 5.0, 1.0])
        else:
            step = between(self.truth[-1], truth) + self.drift
            pose = compose(self.poses[-1], step)
            self.travelled_m += float(np.hypot(step[0], step[1]))
            self.uncertainty.add_edge(key - 1, key, step, np.diag(STEP_SIGMAS**2))
        self.poses = np.vstack([self.poses, pose])
        self.truth = np.vstack([self.truth, truth])
        self.closer.submaps.add(scan, pose, self.travelled_m)
        return self.closer.close(key, self.poses, self.uncertainty)

    def round(self) -> list[LoopCandidate]:
        """The whole round through the building."""
        found = []
        rng = np.random.default_rng(0)
        for truth in round_trip():
            points = points_at(walls(), truth, sigma_m=0.01, seed=rng, beams=271)
            found += self.add(truth, OrientedPoints.from_scan(points))
        return found


@pytest.fixture(scope="module")
def drifted() -> tuple[Drive, list[LoopCandidate]]:
    """A round that misses its start by more than a metre."""
    drive = Drive(drift=(0.008, -0.005, 0.003))
    return drive, drive.round()


def error_of(loop: LoopCandidate, truth: FloatArray) -> FloatArray:
    """x, y, yaw by which a loop's claim is wrong."""
    assert loop.motion is not None
    claim = row_from_pose2(loop.motion.T_reference_base)
    return between(between(truth[loop.place], truth[loop.keyframe]), claim)


def test_a_round_closes_at_its_start(drifted: tuple[Drive, list[LoopCandidate]]) -> None:
    drive, loops = drifted
    missed = between(between(drive.truth[0], drive.truth[-1]), between(drive.poses[0], drive.poses[-1]))
    assert np.hypot(*missed[:2]) > 0.8, "the drift is worth the name"
    home = [loop for loop in loops if loop.accepted and loop.place < 20]
    assert len(home) >= 2
    for loop in home:
        error = error_of(loop, drive.truth)
        # The submap itself drifts over the half dozen keyframes around its place.
        assert np.hypot(error[0], error[1]) < 0.05
        assert abs(error[2]) < 0.025


def test_every_accepted_loop_is_true(drifted: tuple[Drive, list[LoopCandidate]]) -> None:
    drive, loops = drifted
    for loop in loops:
        if loop.accepted:
            assert np.abs(error_of(loop, drive.truth)).max() < 0.1


def test_the_verdicts_are_reported(drifted: tuple[Drive, list[LoopCandidate]]) -> None:
    drive, loops = drifted
    for loop in loops:
        assert loop.accepted == (loop.reason == "")
        assert 0.0 <= loop.score <= 1.0
        assert 0 <= loop.place < loop.keyframe < len(drive.poses)
        assert loop.half_width_m <= LoopConfig().reach_m
        assert loop.motion is not None or not loop.accepted
    tried = {loop.keyframe for loop in loops}
    assert max(sum(loop.keyframe == key for loop in loops) for key in tried) <= LoopConfig().near


def test_no_loop_is_shorter_than_the_least_path(drifted: tuple[Drive, list[LoopCandidate]]) -> None:
    drive, loops = drifted
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(drive.poses[:, :2], axis=0).T))])
    assert loops
    assert min(way[loop.keyframe] - way[loop.place] for loop in loops) > LoopConfig().least_path_m - 1e-6


def test_attempts_are_spaced(drifted: tuple[Drive, list[LoopCandidate]]) -> None:
    drive, loops = drifted
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(drive.poses[:, :2], axis=0).T))])
    tried = sorted({loop.keyframe for loop in loops})
    assert np.diff(way[tried]).min() > LoopConfig().every_m - 1e-6


def test_disabled_means_none() -> None:
    assert Drive(enabled=False).round() == []


def line_drive(drive: Drive, first: OrientedPoints, last: OrientedPoints) -> list[LoopCandidate]:
    """Out 8 m and back along one line: the start is drawn by ``first``, the return sees ``last``."""
    found = []
    for n, x in enumerate([*np.arange(0.0, 8.0, 0.5), *np.arange(8.0, -0.1, -0.5)]):
        scan = first if n < 3 else last if n > 30 else NOTHING
        found += drive.add(np.array([x, 0.0, 0.0]), scan)
    return found


def test_a_different_place_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    """The odometry says that the robot is back; the walls say that it is elsewhere."""
    here = OrientedPoints.from_scan(points_at(walls(), (1.0, 4.0, 0.0)))
    elsewhere = OrientedPoints.from_scan(points_at(walls(), (9.5, 7.0, 0.5)))
    with caplog.at_level(logging.INFO, logger="slam.graph.loop_candidate"):
        loops = line_drive(Drive(), here, elsewhere)
    assert loops
    assert not any(loop.accepted for loop in loops)
    assert {loop.reason for loop in loops} == {"no pose in the window scores high enough"}
    lines = [record.message for record in caplog.records]
    assert len(lines) == len(loops)
    assert all("refused, " in line for line in lines)
    # The same drive with the right walls closes.
    assert any(loop.accepted for loop in line_drive(Drive(), here, here))


def test_the_refinement_refuses_what_the_search_lets_pass() -> None:
    here = OrientedPoints.from_scan(points_at(walls(), (1.0, 4.0, 0.0)))
    elsewhere = OrientedPoints.from_scan(points_at(walls(), (9.5, 7.0, 0.5)))
    loops = line_drive(Drive(match=MatchConfig(search_least_score=0.01)), here, elsewhere)
    assert not any(loop.accepted for loop in loops)
    assert "too few points fit" in {loop.reason for loop in loops}


def test_who_stood_long_at_a_place_is_still_asked_for_another_pass() -> None:
    closer, uncertainty = LoopCloser(LoopConfig(near=2), MATCH), UncertaintyGraph()
    # More places on the spot than are asked first, then a pass a metre aside, and back.
    aside_m, ways_m = (np.repeat(values, [600, 20, 1]) for values in ([0.0, 1.0, 0.0], [0.0, 100.0, 200.0]))
    poses = np.column_stack([aside_m, np.zeros((621, 2))])
    for key, (pose, way_m) in enumerate(zip(poses, ways_m.tolist(), strict=True)):
        closer.submaps.add(NOTHING, pose, way_m)
        uncertainty.add_node()
        if key:
            uncertainty.add_edge(key - 1, key, between(poses[key - 1], pose), 1e-6 * np.eye(3))
    places = [place for place, _ in closer.propose(620, poses, uncertainty)]
    assert [place < 600 for place in places] == [True, False]


def test_a_place_without_points_is_refused() -> None:
    scan = OrientedPoints.from_scan(points_at(walls(), (1.0, 4.0, 0.0)))
    loops = line_drive(Drive(), NOTHING, scan)
    assert loops
    assert {loop.reason for loop in loops} == {"the place has too few points"}


def test_a_scan_without_points_asks_nothing() -> None:
    scan = OrientedPoints.from_scan(points_at(walls(), (1.0, 4.0, 0.0)))
    assert line_drive(Drive(), scan, NOTHING) == []


def two_keyframes(
    place: FloatArray, key: FloatArray, believed: FloatArray, match: MatchConfig = MATCH
) -> LoopCandidate:
    """The loop between two sweeps that a sure edge joins, the second believed somewhere."""
    closer = LoopCloser(LoopConfig(), match)
    uncertainty = UncertaintyGraph()
    for n, truth in enumerate((place, key)):
        uncertainty.add_node()
        scan = OrientedPoints.from_scan(points_at(walls(), truth))
        closer.submaps.add(scan, (place, believed)[n], 20.0 * n)
    uncertainty.add_edge(0, 1, between(place, believed), np.eye(3) * 1e-8)
    (loop,) = closer.close(1, np.array([place, believed]), uncertainty)
    return loop


def test_a_sure_guess_needs_no_search() -> None:
    place, key = np.array([1.0, 4.0, 0.0]), np.array([2.2, 4.1, 0.4])
    loop = two_keyframes(place, key, key)
    assert loop.accepted
    assert loop.score == 1.0
    assert loop.motion is not None
    claim = row_from_pose2(loop.motion.T_reference_base)
    np.testing.assert_allclose(claim, between(place, key), atol=0.01)


def test_a_refinement_that_leaves_the_window_is_refused() -> None:
    place, key = np.array([1.0, 4.0, 0.0]), np.array([2.2, 4.1, 0.4])
    believed = compose(key, np.array([0.1, 0.05, 0.0]))
    assert two_keyframes(place, key, believed).accepted
    fine = MatchConfig(cell_m=0.03)
    assert two_keyframes(place, key, believed, fine).reason == "refinement left the window"


def test_a_corridor_closes_with_its_direction_open() -> None:
    """Two walls show how far to the side, not how far along: if it closes, the covariance must say so."""
    scan = OrientedPoints.from_scan(points_at(corridor(), (0.0, 0.1, 0.0)))
    loops = [loop for loop in line_drive(Drive(), scan, scan) if loop.motion is not None]
    assert loops
    for loop in loops:
        assert loop.motion is not None
        assert loop.motion.degenerate
        assert loop.motion.covariance[0, 0] > 0.4**2
        assert loop.motion.covariance[1, 1] < 0.05**2


def test_a_lost_node_is_left_to_the_search_over_the_whole_map() -> None:
    """No path of edges: more than one place may look the same, so none is tried."""
    scan = OrientedPoints.from_scan(points_at(walls(), (1.0, 4.0, 0.0)))
    for known in (False, True):
        closer = LoopCloser(LoopConfig(), MatchConfig())
        uncertainty = UncertaintyGraph()
        for n in range(2):
            uncertainty.add_node()
            closer.submaps.add(scan, np.zeros(3), 20.0 * n)
        if known:
            uncertainty.add_edge(0, 1, np.zeros(3), np.eye(3) * 0.01)
        loops = closer.close(1, np.zeros((2, 3)), uncertainty)
        assert [loop.accepted for loop in loops] == [True] * known


def test_a_better_estimate_finds_what_the_first_has_missed_and_asks_once() -> None:
    drive = Drive(drift=(0.008, -0.005, 0.003), near=0)
    assert drive.round() == []
    drive.closer = again = Drive(drift=(0.008, -0.005, 0.003)).closer
    for key, pose in enumerate(drive.poses):
        way_m = float(np.hypot(*np.diff(drive.poses[: key + 1, :2], axis=0).T).sum())
        points = points_at(
            walls(), drive.truth[key], sigma_m=0.01, seed=np.random.default_rng(key), beams=271
        )
        again.submaps.add(OrientedPoints.from_scan(points), pose, way_m)
    found = again.close_again(drive.truth, drive.uncertainty, [])
    assert len(found) >= 2
    assert all(np.hypot(*error_of(loop, drive.truth)[:2]) < 0.05 for loop in found)
    assert again.close_again(drive.truth, drive.uncertainty, []) == []


@pytest.mark.parametrize(("sigma_m", "accepted"), [(0.3, True), (0.8, False)])
def test_a_corridor_confirms_a_place_that_is_nearly_known_and_finds_none(
    sigma_m: float, accepted: bool
) -> None:
    closer = LoopCloser(LoopConfig(), MATCH)
    for key, x_m in enumerate([0.0, 0.5]):
        points = points_at(
            corridor(), np.array([x_m, 0.0, 0.0]), sigma_m=0.01, seed=np.random.default_rng(key)
        )
        closer.submaps.add(OrientedPoints.from_scan(points), np.array([x_m, 0.0, 0.0]), 20.0 * key)
    covariance = np.diag([sigma_m, sigma_m, 0.02]) ** 2
    loop = closer.verify(0, 1, np.array([0.5, 0.0, 0.0]), covariance)
    assert loop.motion is not None and loop.motion.degenerate
    assert loop.accepted == accepted
    assert ("undetermined" in loop.reason) != accepted


@pytest.mark.parametrize("aside_m", [0.02, 0.5])
def test_what_fits_aside_of_where_a_better_estimate_has_it_is_a_look_alike(aside_m: float) -> None:
    """A window is as wide as the estimate is uncertain along; aside of that it knows better."""
    closer, truth = LoopCloser(LoopConfig(), MATCH), np.array([[1.0, 4.0, 0.0], [2.0, 4.1, 0.4]])
    uncertainty = UncertaintyGraph()
    for n, pose in enumerate(truth):
        uncertainty.add_node()
        scan = OrientedPoints.from_scan(points_at(walls(), pose))
        closer.submaps.add(scan, pose, 20.0 * n)
    uncertainty.add_edge(0, 1, between(*truth), np.diag(np.square([0.5, aside_m, 0.02])))
    estimate = np.array([truth[0], compose(truth[1], np.array([0.0, 0.6, 0.0]))])
    found = closer.close_again(estimate, uncertainty, [])
    assert len(found) == (aside_m > 0.1)
    assert all(np.abs(error_of(loop, truth)).max() < 0.05 for loop in found)
