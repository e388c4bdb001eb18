"""The tracker between wheels and matches: who starts, who wins, and what both pay where nobody knows."""

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flat_worlds import corridor, moved, points_at, room
from scripted_tracker import NOTHING, SOME, STEP, Run, motion_at

from slam.config import Config
from slam.config.stages import MatchConfig, PredictionConfig, WheelConfig
from slam.estimates import MotionEstimate
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, WheelOdometry, row_from_pose2
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.predictor import Predictor
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker


def test_the_first_scan_is_the_origin() -> None:
    run = Run()
    first = run.scan()
    np.testing.assert_array_equal(first.pose, np.zeros(3))
    assert first.motion is None
    assert first.wheels is not None
    np.testing.assert_allclose(first.wheels.pose, run.wheel_pose)
    assert run.odometry.asked == []


def test_the_wheels_guess_first_and_constant_velocity_second() -> None:
    run = Run.sure(2)
    third = run.scan(wheel_step=np.array([0.12, 0.0, 0.0]))
    wheels, velocity = run.odometry.asked[1]
    np.testing.assert_allclose(wheels.pose, compose(STEP, np.array([0.12, 0.0, 0.0])), atol=1e-9)
    np.testing.assert_allclose(velocity.pose, compose(STEP, STEP), atol=1e-9)
    np.testing.assert_allclose(third.pose, compose(STEP, STEP), atol=1e-9)
    np.testing.assert_array_equal(third.dispute, np.zeros((3, 3)))


def test_without_wheels_velocity_is_the_only_guess() -> None:
    run = Run.sure(wheels=False)
    for _ in range(3):
        tracked = run.scan()
    assert [len(guesses) for guesses in run.odometry.asked] == [1, 1]
    np.testing.assert_allclose(run.odometry.asked[1][0].pose, compose(STEP, STEP), atol=1e-9)
    assert tracked.wheels is None


@pytest.mark.parametrize(
    ("gap_s", "steps"), [(0.1, 1.0), (0.2, 2.0), (0.3, 3.0), (5.0, 3.0), (0.0, 1.0), (-9.0, 1.0)]
)
def test_velocity_is_stretched_over_a_gap_but_not_for_ever(gap_s: float, steps: float) -> None:
    """A stamp that stands or runs backward gives no time: then the last step is repeated."""
    run = Run.sure(2, wheels=False)
    run.tracker.track(SOME, run.stamp_s + gap_s)
    np.testing.assert_allclose(run.odometry.asked[1][0].pose, compose(STEP, steps * STEP), atol=1e-9)


def test_a_failed_match_leaves_dead_reckoning() -> None:
    run = Run()
    run.scan()
    lost = run.scan()
    assert lost.motion is None
    np.testing.assert_allclose(lost.pose, STEP, atol=1e-9)
    np.testing.assert_allclose(run.scan().pose, compose(STEP, STEP), atol=1e-9)


@pytest.mark.parametrize("jump", [(3.0, 0.0, 0.0), (0.0, -4.0, 0.0), (0.0, 0.0, 2.5), (900.0, 0.0, 0.0)])
def test_a_jump_of_the_wheels_is_left_out(jump: tuple[float, ...]) -> None:
    """The robot is taken to have gone on as before."""
    run = Run.sure(3)
    doubt = run.wheel_doubt()
    tracked = run.scan(wheel_step=np.array(jump))
    for guess in run.odometry.asked[-1]:
        np.testing.assert_allclose(guess.pose, run.true_pose, atol=1e-9)
    np.testing.assert_allclose(tracked.pose, run.true_pose, atol=1e-9)
    assert run.wheel_doubt() == pytest.approx(doubt), "a jump is no fault of theirs"
    run.scan()
    assert len(run.odometry.asked[-1]) == 2


def test_wheels_that_prove_wrong_lose_the_first_word_and_get_it_back() -> None:
    """Wheels that have lost their sign: every step says backward what went forward."""
    run = Run.sure()
    run.odometry.near_fit = 0.0
    fast = np.array([0.3, 0.0, 0.0])
    for _ in range(40):
        run.scan(wheel_step=-fast, true_step=fast)
    assert run.wheel_doubt() > 3.0
    np.testing.assert_allclose(run.odometry.asked[-1][0].pose, run.true_pose, atol=1e-6)
    for _ in range(200):
        run.scan(wheel_step=fast, true_step=fast)
    assert run.wheel_doubt() == pytest.approx(1.0, abs=0.05)


def test_good_wheels_are_not_doubted() -> None:
    run = Run.sure(50)
    assert run.wheel_doubt() == pytest.approx(1.0)


@pytest.mark.parametrize(("inlier_share", "degenerate"), [(0.6, False), (0.95, True)])
def test_a_match_that_is_not_sure_judges_nobody(inlier_share: float, degenerate: bool) -> None:
    run = Run()
    run.odometry.answer = lambda guesses: motion_at(run.true_pose, 0.5, inlier_share, degenerate)
    for _ in range(30):
        run.scan(wheel_step=np.zeros(3), true_step=np.array([0.4, 0.0, 0.0]))
    assert run.wheel_doubt() == pytest.approx(1.0)


class TestContradiction:
    """Wheels and velocity say straight on; the match says half a metre to the side."""

    ASIDE = np.array([0.1, 0.5, 0.0])

    def contradict(
        self, match_fit: float, near_fit: float | None, objects: int = 20
    ) -> tuple[TrackedScan, FloatArray, FloatArray]:
        """The disputed scan, where the match wanted it and where the wheels did."""
        run = Run.sure(4)
        by_wheels, by_match = compose(run.true_pose, STEP), compose(run.true_pose, self.ASIDE)
        run.odometry.answer = lambda guesses: motion_at(by_match, fit=match_fit)
        run.odometry.near_fit = near_fit
        run.odometry.objects = objects
        return run.scan(), by_match, by_wheels

    def test_a_clear_match_overrules_the_wheels(self) -> None:
        tracked, by_match, _ = self.contradict(match_fit=0.95, near_fit=0.1)
        np.testing.assert_allclose(tracked.pose, by_match, atol=1e-9)
        np.testing.assert_array_equal(tracked.dispute, np.zeros((3, 3)))

    def test_one_object_does_not_overrule_the_wheels(self) -> None:
        """Somebody walks ahead: the same points, but they are one."""
        tracked, _, by_wheels = self.contradict(match_fit=0.95, near_fit=0.1, objects=1)
        np.testing.assert_allclose(tracked.pose, by_wheels, atol=1e-9)
        assert tracked.dispute.any()

    def test_the_prediction_wins_where_it_fits_as_well(self) -> None:
        tracked, _, by_wheels = self.contradict(match_fit=0.95, near_fit=0.95)
        np.testing.assert_allclose(tracked.pose, by_wheels, atol=1e-9)
        assert tracked.motion is not None
        np.testing.assert_array_equal(tracked.dispute, np.zeros((3, 3)))

    def test_a_dispute_spans_the_way_from_one_to_the_other(self) -> None:
        tracked, by_match, by_wheels = self.contradict(match_fit=0.95, near_fit=self.even_fit())
        offset = between(by_match, by_wheels)
        np.testing.assert_allclose(tracked.dispute, np.outer(offset, offset), atol=1e-9)

    def even_fit(self) -> float:
        """A fit at the prediction that leaves it open who is right."""
        fits = np.linspace(0.05, 0.95, 60)
        return float(next(fit for fit in fits if self.contradict(0.95, float(fit))[0].dispute.any()))

    def test_the_better_the_prediction_fits_the_less_the_match_counts(self) -> None:
        """As the fit at the prediction rises: the match, a dispute that it loses, the prediction."""
        verdicts = []
        for near_fit in np.linspace(0.05, 0.95, 60):
            tracked, by_match, _ = self.contradict(match_fit=0.95, near_fit=float(near_fit))
            verdicts.append((bool(np.allclose(tracked.pose, by_match)), bool(tracked.dispute.any())))
        order = [(True, False), (False, True), (False, False)]
        assert [verdict for verdict in order if verdict in verdicts] == order
        ranks = [order.index(verdict) for verdict in verdicts]
        assert ranks == sorted(ranks)

    def test_no_second_opinion_leaves_the_match(self) -> None:
        tracked, by_match, _ = self.contradict(match_fit=0.95, near_fit=None)
        np.testing.assert_allclose(tracked.pose, by_match, atol=1e-9)

    def test_a_match_that_fits_where_nothing_else_does_stays_in_dispute(self) -> None:
        """Wheels that jump turn a robot to ground that no map knows: there the scan fits nothing."""
        tracked, by_match, by_wheels = self.contradict(match_fit=0.95, near_fit=None, objects=1)
        assert tracked.motion is not None
        np.testing.assert_allclose(tracked.pose, by_match, atol=1e-9)
        offset = between(by_match, by_wheels)
        np.testing.assert_allclose(tracked.dispute, np.outer(offset, offset), atol=1e-9)

    @pytest.mark.parametrize(("step", "disputed"), [((5.92, -8.09, -1.5), True), ((5.92, -3.0, -0.7), False)])
    def test_after_a_gap_a_corridor_that_the_wheels_turned_away_from_may_be_another(
        self, step: tuple[float, ...], disputed: bool
    ) -> None:
        run = Run.sure(4)
        ahead = compose(run.true_pose, np.array([1.2, -0.25, 0.0] if disputed else [5.0, 0.0, 0.0]))
        run.odometry.answer = lambda guesses: motion_at(ahead, degenerate=True)
        run.odometry.near_fit = None
        run.tracker._by_wheels.doubt = 10.0  # they have jumped before
        run.stamp_s += 9.0
        tracked = run.scan(wheel_step=np.array(step))
        assert tracked.motion is not None
        np.testing.assert_allclose(tracked.pose, ahead, atol=1e-9)
        assert tracked.dispute.any() == disputed

    def test_a_dispute_widens_the_next_guess(self) -> None:
        run = Run.sure(4)
        by_match = compose(run.true_pose, self.ASIDE)
        run.odometry.answer = lambda guesses: motion_at(by_match, fit=0.95)
        run.odometry.near_fit = self.even_fit()
        run.scan()
        run.scan()
        guesses = [asked for asked in run.odometry.asked if len(asked) == 2][-1]
        traces = [np.trace(guess.covariance) for guess in guesses]
        assert min(traces) > 0.45**2, "half a metre in dispute; the wheels were exact for four scans"


def drifted(objects: int) -> float:
    """How far a slow track is led astray by matches that err by 25 mm a scan, metres; wheels are exact."""
    run = Run.sure()
    slow = 0.3 * STEP
    for _ in range(60):
        run.scan(slow, slow)
    run.odometry.objects = objects
    led_m = 0.0
    for _ in range(24):
        led_m += 0.025
        ahead = np.array([led_m, 0.0, 0.0])
        run.odometry.answer = lambda guesses, ahead=ahead: motion_at(compose(run.true_pose, ahead))
        tracked = run.scan(slow, slow)
    return float(np.hypot(*between(run.true_pose, tracked.pose)[:2]))


def test_matches_that_err_a_little_at_every_scan_contradict_the_way_of_the_wheels() -> None:
    """Somebody walks ahead: no single step is a surprise, the way is."""
    assert drifted(objects=1) < 0.2
    assert drifted(objects=20) > 0.55, "the whole scene says that the wheels slip"


def test_wheels_that_prove_exact_are_believed_more_and_less_again_after_a_slip() -> None:
    """The way's variance shrinks, the turn's does not; a slip brings it back."""
    run = Run.sure()
    variances = []
    for n in range(160):
        slips = 100 <= n < 110
        run.scan(true_step=STEP * 0.4 if slips else STEP)
        if n in (2, 99, 110):
            guess = run.odometry.asked[-1][0 if n < 100 else -1]
            variances.append(np.diag(guess.covariance))
    fresh, proven, slipped = variances
    np.testing.assert_array_less(proven[:2], 0.1 * fresh[:2])
    np.testing.assert_allclose(proven[2], fresh[2], rtol=0.01)
    np.testing.assert_array_less(4.0 * proven[:2], slipped[:2])


def test_wheels_that_prove_exact_on_the_straight_may_swing_in_a_turn() -> None:
    """The base sits beside the axle: each turn takes it aside, and that is no contradiction."""
    run = Run.sure(160)
    run.odometry.near_fit = 0.95
    tracked = run.scan(wheel_step=np.array([0.0, 0.0, 0.35]), true_step=np.array([0.0, 0.04, 0.35]))
    np.testing.assert_allclose(tracked.pose, run.true_pose, atol=1e-9)
    np.testing.assert_array_equal(tracked.dispute, np.zeros((3, 3)))


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (30.0, 20.0, -2.0)])
def test_real_scans_overrule_slipping_wheels_in_a_room(frame: tuple[float, ...]) -> None:
    """The robot stands, the wheels spin: 8 cm a scan for ten scans, all of it denied by the walls."""
    start = compose(np.array(frame), np.array([0.3, -0.2, 0.1]))
    points = points_at(moved(room(), frame), start)
    tracked = track_with_surfels([points] * 11, [0.08 * n for n in range(11)])
    assert np.abs(tracked[-1].pose).max() < 0.01


def test_the_wheels_decide_along_a_corridor() -> None:
    """Scans that all look the same: the way along comes from the wheels, and the match says it is open."""
    tracked = track_with_surfels(
        [points_at(corridor(), (0.1 * n, 0.2, 0.0)) for n in range(11)], [0.1 * n for n in range(11)]
    )
    np.testing.assert_allclose(tracked[-1].pose, [1.0, 0.0, 0.0], atol=0.02)
    assert all(scan.motion is not None and scan.motion.degenerate for scan in tracked[1:])


def track_with_surfels(scans: list[ScanPoints], wheel_x_m: list[float]) -> list[TrackedScan]:
    """Each scan a keyframe, 0.1 s apart, the wheels driving along x."""
    match = MatchConfig()
    wheels = WheelTracker(WheelConfig())
    odometry = SurfelOdometry(Config())
    tracker = MotionTracker(odometry, wheels, PredictionConfig(), match)
    tracked = []
    for n, (points, x) in enumerate(zip(scans, wheel_x_m, strict=True)):
        wheels.add(WheelOdometry(0.1 * n, gtsam.Pose2(x, 0.0, 0.0)))
        tracked.append(tracker.track(points, 0.1 * n))
        tracker.add_keyframe(points, tracked[-1])
    return tracked


def test_an_empty_scan_is_dead_reckoned_and_the_next_one_matched() -> None:
    points = points_at(room(), (0.3, -0.2, 0.1))
    tracked = track_with_surfels([points, points, NOTHING, points], [0.0] * 4)
    assert [scan.motion is None for scan in tracked] == [True, False, True, False]
    assert max(np.abs(scan.pose).max() for scan in tracked) < 1e-3
    assert math.isfinite(tracked[-1].pose.sum())
    assert tracked[-1].motion is not None
    np.testing.assert_allclose(row_from_pose2(tracked[-1].motion.T_reference_base), np.zeros(3), atol=1e-3)


def test_constant_velocity_leads_no_more_after_a_while() -> None:
    """The robot stood; half a minute later the wheels have counted 5 m: where it stood may look alike."""
    for wheels in (True, False):
        run = Run.sure(wheels=wheels)
        for _ in range(3):
            run.scan(np.zeros(3), np.zeros(3))
        run.stamp_s += 30.0
        run.scan(np.array([5.0, 0.0, 0.0]), np.array([5.0, 0.0, 0.0]))
        asked = run.odometry.asked[-1]
        assert {round(guess.pose[0], 6) for guess in asked} == ({5.0} if wheels else {0.0})
        assert wheels or asked[0].covariance[0, 0] > 25.0, "without wheels there is nothing else"


@pytest.mark.parametrize(
    ("gap_s", "wheels", "variance"), [(5.9, False, 12.0), (5.9, True, 0.0), (0.3, False, 0.0)]
)
def test_a_gap_that_nothing_bridges_leaves_a_match_open(gap_s: float, wheels: bool, variance: float) -> None:
    """1 m/s as a rule: anywhere within the way of then, evenly spread."""
    run = Run.sure(5, wheels=wheels)
    run.stamp_s += gap_s
    assert run.scan().dispute.diagonal()[:2] == pytest.approx([variance, variance])


def test_the_end_of_a_corridor_makes_up_for_what_went_wrong_along_it() -> None:
    """The wheels jumped where nothing could show it: what makes up for it is no velocity."""
    run = Run.sure(5)
    along = np.array([0.4, 0.0, 0.0])
    ahead = motion_at(compose(run.true_pose, compose(STEP, along)), degenerate=True)
    ahead = replace(ahead, covariance=ahead.covariance + np.diag([900.0, 0.0, 0.0]))
    run.odometry.answer = lambda guesses: ahead
    run.scan(wheel_step=compose(STEP, along))
    run.see_the_truth()
    run.scan()
    run.scan()
    first, *_ = guesses = run.odometry.asked[-1]
    np.testing.assert_allclose(first.pose, run.true_pose, atol=1e-9)
    assert min(between(run.true_pose, guess.pose)[0] for guess in guesses) > -0.5 * along[0]


def test_a_guess_that_the_match_has_refuted_leads_along_no_corridor() -> None:
    """The wheels turn and say that the robot stands; the walls say that it does not turn."""
    run = Run.sure(5)
    run.odometry.near_fit = None

    def along_the_first(guesses: list[Motion]) -> MotionEstimate:
        pose = np.array([guesses[0].pose[0], *run.true_pose[1:]])
        motion = motion_at(pose, degenerate=True)
        open_ = np.diag([900.0, 0.0, 0.0])
        return replace(motion, covariance=motion.covariance + open_)

    run.odometry.answer = along_the_first
    tracked = run.scan(wheel_step=np.array([0.0, 0.0, 0.35]))
    np.testing.assert_allclose(tracked.pose, run.true_pose, atol=0.02)


@pytest.mark.parametrize("off_sigmas", [10.0, 1000.0])
def test_one_wild_step_does_not_ruin_a_predictor(off_sigmas: float) -> None:
    """Its variance grows as if the step had been ten times what it claims, however wild it was."""
    predictor = Predictor(30.0)
    predictor.predict(np.zeros(3), np.eye(3) * 0.01**2)
    predictor.judge(np.array([0.01 * off_sigmas, 0.0, 0.0]))
    assert predictor.doubt == pytest.approx(1.0 + (10.0 - 1.0) / 30.0)
