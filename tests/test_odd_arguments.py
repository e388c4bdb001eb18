"""Arguments that are no scans, poses or lenses: each call ends in one line of a documented exception."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from flat_worlds import room, sweep

import fusion
import slam
from slam.storage.measurement_soundness import checked

NAN = float("nan")
SCAN, POINTS, HERE = sweep(room(), (0, 0, 0)), np.ones((5, 2)), gtsam.Pose2()
CURVE = fusion.LidarCurve(np.ones(361), -np.pi, np.pi / 180)
LENS = fusion.Intrinsics(100.0, 100.0, 4.5, 4.5)
IMAGE = fusion.DepthImage(np.ones((10, 10)), LENS)
CAMERA = slam.CameraIntrinsics(10.0, 10.0, 4.5, 4.5, 10, 10)
FRAME = slam.RgbdFrame(0.0, np.zeros((10, 10, 3), np.uint8), np.ones((10, 10), np.float32), CAMERA)
CLOUD = slam.PointCloud(0.0, np.ones((4, 3), np.float32))
SPANS = np.column_stack([np.arange(9.0), np.arange(9.0) + 1.0])

OF_SLAM: dict[str, Callable[[], Any]] = {
    "no reference": lambda: slam.match_scans(None, POINTS),  # type: ignore[arg-type]
    "a text as a scan": lambda: slam.match_scans(POINTS, "scan"),  # type: ignore[arg-type]
    "rows of other lengths": lambda: slam.match_scans(POINTS, [[1, 2], [3]]),  # type: ignore[arg-type, list-item]
    "a pose as a guess": lambda: slam.match_scans(POINTS, POINTS, HERE),
    "a number as a configuration": lambda: slam.match_scans(POINTS, POINTS, config=3),  # type: ignore[arg-type]
    "a text as a window": lambda: slam.check_loop(POINTS, POINTS, half_width_m="wide"),  # type: ignore[arg-type]
    "poses in a grid": lambda: slam.grid_of_scans([SCAN], [HERE]),
    "points in a grid": lambda: slam.grid_of_scans([POINTS], [[0, 0, 0]]),  # type: ignore[list-item]
    "a bearing that is not finite": lambda: slam.grid_of_scans(
        [replace(SCAN, start_angle_rad=NAN)], [[0, 0, 0]]
    ),
    "points of no plane": lambda: slam.grid_of_scans([SCAN], [[0, 0, 0]]).cells_of(np.ones((2, 3))),
    "two columns of positions": lambda: slam.Trajectory(np.zeros(1), np.zeros((1, 2)), np.ones((1, 4)) / 2),
    "fewer quaternions": lambda: slam.Trajectory(np.zeros(2), np.zeros((2, 3)), np.ones((1, 4)) / 2),
    "a quaternion of zeros": lambda: slam.Trajectory(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 4))),
    "rows of poses": lambda: slam.Trajectory.from_planar(np.zeros(1), [HERE]),  # type: ignore[arg-type]
    "no origin": lambda: slam.PoseGraph(None),
    "a node in space": lambda: slam.PoseGraph(HERE).add_node(gtsam.Pose3()),
    "no edge": lambda: slam.PoseGraph(HERE).add_edge(None),  # type: ignore[arg-type]
    "no such node": lambda: slam.PoseGraph(HERE).pose(7),
    "a probability of 2": lambda: slam.PoseGraph(HERE).optimize(2.0),
}

ODD_MEASUREMENTS: dict[str, Any] = {
    "no measurement": HERE,
    "no ranges": replace(SCAN, ranges_m=None),
    "ranges in two dimensions": replace(SCAN, ranges_m=np.ones((2, 2), np.float32)),
    "no angle between beams": replace(SCAN, step_rad=0.0),
    "a stamp in a text": replace(SCAN, stamp_s="1"),
    "a mounting in space": replace(SCAN, T_base_laser=gtsam.Pose3()),
    "a mounting that is not finite": replace(SCAN, T_base_laser=gtsam.Pose2(NAN, 0, 0)),
    "wheels in space": slam.WheelOdometry(0.0, gtsam.Pose3()),
    "wheels that are not finite": slam.WheelOdometry(0.0, gtsam.Pose2(NAN, 0, 0)),
    "a frame without colour": replace(FRAME, color=None),
    "colours from 0 to 1": replace(FRAME, color=np.ones((10, 10, 3))),
    "no lens": replace(FRAME, intrinsics=None),
    "a camera in the plane": replace(FRAME, T_base_camera=HERE),
    "points in the plane": replace(CLOUD, points_lidar=np.ones((4, 2), np.float32)),
    "fewer times than points": replace(CLOUD, times_s=np.zeros(3)),
    "two turn rates": slam.ImuReading(0.0, np.zeros(2), np.zeros(3)),
    "turn rates that are not finite": slam.ImuReading(0.0, np.full(3, NAN), np.zeros(3)),
    "no force": slam.ImuReading(0.0, np.zeros(3), None),  # type: ignore[arg-type]
    "a latitude of 200 degrees": slam.GnssFix(0.0, 200.0, 8.0, 0.0),
    "an antenna in the plane": slam.GnssFix(0.0, 49.0, 8.0, 0.0, antenna_m=np.zeros(2)),
}

OF_FUSION: dict[str, Callable[[], Any]] = {
    "a lens that is not finite": lambda: fusion.DepthImage(np.ones((9, 9)), replace(LENS, fx=NAN)),
    "a lens of zeros": lambda: fusion.DepthImage(np.ones((9, 9)), replace(LENS, fy=0.0)),
    "numbers for a lens": lambda: fusion.DepthImage(np.ones((9, 9)), (1, 1, 1, 1)),  # type: ignore[arg-type]
    "an image centre far away": lambda: fusion.register(
        CURVE, fusion.DepthImage(np.ones((9, 9)), replace(LENS, cx=1e9))
    ),
    "a mirror for a rotation": lambda: fusion.DepthImage(np.ones((9, 9)), LENS, np.diag([1.0, 1.0, -1.0])),
    "objects for depths": lambda: fusion.DepthImage(np.full((9, 9), None), LENS),  # type: ignore[arg-type]
    "no beams": lambda: fusion.LidarCurve(np.ones(0), 0.0, 0.1),
    "no start": lambda: fusion.LidarCurve(np.ones(9), None, 0.1),  # type: ignore[arg-type]
    "no maximum": lambda: fusion.LidarCurve(np.ones(9), 0.0, 0.1, NAN),
    "a scan for a depth image": lambda: fusion.register(CURVE, SCAN),  # type: ignore[arg-type]
    "a height for heights": lambda: fusion.register(CURVE, IMAGE, heights_m=0.5),  # type: ignore[arg-type]
    "no pair": lambda: fusion.Rig().add(None),  # type: ignore[arg-type]
    "a rig that keeps nothing": lambda: fusion.Rig(0),
    "no registration": lambda: fusion.denoise(CURVE, IMAGE, None),  # type: ignore[arg-type]
    "a noise that is not finite": lambda: fusion.RangeNoise(NAN),
    "a band of texts": lambda: fusion.HeightBand("low", "high", "climb"),  # type: ignore[arg-type]
    "fewer rotations than spans": lambda: fusion.clock_offset(SPANS, np.ones(8), SPANS, np.ones(9)),
    "spans in one row": lambda: fusion.clock_offset(SPANS[0], np.ones(2), SPANS, np.ones(9)),
    "offsets of at most nothing": lambda: fusion.clock_offset(SPANS, np.ones(9), SPANS, np.ones(9), NAN),
}


@pytest.mark.parametrize("what", OF_SLAM)
def test_what_slam_refuses(what: str) -> None:
    with pytest.raises(slam.ScanweaveError) as caught:
        OF_SLAM[what]()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", OF_FUSION)
def test_what_fusion_refuses(what: str) -> None:
    with pytest.raises(ValueError, match=r"; give|not finite|rotation|: give") as caught:
        OF_FUSION[what]()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", ODD_MEASUREMENTS)
def test_what_no_sensor_measures(what: str) -> None:
    with pytest.raises(slam.ScanweaveError, match="number 1"):
        slam.build_map([ODD_MEASUREMENTS[what]])
    with pytest.raises(slam.ScanweaveError, match="the measurement") as caught:
        checked(ODD_MEASUREMENTS[what], "the measurement")
    assert "\n" not in str(caught.value)


def test_a_localizer_refuses_them_and_takes_lists() -> None:
    known = slam.build_map([sweep(room(), (0.1 * k, 0, 0), stamp_s=0.1 * k) for k in range(5)])
    localizer = slam.Localizer(known)
    with pytest.raises(slam.ScanweaveError, match="ranges_m is None; give numbers"):
        localizer.add(ODD_MEASUREMENTS["no ranges"])
    with pytest.raises(slam.ScanweaveError, match="give Measured"):
        slam.Localizer(known, start=HERE)
    assert localizer.add(replace(SCAN, ranges_m=SCAN.ranges_m.tolist())) is not None
    known.close()


def test_what_is_nearer_than_the_least_range_is_invalid() -> None:
    """As REP-117 writes it; the map stores NaN."""
    ranges_m = SCAN.ranges_m.copy()
    ranges_m[3] = -np.inf
    found = checked(replace(SCAN, ranges_m=ranges_m), "the scan").ranges_m
    assert np.isnan(found[3]) and np.isneginf(ranges_m[3])
    assert (found[4:] == ranges_m[4:]).all()
