"""A 2D lidar that spins while its robot moves: its scans are straightened by the wheels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import gtsam
import numpy as np
import pytest
from flat_worlds import room, sweep
from numpy.typing import ArrayLike

from slam.config import Config
from slam.config.calibration import Calibration, LidarCorrection
from slam.datasets.corrections import corrected
from slam.datasets.spinning_scans import straight
from slam.doctor import turning
from slam.doctor.diagnosis import diagnose
from slam.measurements import FloatArray, LaserScan, Measurement, WheelOdometry, row_from_pose2

TURN_S, CUT_RAD = -0.2, math.pi
TWIST = np.array([0.4, 0.0, 0.9])
MOUNT = gtsam.Pose2(0.1, 0.05, 0.0)


def seen(stamp_s: float, pose: gtsam.Pose2, twist: ArrayLike = TWIST, turn_s: float = TURN_S) -> LaserScan:
    """A scan of 360 beams about its stamp, each from where the base is at its time."""
    scan, beams = None, np.arange(360)
    for slice_ in np.array_split(beams, 36):
        # Begun behind, counter-clockwise by the bearing.
        time_s = turn_s * ((slice_.mean() + 0.5) / 360.0 - 0.5)
        at = row_from_pose2(pose.compose(gtsam.Pose2.Expmap(time_s * np.asarray(twist))))
        part = sweep(room(), at, beams=360, fov_rad=math.radians(359.0), mount=MOUNT, stamp_s=stamp_s)
        scan = part if scan is None else scan
        scan.ranges_m[slice_] = part.ranges_m[slice_]
    assert scan is not None
    return scan


def walls_off_m(scan: LaserScan, pose: gtsam.Pose2) -> FloatArray:
    """How far beams end from what a scan that is taken at once sees there, (N,)."""
    at = row_from_pose2(pose)
    still = sweep(room(), at, beams=360, fov_rad=math.radians(359.0), mount=MOUNT)
    return np.abs(scan.ranges_m - still.ranges_m)


def test_a_scan_is_as_if_taken_at_once() -> None:
    pose = gtsam.Pose2(0.3, -0.4, 0.7)
    bent = seen(0.0, pose)
    found = straight(bent, TWIST, TURN_S, CUT_RAD)
    assert (found.bearings_rad() == bent.bearings_rad()).all()
    before, after = walls_off_m(bent, pose), walls_off_m(found, pose)
    assert np.nanpercentile(before, 90) > 0.1 > 0.02 > np.nanpercentile(after, 90)
    assert np.isnan(found.ranges_m).mean() < 0.1


@cache
def drive(turn_s: float, count: int = 250) -> Sequence[Measurement]:
    """A robot that swings about a circle, its wheels twenty times a second."""
    log, pose, rng = list[Measurement](), gtsam.Pose2(-0.6, -0.8, 0.0), np.random.default_rng(1)
    for tick in range(4 * count):
        stamp_s = 0.05 * tick
        twist = np.array([0.4, 0.0, 0.5 + 0.5 * math.sin(0.9 * stamp_s)])
        log.append(WheelOdometry(stamp_s, pose))
        if tick % 4 == 2:
            scan = seen(stamp_s, pose, twist, turn_s)
            noise = 0.005 * rng.standard_normal(len(scan.ranges_m)).astype(np.float32)
            log.append(replace(scan, ranges_m=scan.ranges_m + noise))
        pose = pose.compose(gtsam.Pose2.Expmap(0.05 * twist))
    return log


def test_the_doctor_finds_the_turn_and_mends_it() -> None:
    log = drive(TURN_S)
    (finding,) = diagnose(log)
    assert finding.kind == "turn" and finding.sure and finding.value == pytest.approx(TURN_S)
    mended = Calibration.model_validate(finding.remedies[0])
    cut_deg = mended.lidars["laser"].cut_deg
    assert abs(math.remainder(cut_deg - 180.0, 360.0)) < 30.0
    assert diagnose(list(corrected(log, mended))) == []


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["the other way", "as it turns"])
def test_a_turn_of_beams_is_taken_about_its_middle_in_either_direction(sign: float) -> None:
    beam_s = abs(TURN_S) / 360.0
    log = [
        replace(one, stamp_s=one.stamp_s - 0.5 * 359 * beam_s, beam_s=sign * beam_s)
        if isinstance(one, LaserScan)
        else one
        for one in drive(TURN_S)
    ]
    (finding,) = diagnose(log)
    assert finding.kind == "turn" and finding.value == pytest.approx(TURN_S)
    mended = Calibration.model_validate(finding.remedies[0])
    assert mended.lidars["laser"].cut_deg == 180.0
    poses = {one.stamp_s: one.T_odom_base for one in log if isinstance(one, WheelOdometry)}
    scans = [(one, before) for one, before in zip(corrected(log, mended), log, strict=True)]
    off_m = list[float]()
    for now, before in scans[20:]:
        if isinstance(now, LaserScan) and isinstance(before, LaserScan) and now.beam_s == 0.0:
            first_s = round(20 * now.stamp_s) / 20  # half a beam later
            assert now.stamp_s == before.stamp_s and abs(now.stamp_s - first_s) < beam_s
            off_m.append(
                float(
                    np.nanpercentile(walls_off_m(now, poses[min(poses, key=lambda s: abs(s - first_s))]), 80)
                )
            )
    assert len(off_m) > 200 and np.median(off_m) < 0.03


def test_scans_that_are_taken_at_once_have_no_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    # How they lie in the plane shows that at once: to follow them as clouds takes ten times as long.
    monkeypatch.setattr(turning, "CloudTracker", Mock(side_effect=AssertionError))
    assert diagnose(drive(0.0)) == []
    stated = [replace(one, beam_s=5e-4) if isinstance(one, LaserScan) else one for one in drive(0.0)]
    assert diagnose(stated) == []


def test_what_sees_half_a_circle_to_both_edges_may_not_spin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turning, "track_stretches", Mock(side_effect=AssertionError))
    half = sweep(room(), [0.0, 0.0, 0.0], beams=361, fov_rad=math.pi)
    assert turning.turn_in_the_plane([[half] * 5], 0.2, Config()) is None


def test_a_log_keeps_its_order_and_what_the_wheels_do_not_measure() -> None:
    spins = Calibration(lidars={"laser": LidarCorrection(turn_s=TURN_S)})
    log = drive(TURN_S, 10)
    found = list(corrected(log, spins))
    assert [(type(one), one.stamp_s) for one in found] == [(type(one), one.stamp_s) for one in log]
    scans = [(now, before) for now, before in zip(found, log, strict=True) if isinstance(now, LaserScan)]
    changed = [not np.array_equal(now.ranges_m, before.ranges_m, equal_nan=True) for now, before in scans]
    assert changed == [True] * 9 + [False]  # the wheels end before the last turn does
    alone = [one for one in log if isinstance(one, LaserScan)]
    assert all(
        isinstance(now, LaserScan) and np.array_equal(now.ranges_m, before.ranges_m)
        for now, before in zip(corrected(alone, spins), alone, strict=True)
    )
