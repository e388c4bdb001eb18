import gzip
import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.relations import Relations, read_relations, score_relations

LOGS = Path(__file__).parents[2] / ".." / "shared" / "data" / "lidar2d"


def walk(rng, count):
    poses = [gtsam.Pose2()]
    for _ in range(count - 1):
        poses.append(poses[-1].compose(gtsam.Pose2(*rng.uniform([0, -0.1, -1], [0.5, 0.1, 1]))))
    stamps = 1000.0 + np.cumsum(rng.uniform(0.5, 1.0, count))
    return stamps, np.array([[p.x(), p.y(), p.theta()] for p in poses])


def relation_rows(stamps, rows, pairs):
    def pose(i):
        return gtsam.Pose2(*rows[i])

    moved = [pose(i).between(pose(j)) for i, j in pairs]
    table = np.array([[p.x(), p.y(), 0.0, 0.0, 0.0, p.theta()] for p in moved])
    first, second = np.array(pairs).T
    return Relations(stamps[first], stamps[second], table)


def test_a_trajectory_scores_nothing_against_its_own_relations_in_any_frame_and_order():
    rng = np.random.default_rng(1)
    stamps, rows = walk(rng, 60)
    relations = relation_rows(stamps, rows, [(0, 5), (7, 3), (2, 50), (59, 0)])
    T_other_map = gtsam.Pose2(30.0, -7.0, 2.5)
    moved = [T_other_map.compose(gtsam.Pose2(*row)) for row in rows]
    turned = np.array([[p.x(), p.y(), p.theta()] for p in moved])
    shuffled = rng.permutation(60)
    score = score_relations(Trajectory.from_planar(stamps[shuffled], turned[shuffled]), relations)
    assert (score.used, score.skipped) == (4, 0)
    assert score.all.translation_m.max < 1e-12
    assert score.all.rotation_rad.max < 1e-12


def test_errors_are_taken_component_by_component():
    trajectory = Trajectory.from_planar(
        np.array([0.0, 1.0, 30.0]), np.array([[0, 0, 0], [1, 0, 0], [1, 3, 3.0]])
    )
    relations = Relations(
        np.array([0.0, 0.0]),
        np.array([1.0, 30.0]),
        # The first is off by (3, -4) and 0.5 rad (height and tilt do not count), the second by 2 pi - 6 rad.
        np.array([[-2.0, 4.0, 9.0, 1.0, 1.0, 0.5], [1.0, 3.0, 0.0, 0.0, 0.0, -3.0]]),
    )
    score = score_relations(trajectory, relations)
    assert score.short.translation_m.mean == pytest.approx(5.0)
    assert score.short.rotation_rad.mean == pytest.approx(0.5)
    assert score.long.translation_m.mean == pytest.approx(0.0)
    assert score.long.rotation_rad.mean == pytest.approx(2 * math.pi - 6.0)
    assert score.all.translation_m.mean == pytest.approx(2.5)
    assert score.all.translation_m.std == pytest.approx(2.5)
    assert score.all.translation_m.median == pytest.approx(2.5)
    assert score.all.translation_m.max == pytest.approx(5.0)


def test_the_second_pose_is_seen_from_the_first():
    trajectory = Trajectory.from_planar(
        np.array([0.0, 1.0]), np.array([[5, 5, math.pi / 2], [5, 7, math.pi / 2]])
    )
    forward = Relations(np.array([0.0]), np.array([1.0]), np.array([[2.0, 0, 0, 0, 0, 0]]))
    assert score_relations(trajectory, forward).all.translation_m.max == pytest.approx(0.0, abs=1e-12)
    backward = Relations(np.array([1.0]), np.array([0.0]), np.array([[-2.0, 0, 0, 0, 0, 0]]))
    assert score_relations(trajectory, backward).all.translation_m.max == pytest.approx(0.0, abs=1e-12)


def test_poses_count_within_a_tenth_of_a_second():
    trajectory = Trajectory.from_planar(np.array([10.0, 11.0]), np.array([[0, 0, 0], [1, 0, 0.0]]))
    first = np.array([10.09, 9.91, 10.11, 10.0])
    relations = Relations(first, np.array([11.0, 11.0, 11.0, 12.0]), np.tile([1.0, 0, 0, 0, 0, 0], (4, 1)))
    score = score_relations(trajectory, relations)
    assert (score.used, score.skipped) == (2, 2)
    assert score.long is None
    as_dict = score.to_dict()
    assert as_dict["used"] == as_dict["short"]["used"] == 2
    assert as_dict["long"] is None
    with pytest.raises(EvaluationError, match=r"none of 4 relations .* 0.1 s .*trajectory 0.000 to 1.000 s"):
        score_relations(Trajectory.from_planar(np.array([0.0, 1.0]), np.zeros((2, 3))), relations)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 2 0 0 0 0 0", "7 fields"),
        ("1 2 0 0 0 0 0 nan", "'nan' is not a finite number"),
        ("1 2 0 0 0 0 0 x", "could not convert"),
    ],
)
def test_a_bad_line_is_refused_by_number(tmp_path, line, reason):
    path = tmp_path / "some.relations"
    path.write_text(f"1 2 0 0 0 0 0 0\n\n{line}\n")
    with pytest.raises(EvaluationError, match=f"some.relations:3: .*{reason}"):
        read_relations(path)
    path.write_text("# none\n")
    with pytest.raises(EvaluationError, match="holds no relation"):
        read_relations(path)


@pytest.mark.parametrize(
    ("name", "count", "mean_m", "mean_deg"), [("fr079", 1685, 6.50, 30.3), ("intel", 2984, 7.40, 39.6)]
)
def test_wheel_odometry_scores_what_the_data_sheet_says(name, count, mean_m, mean_deg):
    log = LOGS / name / f"{name}.log.gz"
    if not log.exists():
        pytest.skip(f"no lidar logs under {LOGS}")
    relations = read_relations(LOGS / name / f"{name}.relations")
    assert len(relations) == count
    rows = []
    with gzip.open(log, "rt") as stream:
        for line in stream:
            fields = line.split()
            if fields[0] == "ODOM":
                rows.append([float(fields[7]), *map(float, fields[1:4])])
    table = np.array(rows)
    score = score_relations(Trajectory.from_planar(table[:, 0], table[:, 1:]), relations)
    assert score.skipped == 0
    # Intel's clock is coarse: which reading of several with one stamp is taken moves the figures so much.
    assert score.all.translation_m.mean == pytest.approx(mean_m, abs=0.02)
    assert math.degrees(score.all.rotation_rad.mean) == pytest.approx(mean_deg, abs=0.3)
    assert score.short.used + score.long.used == score.used
