"""Where a camera was between its frames, and what a track does not know."""

import gtsam
import numpy as np
import pytest

from slam.measurements import FloatArray
from slam.odometry.camera_track import CameraPose, CameraTrack

TWIST = np.array([0.1, -0.2, 0.6, 0.4, 0.0, -0.3])
COVARIANCE = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6


def at_constant_speed(stamps: FloatArray, segment: int = 0) -> CameraTrack:
    track = CameraTrack()
    for stamp_s in stamps:
        track.add(stamp_s, CameraPose(gtsam.Pose3.Expmap(TWIST * stamp_s), COVARIANCE, segment))
    return track


@pytest.mark.parametrize("stamp_s", [-0.2, -0.03, 0.0, 0.03, 0.1, 0.149, 0.2, 0.23, 0.31])
def test_constant_speed_is_followed_between_frames_and_beyond(stamp_s: float) -> None:
    found = at_constant_speed(np.arange(4) * 0.1).at(stamp_s, clock_sigma_s=0.0)
    assert found is not None
    np.testing.assert_allclose(found.pose.matrix(), gtsam.Pose3.Expmap(TWIST * stamp_s).matrix(), atol=1e-9)
    assert np.linalg.eigvalsh(found.covariance - 0.999 * COVARIANCE)[0] >= 0.0


def test_a_pose_between_frames_is_surer_than_one_carried_on() -> None:
    track = at_constant_speed(np.arange(4) * 0.1)
    between, beyond = track.at(0.25, 0.0), track.at(0.35, 0.0)
    assert between is not None
    assert beyond is not None
    assert np.trace(between.covariance) < np.trace(beyond.covariance)


def test_a_clock_that_is_not_sure_blurs_what_moves() -> None:
    track = at_constant_speed(np.arange(4) * 0.1)
    confident, uncertain = track.at(0.25, 0.0), track.at(0.25, 0.02)
    assert confident is not None
    assert uncertain is not None
    added = np.diag(uncertain.covariance) - np.diag(confident.covariance)
    np.testing.assert_allclose(added, (TWIST * 0.02) ** 2, atol=1e-12)


def test_what_a_track_does_not_know() -> None:
    track = CameraTrack()
    assert track.at(0.0, 0.0) is None
    assert track.newest_motion() is None
    track = at_constant_speed(np.array([0.0, 0.1, 0.5]))
    assert track.at(-0.26, 0.0) is None  # long before it began
    assert track.at(0.3, 0.0) is None  # in a gap
    assert track.at(0.8, 0.0) is None  # long after
    track.add(0.6, CameraPose(gtsam.Pose3(), COVARIANCE, 1))
    assert track.at(0.55, 0.0) is None  # between two segments
    track.lose()
    assert track.at(0.61, 0.0) is None


def test_a_clock_that_goes_back_begins_anew() -> None:
    track = at_constant_speed(np.array([10.0, 10.1]))
    track.lose()
    track.add(3.0, CameraPose(gtsam.Pose3(), 2.0 * COVARIANCE, 7))
    assert track.at(10.05, 0.0) is None
    assert track.newest_motion() is None
    begun = track.at(3.0, 0.0)
    assert begun is not None
    assert begun.pose.equals(gtsam.Pose3(), 1e-12) and begun.segment == 7
    np.testing.assert_allclose(begun.covariance, 2.0 * COVARIANCE, rtol=1e-6)


@pytest.mark.parametrize("newest_s", [0.2, 0.4])
def test_the_newest_motion_is_a_speed_between_two_stamps(newest_s: float) -> None:
    """Of a camera of few images a second, too: it shows how it turned, though not where it was between."""
    motion = at_constant_speed(np.array([0.0, 0.1, newest_s])).newest_motion()
    assert motion is not None
    assert motion[:2] == (0.1, newest_s)
    np.testing.assert_allclose(motion[2], TWIST, atol=1e-9)
    assert at_constant_speed(np.array([0.0, 0.1, 0.7])).newest_motion() is None
