"""The scans of a run, repaired by the images of the same run: what changes, and what must not."""

from __future__ import annotations

import gtsam
import numpy as np
import prism_world as world
import pytest

import fusion
from fusion.curves import FORWARD
from slam import forked
from slam.config.stages import FusionConfig
from slam.mapper.keyframe_fusion import KeyframeFusion
from slam.mapper.robot_cameras import Picture
from slam.measurements import CameraIntrinsics, LaserScan, RgbdFrame
from slam.vision.prepared_frame import PreparedFrame

OFFSET = (0.1, 0.02)
CAMERA_M = 0.9
BOXES = (*world.ROOM, world.CUPBOARD)
CONFIG = FusionConfig(least_pairs=10)


def scan_of(number, ranges_m=None, boxes=BOXES):
    curve = world.lidar(world.POSES[number], boxes=boxes)
    ranges = curve.ranges_m if ranges_m is None else ranges_m
    return LaserScan(float(number), ranges, curve.start_angle_rad, curve.step_rad, curve.range_max_m)


def picture_of(number, late_s=0.0, boxes=BOXES):
    depth = world.camera(world.POSES[number], CAMERA_M, boxes, OFFSET).depth_m
    k = world.INTRINSICS
    intrinsics = CameraIntrinsics(k.fx, k.fy, k.cx, k.cy, depth.shape[1], depth.shape[0])
    frame = RgbdFrame(number + late_s, np.zeros((*depth.shape, 3), np.uint8), depth, intrinsics)
    T_base_camera = gtsam.Pose3(gtsam.Rot3(FORWARD), np.array([*OFFSET, CAMERA_M]))
    return Picture(PreparedFrame(frame, None), T_base_camera)


def run(scans, config=CONFIG, late_s=0.0):
    """All keyframes of a run into the fusion, and its answer."""
    held = KeyframeFusion(config)
    for key, scan in enumerate(scans):
        if scan is not None:
            held.add(key, scan, [picture_of(key, late_s)])
    return held.repair(scans)


def all_scans():
    return [scan_of(number) for number in range(len(world.POSES))]


def seen_beam(scan):
    """The middle of a run of beams ahead, on one flat wall."""
    ahead = np.flatnonzero(np.abs(scan.bearings_rad()) < 0.35)
    flat = np.abs(np.diff(scan.ranges_m)) < 0.04
    return next(int(beam) for beam in ahead if flat[beam - 12 : beam + 12].all())


def test_holes_that_the_camera_sees_are_filled_and_what_is_given_stays_untouched():
    scans = all_scans()
    truth = scans[1].ranges_m.copy()
    at = seen_beam(scans[1])
    broken = truth.copy()
    broken[at] = np.inf
    broken[2:15] = np.inf  # behind the camera's back
    scans[1] = scan_of(1, broken)
    repaired, summary = run(scans)
    assert repaired[1].ranges_m[at] == pytest.approx(truth[at], abs=0.04)
    assert np.isinf(repaired[1].ranges_m[2:15]).all()
    assert np.isinf(scans[1].ranges_m[at])  # the log's own scan
    kinds = summary.pairs[1].repaired
    assert kinds[fusion.Provenance.FILLED] + kinds[fusion.Provenance.INTERPOLATED] >= 1
    assert (repaired[1].stamp_s, repaired[1].step_rad) == (scans[1].stamp_s, scans[1].step_rad)


def test_clean_scans_stay_within_the_noise_of_the_sensors():
    scans = all_scans()
    repaired, summary = run(scans)
    for before, after in zip(scans, repaired, strict=True):
        assert np.abs(after.ranges_m - before.ranges_m).max() < 0.07
    assert summary.estimate is not None and len(summary.pairs) == len(scans)
    assert summary.estimate.height_m == pytest.approx(0.3 - CAMERA_M, abs=0.1)
    assert f"fusion of {len(scans)} keyframes" in summary.note and "yaw between them" in summary.note


@pytest.mark.parametrize("width", [1, 2, 5])
def test_an_obstacle_that_the_lidar_alone_sees_never_disappears(width):
    scans = all_scans()
    at = seen_beam(scans[3])
    ranges = scans[3].ranges_m.copy()
    ranges[at : at + width] -= 0.6
    scans[3] = scan_of(3, ranges)
    repaired, _ = run(scans)
    assert np.array_equal(repaired[3].ranges_m[at : at + width], ranges[at : at + width])


def test_too_few_pairs_repair_nothing_and_say_so():
    scans = all_scans()
    repaired, summary = run(scans, FusionConfig(least_pairs=len(scans) + 1))
    assert all(after is before for before, after in zip(scans, repaired, strict=True))
    assert summary.estimate is None and "nothing was repaired" in summary.note


def test_images_of_another_time_are_no_pairs():
    scans = all_scans()
    repaired, summary = run(scans, late_s=0.5)
    assert summary is None
    assert all(after is before for before, after in zip(scans, repaired, strict=True))


def test_two_processes_repair_what_one_does(monkeypatch, caplog):
    scans = all_scans()
    odd = [*range(2, len(scans) - 1, 5)]
    denoise = fusion.denoise

    def refuses_some(curve, depths, estimate):
        if any(np.array_equal(curve.ranges_m, scans[number].ranges_m) for number in odd):
            raise ValueError("no image like the others")
        return denoise(curve, depths, estimate)

    monkeypatch.setattr(fusion, "denoise", refuses_some)
    found = []
    for free in (False, True):
        monkeypatch.setattr(forked, "is_core_free", lambda free=free: free)
        caplog.clear()
        repaired, summary = run(scans)
        assert len(caplog.records) == len(odd)
        found.append(([scan.ranges_m.tobytes() for scan in repaired], [str(pair) for pair in summary.pairs]))
    assert found[0] == found[1]


def test_a_keyframe_without_a_scan_stays_without():
    scans = [*all_scans(), None]
    repaired, summary = run(scans)
    assert repaired[-1] is None and len(summary.pairs) == len(scans) - 1


def test_a_second_camera_begins_the_rig_anew():
    held = KeyframeFusion(CONFIG)
    scans = all_scans()
    for key, scan in enumerate(scans):
        held.add(key, scan, [picture_of(key)] * (1 if key < 5 else 2))
    _, summary = held.repair(scans)
    assert [pair.stamp_s for pair in summary.pairs] == [float(key) for key in range(5, len(scans))]
