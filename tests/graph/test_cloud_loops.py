"""Loops by clouds: a true return closes where it is, another room does not, and no place is tried twice."""

from __future__ import annotations

import math
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from cloud_world import SMALL, base, look

from slam.config import load_config
from slam.graph.cloud_loops import CloudLoopCloser
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.cloud_points import base_points
from slam.measurements import FloatArray

VOXEL_M = 0.25
# Out along the room and back to within a hand of the start; keyframes half a metre apart.
OUT = [base(-1.5 + 0.5 * n, 0.3, 0.05 * n) for n in range(8)]
HOME = base(-1.45, 0.38, 0.1)


class Drive:
    """Keyframes of clouds with poses that the test believes."""

    def __init__(self, *settings: str, sigma_m: float = 0.02) -> None:
        self._config = load_config(None, [*SMALL, *settings])
        self._clouds: list[FloatArray] = []
        self.poses: list[gtsam.Pose3] = []
        self._uncertainty = UncertaintyGraph()
        self._covariance = np.diag([sigma_m, sigma_m, 0.2 * sigma_m]) ** 2
        self.closer = CloudLoopCloser(self._config, VOXEL_M, self._clouds.__getitem__)

    def add(
        self,
        true: gtsam.Pose3,
        believed: gtsam.Pose3 | None = None,
        scale: float = 1.0,
        *,
        unseen: bool = False,
    ) -> None:
        believed = true if believed is None else believed
        key = len(self.poses)
        cloud = base_points(look(true, seed=key), np.zeros(6), self._config.cloud_odometry)
        self._clouds.append(scale * cloud)
        self._uncertainty.add_node()
        if self.poses:
            step = self.poses[-1].between(believed)
            row = np.array([step.x(), step.y(), step.rotation().yaw()])
            self._uncertainty.add_edge(key - 1, key, row, self._covariance)
        self.poses.append(believed)
        self.closer.add_keyframe(self._clouds[-1], believed, 0.015, unseen=unseen)

    def close(self) -> list[LoopCandidate]:
        rows = np.array([[pose.x(), pose.y(), pose.rotation().yaw()] for pose in self.poses])
        return self.closer.close(len(self.poses) - 1, self.poses, rows, self._uncertainty)


def driven(*settings: str, sigma_m: float = 0.02) -> Drive:
    drive = Drive(*settings, sigma_m=sigma_m)
    for pose in [*OUT, *OUT[-2::-1]]:
        drive.add(pose)
    return drive


def error_m(loop: LoopCandidate, place: gtsam.Pose3, true: gtsam.Pose3) -> float:
    assert loop.motion is not None
    assert isinstance(loop.motion.T_reference_base, gtsam.Pose3)
    return float(np.linalg.norm(place.between(true).between(loop.motion.T_reference_base).translation()))


@pytest.mark.parametrize("off_m", [0.0, 0.6], ids=["believed right", "believed far off"])
def test_a_true_return_closes_where_it_is(off_m: float) -> None:
    drive = driven(sigma_m=0.02 + 0.2 * off_m)
    drive.add(HOME, HOME.compose(base(off_m, -off_m, 0.0)))
    (loop,) = [loop for loop in drive.close() if loop.accepted]
    assert loop.place in (0, 1, 13, 14)
    assert loop.reason == ""
    assert error_m(loop, drive.poses[loop.place], HOME) < 0.02


def test_a_cautious_closer_claims_less() -> None:
    claimed = []
    for caution in (1.0, 9.0):
        drive = driven(f"loops.caution={caution}")
        drive.add(HOME)
        motion = drive.close()[0].motion
        assert motion is not None
        claimed.append(motion.covariance)
    np.testing.assert_allclose(claimed[1], 9.0 * claimed[0])


def test_it_waits_for_a_reach_of_way_between_attempts() -> None:
    drive = driven()
    assert drive.close()
    drive.add(drive.poses[-1].compose(base(0.3, 0.0, 0.0)))
    assert drive.close() == []
    drive.add(drive.poses[-1].compose(base(0.6, 0.0, 0.0)))
    assert drive.close()


def test_what_was_just_passed_is_no_place() -> None:
    drive = Drive()
    for pose in OUT:
        drive.add(pose)
    assert drive.close() == []


def test_none_are_tried_where_none_are_wanted() -> None:
    drive = driven("loops.enabled=false")
    assert drive.close() == []


def test_a_room_of_another_size_is_refused_with_a_reason() -> None:
    drive = driven(sigma_m=0.1)
    drive.add(HOME, scale=1.5)
    tried = drive.close()
    assert tried
    assert not any(loop.accepted for loop in tried)
    assert all(loop.reason for loop in tried)


def test_no_two_places_are_of_one_pass() -> None:
    drive = driven("loops.near=4", "loops.least_inlier_share=1.0", "loops.by_appearance=0", sigma_m=0.3)
    drive.add(HOME)
    path_m = np.cumsum([0.0, *[np.linalg.norm(a.between(b).translation()) for a, b in pairwise(drive.poses)]])
    tried = drive.close()
    assert len(tried) > 1
    at_m = sorted(path_m[loop.place] for loop in tried)
    assert min(np.diff(at_m)) > 3 * VOXEL_M
    assert max(at_m) < path_m[-1] - 20 * VOXEL_M


def test_the_window_follows_the_uncertainty() -> None:
    widths = []
    for sigma_m in (0.02, 0.3):
        drive = driven(sigma_m=sigma_m)
        drive.add(HOME)
        widths.append(max(loop.half_width_m for loop in drive.close()))
    # Four sigmas of fifteen steps, at least, and two voxels.
    assert widths[0] < 2.0
    assert widths[1] > 4.0 * 0.3 * math.sqrt(6.0)


def test_a_place_believed_elsewhere_is_found_by_its_appearance() -> None:
    drive = driven("loops.near=0", "loops.by_appearance=3", sigma_m=0.5)
    turned = HOME.compose(base(0.0, 0.0, math.pi))
    drive.add(turned, turned.compose(base(1.0, 1.0, 0.4)))
    accepted = [loop for loop in drive.close() if loop.accepted]
    assert accepted
    assert all(loop.score < 1.0 for loop in accepted)
    assert error_m(accepted[0], drive.poses[accepted[0].place], turned) < 0.03


def test_nothing_farther_than_the_uncertainty_allows_is_tried() -> None:
    drive = driven(sigma_m=0.001)
    far = base(60.0, 0.0, 0.0)
    drive.add(HOME, far)
    assert drive.close() == []


def test_a_return_after_a_way_unseen_waits_for_others_that_agree() -> None:
    drive = driven()
    drive.add(HOME, unseen=True)
    assert not any(loop.accepted for loop in drive.close())
    assert [loop.reason for loop in drive.closer.alone()] == [
        "no other loop across the unobserved gap agrees"
    ]
