import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.alignment import nearest_indices, umeyama
from slam.evaluation.trajectory_error import absolute_error, associate, relative_error

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D
    from evo.core.units import Unit

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def random_pair(rng, count=80, planar=False, noise=0.05):
    """A reference and a noisy trajectory in another frame, with other stamps and some poses lost."""
    stamps = 1000.0 + 0.1 * np.arange(count)
    positions = np.cumsum(rng.normal(size=(count, 3)) * 0.2, axis=0)
    quaternions = rng.normal(size=(count, 4))
    if planar:
        positions[:, 2] = 0.0
        quaternions[:, :2] = 0.0
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    reference = Trajectory(stamps, positions, quaternions)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    kept = np.sort(rng.permutation(count)[: count - 10])
    noisy = quaternions[kept] + rng.normal(size=(kept.size, 4)) * noise
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    moved = (positions[kept] + rng.normal(size=(kept.size, 3)) * noise) @ turn.T + [5.0, -3.0, 2.0]
    return Trajectory(stamps[kept] + rng.uniform(-0.012, 0.012, kept.size), moved, noisy), reference


def to_evo(trajectory):
    return PoseTrajectory3D(
        positions_xyz=trajectory.positions_m,
        orientations_quat_wxyz=np.roll(trajectory.quaternions_xyzw, 1, axis=1),
        timestamps=trajectory.stamps_s,
    )


def evo_pair(trajectory, reference, max_diff=0.01):
    return sync.associate_trajectories(to_evo(reference), to_evo(trajectory), max_diff=max_diff)


def evo_statistics(metric, pair):
    metric.process_data(pair)
    return metric.get_all_statistics()


def assert_same(statistics, oracle):
    for name in STATISTICS:
        assert getattr(statistics, name) == pytest.approx(oracle[name], abs=1e-6), name


@pytest.mark.parametrize("seed", range(6))
def test_absolute_error_equals_evos(seed):
    trajectory, reference = random_pair(np.random.default_rng(seed), planar=seed % 2 == 1)
    if seed == 2:
        trajectory, reference = reference, trajectory
    evo_reference, evo_estimate = evo_pair(trajectory, reference)
    evo_estimate.align(evo_reference)
    error = absolute_error(trajectory, reference)
    assert error.count == evo_reference.num_poses
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, error.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, error.rotation_rad),
    ):
        assert_same(statistics, evo_statistics(metrics.APE(relation), (evo_reference, evo_estimate)))
    assert error.to_dict()["translation_m"]["rmse"] == error.translation_m.rmse


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("delta_m", [0.5, 2.0])
def test_relative_error_equals_evos(seed, delta_m):
    trajectory, reference = random_pair(np.random.default_rng(100 + seed))
    pair = evo_pair(trajectory, reference)
    error = relative_error(trajectory, reference, delta_m=delta_m)
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, error.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, error.rotation_rad),
    ):
        metric = metrics.RPE(relation, delta=delta_m, delta_unit=Unit.meters, all_pairs=False)
        assert_same(statistics, evo_statistics(metric, pair))
        assert error.count == len(metric.error)


@given(
    stamps=st.lists(st.integers(0, 30), min_size=1, max_size=12),
    queries=st.lists(st.integers(-4, 70), min_size=1, max_size=12),
)
@settings(max_examples=300)
def test_association_follows_evo_with_ties_and_repeats(stamps, queries):
    # Halves make exact ties between two stamps frequent.
    stamps, queries = np.array(sorted(stamps), dtype=float), np.array(queries) / 2.0
    nearest = nearest_indices(stamps, queries)
    chosen = np.abs(stamps[nearest] - queries) <= 2.0
    found_queries, found_stamps = sync.matching_time_indices(queries, stamps, max_diff=2.0)
    assert np.flatnonzero(chosen).tolist() == found_queries
    assert nearest[chosen].tolist() == found_stamps


@given(st.lists(st.integers(0, 30), min_size=1, max_size=12), st.lists(st.integers(-4, 70), min_size=1))
def test_stamps_that_run_backward_find_the_same_poses_as_in_order(stamps, queries):
    stamps, queries = np.array(stamps, dtype=float), np.array(queries) / 2.0
    order = np.argsort(stamps, kind="stable")
    nearest = nearest_indices(stamps, queries)
    assert np.array_equal(np.abs(stamps[nearest] - queries), np.abs(stamps[:, None] - queries).min(axis=0))
    assert np.array_equal(nearest, order[nearest_indices(stamps[order], queries)])


def test_a_trajectory_has_no_error_against_itself_moved():
    trajectory, _ = random_pair(np.random.default_rng(7))
    T = umeyama(trajectory.positions_m, trajectory.positions_m[:, [1, 2, 0]] + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(T[:3], [[0, 1, 0, 1], [0, 0, 1, 2], [1, 0, 0, 3]], atol=1e-9)
    error = absolute_error(trajectory, trajectory)
    assert error.translation_m.max < 1e-12
    assert error.rotation_rad.max < 1e-7
    assert relative_error(trajectory, trajectory, delta_m=1.0).translation_m.max < 1e-12


def test_a_mirror_is_not_an_alignment():
    points = np.random.default_rng(3).normal(size=(20, 3))
    T = umeyama(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_a_drive_shorter_than_delta_has_no_relative_error():
    line = Trajectory.from_planar(np.arange(5.0), np.outer(np.arange(5.0), [1.0, 2.0, 0.0]))
    assert relative_error(line, line, delta_m=9.0) is None
    assert relative_error(line, line, delta_m=8.0).count == 1


def test_what_does_not_fit_is_refused():
    line = Trajectory.from_planar(np.arange(5.0), np.outer(np.arange(5.0), [1.0, 2.0, 0.0]))
    standing = Trajectory.from_planar(line.stamps_s, np.zeros((5, 3)))
    with pytest.raises(EvaluationError, match="in one place"):
        absolute_error(standing, line)
    rising = Trajectory(
        line.stamps_s, line.positions_m + [[0.0, 0.0, n] for n in range(5)], line.quaternions_xyzw
    )
    with pytest.raises(EvaluationError, match="on one line"):
        absolute_error(rising, rising)
    later = Trajectory(line.stamps_s + 100.0, line.positions_m, line.quaternions_xyzw)
    with pytest.raises(EvaluationError, match=r"no pose is within 0.01 s .*same clock"):
        absolute_error(line, later)
    empty = Trajectory.from_planar(np.zeros(0), np.zeros((0, 3)))
    with pytest.raises(EvaluationError, match="nothing to compare"):
        associate(line, empty)
    for delta_m in (0, -1, float("nan")):
        with pytest.raises(EvaluationError, match="delta must be positive"):
            relative_error(line, line, delta_m=delta_m)


def rooms():
    """A robot's way through two rooms, (N, 3) x, y, yaw."""
    way = np.array([[0, 0], [4, 0], [4, 3], [7, 3], [7, -1], [0, 0]], float)
    at = np.linspace(0.0, 5.0, 101)
    rows = np.column_stack([np.interp(at, np.arange(6.0), axis) for axis in way.T])
    heading = np.arctan2(*np.gradient(rows, axis=0).T[::-1])
    return np.column_stack([rows, heading])


def test_a_mirrored_plane_fails_and_is_named():
    truth = Trajectory.from_planar(np.arange(101.0), rooms())
    mirrored = Trajectory.from_planar(np.arange(101.0), rooms() * [1.0, -1.0, -1.0])
    # In space it could be turned over.
    T = umeyama(mirrored.positions_m, truth.positions_m)
    assert np.allclose(mirrored.positions_m @ T[:3, :3].T + T[:3, 3], truth.positions_m)
    error = absolute_error(mirrored, truth)
    assert error.alignment == "se2" and error.translation_m.rmse > 1.0
    assert "its mirror image fits, to 0.0000 m" in error.mirrored
    assert absolute_error(truth, truth).mirrored is None


@pytest.mark.parametrize("tilt", [0.0, 0.3, 2.0])
def test_a_sound_plane_is_found_in_a_frame_that_is_tilted_and_shifted(tilt):
    turn = Rotation.from_euler("zyx", [2.0, 0.2 * tilt, tilt])
    estimate = Trajectory.from_planar(np.arange(101.0), rooms())
    turned = turn * Rotation.from_quat(estimate.quaternions_xyzw)
    truth = Trajectory(
        estimate.stamps_s, np.add(turn.apply(estimate.positions_m), (5.0, -3.0, 1.0)), turned.as_quat()
    )
    error = absolute_error(estimate, truth)
    assert error.alignment == "se2" and error.mirrored is None
    assert error.translation_m.max < 1e-9 and error.rotation_rad.max < 1e-7
    assert np.allclose(error.T_reference_map[:3, :3], turn.as_matrix())


def test_in_the_plane_sound_trajectories_score_as_by_evo():
    rng = np.random.default_rng(5)
    truth = Trajectory.from_planar(np.arange(101.0), rooms())
    estimate = Trajectory.from_planar(np.arange(101.0), rooms() + rng.normal(0.0, 0.05, (101, 3)))
    reference, own = evo_pair(estimate, truth)
    own.align(reference)
    assert_same(
        absolute_error(estimate, truth).translation_m,
        evo_statistics(metrics.APE(metrics.PoseRelation.translation_part), (reference, own)),
    )


def test_a_truth_that_does_not_stay_upright_is_aligned_in_space():
    estimate = Trajectory.from_planar(np.arange(101.0), rooms())
    camera = Rotation.from_quat(estimate.quaternions_xyzw) * Rotation.from_euler("x", -np.pi / 2)
    truth = Trajectory(estimate.stamps_s, estimate.positions_m, camera.as_quat())
    assert absolute_error(estimate, truth).alignment == "se3"
