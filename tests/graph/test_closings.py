"""What loops have closed: by hand, on a round of which one step is wrong."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from slam.graph.closings import Closing, closings
from slam.graph.edge import Edge, EdgeKind
from slam.measurements import FloatArray, Pose

STEPS, TURN_RAD = 40, 2.0 * math.pi / 40
STEP: FloatArray = np.diag([0.1, 0.1, 1e-5]) ** 2
REACH_M = 5.0


def moved(x_m: float, yaw_rad: float, *, spatial: bool) -> Pose:
    if spatial:
        return gtsam.Pose3(gtsam.Rot3.Yaw(yaw_rad), np.array([x_m, 0.0, 0.0]))
    return gtsam.Pose2(x_m, 0.0, yaw_rad)


def round_trip(*loops: tuple[int, int], spatial: bool = False, broken: int | None = None) -> list[Closing]:
    """Two rounds of 40 m in true poses; the steps say that the tenth was half a metre longer."""
    sigmas = [1e-5] * 3 + [0.1] * 3 if spatial else np.sqrt(np.diag(STEP))
    poses = [moved(0.0, 0.0, spatial=spatial)]
    edges = []
    for key in range(2 * STEPS):
        step = moved(1.0, TURN_RAD, spatial=spatial)
        poses.append(poses[-1].compose(step))  # type: ignore[arg-type]
        said = moved(1.5, TURN_RAD, spatial=spatial) if key == 10 else step
        if key != broken:
            edges.append(Edge(key, key + 1, said, np.diag(sigmas) ** 2, EdgeKind.LIDAR, trusted=True))
    for number, (place, keyframe) in enumerate(loops):
        true = poses[place].between(poses[keyframe])  # type: ignore[arg-type]
        covariance = np.diag(sigmas) ** 2 / 100.0
        edges.append(Edge(place, keyframe, true, covariance, EdgeKind.LOOP, trusted=False, loop=number))
    return closings(edges, poses, REACH_M, 10)


@pytest.mark.parametrize("spatial", [False, True])
def test_a_round_is_closed_by_what_its_steps_missed(spatial: bool) -> None:
    (one,) = round_trip((0, 40), (1, 41), (2, 42), spatial=spatial)
    assert (one.place, one.keyframe, one.loops) == (0, 40, 3)
    assert one.path_m == pytest.approx(40.0)
    assert one.before_m == pytest.approx(0.5)
    assert one.after_m == pytest.approx(0.0, abs=1e-9)
    assert one.after_sigmas == pytest.approx(0.0, abs=1e-6)
    # Forty steps of 0.1 m each, and nothing else.
    assert one.without_m == pytest.approx(0.1 * math.sqrt(40.0), rel=0.05)


def test_other_loops_hold_a_place_without_those_of_a_row() -> None:
    rows = {row.place: row for row in round_trip((0, 40), (8, 48), (30, 70))}
    assert sorted(rows) == [0, 8, 30]
    # Eight steps to the place of the other row, and eight back.
    assert rows[0].without_m == pytest.approx(0.1 * math.sqrt(16.0), rel=0.05)


def test_loops_over_a_right_stretch_come_after_those_that_bent_the_map() -> None:
    rows = round_trip((15, 55), (0, 40))
    assert [(row.place, row.before_m) for row in rows] == [(0, pytest.approx(0.5)), (15, pytest.approx(0.0))]


def test_a_loop_across_a_break_of_the_steps_is_left_out() -> None:
    assert round_trip((0, 40), broken=20) == []
    assert round_trip() == []
