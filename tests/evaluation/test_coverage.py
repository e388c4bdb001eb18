"""Coverage: right covariances hold the truth as often as they say, wrong ones do not, in any frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import slam
from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.coverage import coverage
from slam.measurements import FloatArray
from slam.storage.tum import write_trajectory, write_tum

COUNT = 2000
SIGMAS = np.array([0.1, 0.02, 0.01])


def way() -> Trajectory:
    """A wide circle; the truth."""
    turn = np.linspace(0.0, 6.0, COUNT)
    rows = np.column_stack([40.0 * np.sin(turn), -40.0 * np.cos(turn), turn])
    return Trajectory.from_planar(0.1 * np.arange(COUNT), rows)


def estimate(seed: int = 0) -> tuple[Trajectory, FloatArray]:
    """With independent errors along the map's axes, the first pose held."""
    sigmas = np.where(np.arange(COUNT)[:, None] > 0, SIGMAS, 1e-6)
    rows = way().to_planar() + np.random.default_rng(seed).normal(0.0, 1.0, (COUNT, 3)) * sigmas
    return Trajectory.from_planar(way().stamps_s, rows), np.array([np.diag(row**2) for row in sigmas])


def turned(one: Trajectory) -> Trajectory:
    """In another frame."""
    turn = Rotation.from_euler("zyx", [1.0, 0.4, -0.2])
    quaternions = (turn * Rotation.from_quat(one.quaternions_xyzw)).as_quat()
    return Trajectory(one.stamps_s, np.add(turn.apply(one.positions_m), (3.0, 4.0, 5.0)), quaternions)


@pytest.mark.parametrize("of_truth", [way(), turned(way())])
def test_right_covariances_hold_what_they_say(of_truth: Trajectory) -> None:
    found = coverage(*estimate(), of_truth, 0.05)
    assert found.count == COUNT - 1 and found.held_at_s == 0.0
    assert found.nees == pytest.approx(1.0, abs=0.05)
    assert found.position == pytest.approx(0.95, abs=0.015) and found.yaw == pytest.approx(0.95, abs=0.015)


def test_axes_matter() -> None:
    poses, covariances = estimate()
    swapped = covariances[:, [1, 0, 2]][:, :, [1, 0, 2]]
    assert coverage(poses, swapped, way(), 0.05).position < 0.5


def test_space_is_asked_along_three_axes() -> None:
    poses, flat = estimate()
    covariances = np.zeros((COUNT, 6, 6)) + 1e-4 * np.eye(6)
    covariances[:, [0, 1, 5], [0, 1, 5]] = flat[:, [0, 1, 2], [0, 1, 2]]
    found = coverage(poses, covariances, turned(way()), 0.05)
    # Height, roll and pitch are exact here.
    assert found.nees == pytest.approx(0.5, abs=0.03) and found.yaw == pytest.approx(0.95, abs=0.015)
    assert found.position > 0.97


def test_the_truth_is_interpolated() -> None:
    poses, covariances = estimate()
    sparse = way()[np.arange(0, COUNT, 4)]
    assert coverage(poses, covariances, sparse, 0.3).nees == pytest.approx(1.0, abs=0.05)


def test_an_error_of_all_poses_is_no_error_of_alignment() -> None:
    """Laid on its truth as a whole a trajectory would hide that it is turned about its beginning."""
    rows = way().to_planar()
    cos, sin = np.cos(0.05), np.sin(0.05)
    away = rows[:, :2] - rows[0, :2]
    bent = np.column_stack([away @ [[cos, sin], [-sin, cos]] + rows[0, :2], rows[:, 2] + 0.05])
    bent[0] = rows[0]
    sure = np.where(np.arange(COUNT)[:, None, None] > 0, 1.0, 1e-6) * np.diag([0.01, 0.01, 0.01]) ** 2
    assert coverage(Trajectory.from_planar(way().stamps_s, bent), sure, way(), 0.05).yaw == 0.0


def test_a_way_turned_far_about_its_beginning_lies_within_the_uncertainty_of_the_turn() -> None:
    poses, turn = way(), Rotation.from_euler("z", 0.4)
    bent = Trajectory(
        poses.stamps_s,
        turn.apply(poses.positions_m - poses.positions_m[0]) + poses.positions_m[0],
        (turn * Rotation.from_quat(poses.quaternions_xyzw)).as_quat(),
    )
    quaternions = bent.quaternions_xyzw.copy()
    quaternions[0] = poses.quaternions_xyzw[0]
    bent = replace(bent, quaternions_xyzw=quaternions)
    # A turn of 0.2 rad of sigma about the first pose, and a millimetre.
    x, y, _ = (bent.positions_m - bent.positions_m[0]).T
    lever = np.column_stack([-y, x, np.ones(COUNT)])
    covariances = 0.04 * lever[:, :, None] * lever[:, None] + 1e-6 * np.eye(3)
    covariances[0] = 1e-8 * np.eye(3)
    found = coverage(bent, covariances, poses, 0.05)
    assert found.position == 1.0 and found.yaw == 0.0  # two sigma: 1.96 is the interval's end
    assert found.nees == pytest.approx(4.0 / 3.0, rel=0.01)


def test_what_cannot_be_asked_is_refused() -> None:
    poses, covariances = estimate()
    with pytest.raises(EvaluationError, match="not positive definite"):
        coverage(poses, 0.0 * covariances, way(), 0.05)
    with pytest.raises(EvaluationError, match=r"0 poses have a true one within 0\.05 s"):
        coverage(replace(poses, stamps_s=poses.stamps_s + 1e6), covariances, way(), 0.05)


def test_evaluate_reads_them_beside_the_trajectory(tmp_path: Path) -> None:
    poses, covariances = estimate()
    write_trajectory(tmp_path / "trajectory.tum", poses, covariances)
    write_tum(tmp_path / "truth.txt", way())
    scores = slam.evaluate(tmp_path / "trajectory.tum", groundtruth=tmp_path / "truth.txt")
    assert scores["coverage"] == slam.evaluate(poses, groundtruth=way(), covariances=covariances)["coverage"]
    assert "coverage" not in slam.evaluate(poses, groundtruth=way())
    write_tum(tmp_path / "trajectory.tum", poses[:100])
    with pytest.raises(EvaluationError, match="other stamps"):
        slam.evaluate(tmp_path / "trajectory.tum", groundtruth=way())
