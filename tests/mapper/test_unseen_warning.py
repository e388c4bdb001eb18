"""What a run says of a while in which no scan was placed."""

import numpy as np
import pytest

from slam.config import Config
from slam.mapper.map_result import unseen
from slam.trajectory.poses import Poses

STAMPS_S = np.arange(0.0, 10.01, 0.5)
ALONG = Poses.planar(np.column_stack([10.0 * STAMPS_S, 0.0 * STAMPS_S, 0.0 * STAMPS_S])).trajectory(STAMPS_S)
PLACED = np.flatnonzero((STAMPS_S <= 3.0) | (STAMPS_S >= 7.0))


@pytest.mark.parametrize(
    ("position_m", "turn_rad", "stated"),
    [(0.7, 0.0, "up to 0.70 m and 0.0 degrees"), (0.1, 0.3, "up to 0.10 m and 17.2 degrees"), (0.5, 0.1, "")],
)
def test_only_what_a_match_would_not_mend_is_reported(
    position_m: float, turn_rad: float, stated: str
) -> None:
    """In metres, or by a turn of what lies 3 m away."""
    covariances = np.zeros((len(STAMPS_S), 3, 3))
    covariances[(STAMPS_S > 4.0) & (STAMPS_S < 6.0)] = np.diag([position_m**2, 0.0, turn_rad**2])
    warnings = unseen(ALONG, PLACED, PLACED, covariances, Config())
    assert [stated in warning for warning in warnings] == [True] * bool(stated)
    assert all("from 3.0 to 7.0 s: relative" in warning for warning in warnings)


def test_the_worst_of_several_is_reported_with_their_number() -> None:
    placed = np.setdiff1d(PLACED, np.flatnonzero((STAMPS_S > 7.5) & (STAMPS_S < 9.5)))
    covariances = np.diag([0.0, 1.0, 0.0])[None] * np.isin(STAMPS_S, [5.0, 8.5])[:, None, None]
    covariances[STAMPS_S == 8.5] *= 4.0
    (warning,) = unseen(ALONG, placed, placed, covariances, Config())
    assert (
        "from 7.5 to 9.5 s (the worst of 2 such periods): relative to before, poses are uncertain by up to "
        "2.00 m" in warning
    )


def test_no_gap_is_reported_where_the_pose_was_uncertain_before() -> None:
    """A heading that is off from the start moves what is 100 m on by the more, gap or not."""
    covariances = np.repeat(np.diag([4.0, 4.0, 0.1])[None], len(STAMPS_S), axis=0)
    covariances[:, 1, 1] += 0.1 * (10.0 * STAMPS_S) ** 2
    covariances[:, 1, 2] = covariances[:, 2, 1] = 0.1 * 10.0 * STAMPS_S
    assert not unseen(ALONG, PLACED, PLACED, covariances, Config())


@pytest.mark.parametrize(("speed_m_s", "reported"), [(1.0, True), (0.1, False)])
def test_an_open_direction_is_reported_once_the_robot_may_have_left(speed_m_s: float, reported: bool) -> None:
    """Every scan was matched; for 4 s none fixed the pose, in which the robot went 4 or 0.4 m."""
    x = speed_m_s * STAMPS_S
    along = Poses.planar(np.column_stack([x, 0.0 * x, 0.0 * x])).trajectory(STAMPS_S)
    covariances = np.zeros((len(STAMPS_S), 3, 3))
    covariances[(STAMPS_S > 4.0) & (STAMPS_S < 6.0), 0, 0] = 1.0
    warnings = unseen(along, np.arange(len(STAMPS_S)), PLACED, covariances, Config())
    assert ["in all directions from 3.0 to 7.0 s" in warning for warning in warnings] == [True] * reported
