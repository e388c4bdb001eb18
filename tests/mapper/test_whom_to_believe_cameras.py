"""Whom the mapper believes among lidar, wheels and cameras, judged by what becomes of the map.

A furnished room that the cameras see at their height and the lidar at its own; a drive goes wrong in one way.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flat_worlds import box, moved, sweep
from memory_drives import SCAN_S, START_S, errors, mapped, stamp_s, steps_of, way, wheels_at, worst_m
from room_world import SMALL, T_BODY_CAMERA, furnished, render

from slam.graph.edge import EdgeKind
from slam.mapper.map_result import MapResult
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, Measurement, RgbdFrame, row_from_pose2

WALLS = np.concatenate([box(-2.5, -2.0, 2.5, 2.0), box(1.6, 0.4, 2.5, 1.5), box(-2.5, -2.0, -1.7, -1.1)])
MOUNTS = {
    "front": gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([0.1, 0.0, 1.1])) * T_BODY_CAMERA,
    "back": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.1, 2.5), np.array([-0.1, 0.0, 1.0])) * T_BODY_CAMERA,
}
BEFORE_SCAN_S = 0.01  # frames are taken so long before the scans
NO_WHEELS = "sensors.wheels=false"
# So that half of the scans are keyframes: a short run then shows as much as a long one.
DENSE = ("keyframes.distance_m=0.07", "keyframes.angle_rad=0.08")

Lie = Callable[[int, str], tuple[float, ...]]
Sight = Callable[[int, FloatArray], FloatArray]


def pose_at(time_s: float) -> FloatArray:
    """(3,) around the middle of the room, turning now fast now slowly."""
    angle = 0.45 * time_s
    yaw = angle + 0.5 * math.pi + 0.35 * math.sin(1.7 * time_s) + 0.15 * math.sin(3.1 * time_s + 1.0)
    return np.array([0.9 * math.cos(angle), 0.7 * math.sin(angle), yaw])


def honest(scan: int, camera: str) -> tuple[float, ...]:
    return 0.0, 0.0, 0.0


def room(scan: int, pose: FloatArray) -> FloatArray:
    return WALLS


def lying(camera: str, first: int, last: int, offset: tuple[float, float, float]) -> Lie:
    """Between two scans a camera is moved away by an offset (3,) from where it should be, and stays there."""

    def lie(scan: int, name: str) -> tuple[float, ...]:
        share = float(np.clip((scan - first) / (last - first), 0.0, 1.0)) if name == camera else 0.0
        return tuple(share * value for value in offset)

    return lie


def walker(first: int, last: int) -> Sight:
    """Somebody who stays 0.8 m ahead is all that the lidar sees between two scans."""
    return lambda scan, pose: moved(box(0.8, -0.25, 1.1, 0.25), pose) if first <= scan < last else WALLS


@functools.cache
def seen(time_s: float, camera: str, lie: tuple[float, ...], seed: int) -> RgbdFrame:
    pose, mount = compose(pose_at(time_s), np.array(lie)), MOUNTS[camera]
    on_floor = gtsam.Pose3(gtsam.Rot3.Rz(pose[2]), np.array([pose[0], pose[1], 0.0]))
    return render(
        furnished(), on_floor * mount, SMALL, noise=(0.001, 0.0012), seed=seed, smooth=False,
        sensor=camera, T_base_camera=mount,
    )  # fmt: skip


def driven(
    scans: int,
    *overrides: str,
    cameras: tuple[str, ...] = ("front",),
    lie: Lie = honest,
    sight: Sight = room,
    ahead_s: float = 0.0,
) -> tuple[MapResult, FloatArray]:
    """The map of a drive, wheels right within 1 %, and its truth (N, 3); cameras' clocks may be ahead."""
    rng = np.random.default_rng(0)
    truth = np.array([pose_at(SCAN_S * n) for n in range(scans)])
    wheels = way((5.0, 1.0, -2.0), list(steps_of(truth) * [1.01, 1.0, 1.0]))
    found: list[Measurement] = []
    for n, pose in enumerate(truth):
        time_s = round(SCAN_S * n - BEFORE_SCAN_S, 6)
        for camera in cameras:
            frame = seen(time_s, camera, lie(n, camera), n)
            found.append(replace(frame, stamp_s=START_S + time_s + ahead_s))
        world = sight(n, pose)
        found.append(wheels_at(n, wheels[n]))
        found.append(
            sweep(world, pose, beams=181, fov_rad=math.pi, sigma_m=0.01, seed=rng, stamp_s=stamp_s(n))
        )
    return mapped(found, *overrides), truth


def camera_edges(result: MapResult, truth: FloatArray) -> tuple[FloatArray, list[bool]]:
    """How far each camera edge is off its true motion, (E, 2) metres and radians, and whether it was kept."""
    at = [round((scan.stamp_s - START_S) / SCAN_S) for scan in result.map.measured_scans if scan is not None]
    off, kept = [], []
    for factor in result.map.factors:
        edge = factor.edge
        if edge.kind is EdgeKind.RGBD:
            true = between(truth[at[edge.source]], truth[at[edge.target]])
            wrong = between(true, row_from_pose2(edge.T_source_target))
            off.append((math.hypot(*wrong[:2]), abs(wrong[2])))
            kept.append(factor.kept)
    return np.array(off), kept


def _since_first(poses: FloatArray) -> list[FloatArray]:
    """Poses (N, 3) seen from the first."""
    return [between(poses[0], pose) for pose in poses]


class TestClock:
    def test_a_camera_whose_clock_is_off_shows_the_truth_in_the_end(self) -> None:
        """Its steps were off by up to 0.1 rad when they were new; the clock is known when all is seen."""
        result, truth = driven(60, ahead_s=0.08)
        assert worst_m(result, truth) < 0.015
        off, kept = camera_edges(result, truth)
        assert len(off) > 8 and all(kept)
        assert (off.max(axis=0) < [0.01, 0.008]).all()
        notes = [note.split(": its clock is") for note in result.notes if "its clock is" in note]
        reported = {name: float(words.split()[0]) for name, words in notes}
        assert sorted(reported.values()) == pytest.approx([0.0, 80.0], abs=5.0)
        assert abs(reported["wheels"]) < 5.0

    def test_frames_that_lead_get_their_true_times_in_the_end(self) -> None:
        """Their clock is known when all is seen: each frame, and the wheels around it, lie on the way."""
        result, _ = driven(60, "sensors.lidar=false", ahead_s=-0.08)
        found = result.map.trajectory
        ways = found.to_planar(), np.array([pose_at(one_s - START_S) for one_s in found.stamps_s.tolist()])
        off = np.array([between(*poses) for poses in zip(*map(_since_first, ways), strict=True)])
        frames = np.isin(found.stamps_s, result.scans.stamps_s)
        assert frames.sum() == 60
        np.testing.assert_array_less(np.abs(off[frames]).max(axis=0), [0.015, 0.015, 0.004])
        np.testing.assert_array_less(np.abs(off).max(axis=0), [0.02, 0.02, 0.02])
        keyframes = found.stamps_s[np.isin(found.stamps_s, result.map.stamps_s)]
        np.testing.assert_array_equal(keyframes, result.map.stamps_s)

    def test_a_clock_that_is_right_stays(self) -> None:
        result, truth = driven(60)
        off, kept = camera_edges(result, truth)
        assert len(off) > 12 and all(kept)
        assert (off.max(axis=0) < [0.01, 0.008]).all()


class TestLyingCamera:
    """Lidar and wheels measure the truth; a camera is moved by something for a while."""

    @pytest.mark.parametrize(
        ("last", "offset"),
        [(35, (0.3, 0.0, 0.0)), (45, (0.0, 0.3, 0.0)), (35, (0.0, 0.0, 0.2))],
    )
    def test_exact_wheels_stand_by_the_match(self, last: int, offset: tuple[float, float, float]) -> None:
        result, truth = driven(55, *DENSE, lie=lying("front", 30, last, offset))
        assert worst_m(result, truth) < 0.04
        matches = [factor.kept for factor in result.map.factors if factor.edge.kind is EdgeKind.LIDAR]
        assert np.mean(matches) > 0.95


class TestSomebodyWalksAhead:
    """1.5 s long the lidar sees nothing but a walker, who stays before the robot as it drives and turns."""

    FIRST, LAST = 25, 40

    def errors(self, *overrides: str, cameras: tuple[str, ...], lie: Lie = honest) -> FloatArray:
        """(2,) greatest error, metres and radians."""
        sight = walker(self.FIRST, self.LAST)
        greatest: FloatArray = errors(*driven(60, *overrides, cameras=cameras, lie=lie, sight=sight)).max(
            axis=0
        )
        return greatest

    def test_a_camera_and_the_wheels_outvote_the_lidar(self) -> None:
        assert (self.errors(cameras=("front",)) < 0.11).all()
        assert self.errors(cameras=()).max() > 0.2, "else the bound above says nothing"

    def test_two_cameras_outvote_the_lidar(self) -> None:
        assert (self.errors(NO_WHEELS, cameras=("front", "back")) < 0.13).all()

    def test_a_camera_that_lies_meanwhile_is_outvoted_too(self) -> None:
        lie = lying("front", self.FIRST, self.LAST, (0.4, 0.0, 0.0))
        assert (self.errors(cameras=("front", "back"), lie=lie) < 0.11).all()
