"""Maps and loops against truths that are drawn by hand, then the same with the map turned and shifted."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.comparison.loop_score import loop_scores
from slam.comparison.map_score import map_scores, read_true_grid
from slam.comparison.plan_score import plan_scores, robot_radius_m
from slam.comparison.product import AcceptedLoop, Product
from slam.comparison.scoring import Truths, scores_of
from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.mapping.occupancy_grid import StateGrid
from slam.simulation.true_grid import TrueGrid

CELL_M = 0.1


def room() -> TrueGrid:
    """A room of 30 x 20 cells in walls two cells thick, and another room that nobody enters."""
    occupied = np.ones((24, 60), dtype=bool)
    occupied[2:22, 2:32] = False
    occupied[2:22, 34:58] = False
    return TrueGrid(occupied, CELL_M, (-1.0, -1.0), np.where(occupied, 0, -1).astype(np.int32))


WAY = np.column_stack([np.linspace(0.0, 1.5, 20), np.zeros(20)])


def faces(truth: TrueGrid) -> np.ndarray[tuple[int, ...], np.dtype[np.int8]]:
    """A perfect map: the faces of the first room's walls, and its floor."""
    states = np.full(truth.occupied.shape, -1, dtype=np.int8)
    states[1:23, 1:33] = 100
    states[2:22, 2:32] = 0
    return states


def map_at(states: np.ndarray[tuple[int, ...], np.dtype[np.int8]], T: gtsam.Pose2) -> StateGrid:
    """The map in a frame of its own: ``T`` is the pose of the truth's frame in it."""
    return StateGrid(states, CELL_M, T.compose(gtsam.Pose2(-1.0, -1.0, 0.0)))


POSES = [gtsam.Pose2(), gtsam.Pose2(3.0, -2.0, 0.7)]


@pytest.mark.parametrize("T_map_true", POSES)
def test_a_perfect_map_scores_one(T_map_true: gtsam.Pose2) -> None:
    T_true_map = gtsam.Pose3(T_map_true.inverse()).matrix()
    scores = map_scores(map_at(faces(room()), T_map_true), room(), T_true_map, WAY)
    assert scores == {"completeness": 1.0, "false_occupied": 0.0, "f1": pytest.approx(1.0)}


@pytest.mark.parametrize("T_map_true", POSES)
def test_half_a_map_and_clutter_are_distinguished(T_map_true: gtsam.Pose2) -> None:
    T_true_map = gtsam.Pose3(T_map_true.inverse()).matrix()
    half = faces(room())
    half[12:] = -1
    scores = map_scores(map_at(half, T_map_true), room(), T_true_map, WAY)
    assert 0.4 < scores["completeness"] < 0.6
    assert scores["false_occupied"] == 0.0
    cluttered = faces(room())
    count = int((cluttered == 100).sum())
    cluttered[8:14, 8:18] = 100
    scores = map_scores(map_at(cluttered, T_map_true), room(), T_true_map, WAY)
    assert scores["completeness"] == 1.0
    assert scores["false_occupied"] == pytest.approx(60 / (count + 60))


def test_a_map_beside_the_truth_is_false_and_an_empty_one_is_not() -> None:
    beside = map_at(faces(room()), gtsam.Pose2(100.0, 0.0, 0.0))
    scores = map_scores(beside, room(), np.eye(4), WAY)
    assert scores["completeness"] == 0.0 and scores["false_occupied"] == 1.0 and scores["f1"] == 0.0
    empty = map_at(np.full((3, 3), -1, dtype=np.int8), gtsam.Pose2())
    assert map_scores(empty, room(), np.eye(4), WAY) == {
        "completeness": 0.0,
        "false_occupied": 0.0,
        "f1": 0.0,
    }


@pytest.mark.parametrize("T_map_true", POSES)
def test_plans_over_a_map_are_driven_over_the_truth(T_map_true: gtsam.Pose2) -> None:
    T_true_map = gtsam.Pose3(T_map_true.inverse()).matrix()
    on_map = np.array([T_map_true.transformFrom(xy) for xy in WAY])

    def scores(states: np.ndarray[tuple[int, ...], np.dtype[np.int8]], truth: TrueGrid) -> dict[str, float]:
        return plan_scores(map_at(states, T_map_true), truth, T_true_map, WAY, on_map, 0.25)

    best = {"collide": 0.0, "collide_hard": 0.0, "reach": 1.0, "reach_near": 1.0, "danger": 0.0}
    assert scores(faces(room()), room()) == best
    # A table in the middle of the room that the map does not have.
    truth = room()
    truth.occupied[8:16, 15:19] = True
    blind = scores(faces(room()), truth)
    assert blind["danger"] == 32.0 and 0.2 < blind["collide_hard"] <= blind["collide"] < 0.9
    # Half the room unknown: nothing is hit, half is not reached.
    half = faces(room())
    half[12:] = np.where(half[12:] == 0, -1, half[12:])
    careful = scores(half, room())
    assert 0.4 < careful["reach"] < 0.6 and careful["collide"] == 0.0
    # A map that leads nowhere has no plans.
    assert "collide" not in scores(np.full_like(half, -1), room())


def test_the_truth_shows_how_wide_its_robot_is(tmp_path: Path) -> None:
    assert robot_radius_m(tmp_path) is None
    (tmp_path / "faults.json").write_text('{"rig": "xu2024"}')
    assert robot_radius_m(tmp_path) == 0.25


def test_a_damaged_true_grid_is_named(tmp_path: Path) -> None:
    (tmp_path / "grid.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(EvaluationError, match=r"grid\.npz"):
        read_true_grid(tmp_path / "grid.npz")


def circle(turns: float = 2.0, radius_m: float = 3.0) -> Trajectory:
    """Two rounds: every pose of the second is a revisit."""
    at = np.linspace(0.0, turns * 2.0 * np.pi, 400)
    poses = np.column_stack([radius_m * np.cos(at), radius_m * np.sin(at), at + np.pi / 2.0])
    return Trajectory.from_planar(np.linspace(10.0, 50.0, 400), poses)


def loop(truth: Trajectory, place: int, keyframe: int, error_m: float = 0.0) -> AcceptedLoop:
    rows = truth.to_planar()
    motion = gtsam.Pose2(*rows[place]).between(gtsam.Pose2(*rows[keyframe]))
    xyt = np.array([motion.x() + error_m, motion.y(), motion.theta()])
    return AcceptedLoop(float(truth.stamps_s[place]), float(truth.stamps_s[keyframe]), xyt)


def test_loops_are_right_or_wrong_by_the_truth() -> None:
    truth = circle()
    keyframes = truth.stamps_s[::4]
    every = [loop(truth, n, n + 200) for n in range(0, 200, 8)]
    assert loop_scores(every, keyframes, truth) == {
        "loops": 25.0,
        "loop_precision": 1.0,
        "loop_recall": 1.0,
    }
    wrong = [loop(truth, n, n + 200, error_m=0.5) for n in range(0, 200, 8)]
    half = loop_scores([*every[:12], *wrong[12:]], keyframes, truth)
    assert half["loop_precision"] == pytest.approx(12 / 25)
    assert 0.4 < half["loop_recall"] < 0.65
    none = loop_scores([], keyframes, truth)
    assert none == {"loops": 0.0, "loop_recall": 0.0}
    no_revisit = circle(turns=0.5)
    assert loop_scores([], no_revisit.stamps_s, no_revisit) == {"loops": 0.0}


def test_what_is_there_decides_what_is_measured(tmp_path: Path) -> None:
    truth = circle()
    moved = dataclasses.replace(truth, positions_m=truth.positions_m + np.array([5.0, 0.0, 0.0]))
    scores = scores_of(Product(moved), Truths(truth, None, None), (1.0, 1000.0))
    assert scores.figures["ate_m"] < 1e-9
    assert {"rpe_1m_m", "rpe_1m_deg", "ate_deg"} <= set(scores.figures)
    assert not {"loops", "map_f1", "relations_m"} & set(scores.figures)
    assert len(scores.warnings) == 1 and "1000" in scores.warnings[0]
    relations = tmp_path / "relations"
    relations.write_text("999 1000 0 0 0 0 0 0\n")
    refused = scores_of(Product(moved), Truths(None, relations, None), (1.0,))
    assert refused.figures == {} and refused.truth is None
    assert "same log" in refused.warnings[0]
