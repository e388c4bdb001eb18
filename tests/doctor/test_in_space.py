"""Cameras and 3D lidars against how the robot moves: units, lens, clock, place, mirror."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from slam.config.calibration import Calibration
from slam.datasets.corrections import corrected
from slam.doctor.camera_samples import CameraSamples, MatchedPair, SensorStep
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.diagnosis import diagnose
from slam.doctor.finding import Finding, remedied
from slam.doctor.floor import floor_below_m
from slam.doctor.in_space import (
    Base,
    Seen,
    camera_findings,
    cloud_findings,
    findings_against,
    lens_findings,
    seen_by,
)
from slam.doctor.lens_fit import lens_fit
from slam.doctor.paired_motions import BaseTrack, mended_rows
from slam.doctor.stretches import Stretches
from slam.measurements import CameraIntrinsics, PointCloud, RgbdFrame
from slam.vision.camera_frame import T_BODY_CAMERA
from tests.driven_arcs import STAMPS, base_rows
from tests.room_world import furnished, render, turning_walk

LENS = CameraIntrinsics(500.0, 500.0, 320.0, 240.0, 640, 480)
PLACE = (0.2, -0.1, 0.7)
NO_WHEELS = np.empty((0, 4))


def camera_at(yaw: float = 0.0, pitch: float = 0.2, place: tuple[float, float, float] = PLACE) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, 0.0), np.array(place)).compose(T_BODY_CAMERA)


def seen_moving(
    true: gtsam.Pose3, stated: gtsam.Pose3, *, scale: float = 1.0, late_s: float = 0.0, certain: bool = True
) -> tuple[Base, Seen]:
    """A camera that moves as it truly sits, with noise, and is stated to sit elsewhere."""
    rows, rng = base_rows(), np.random.default_rng(1)
    samples = CameraSamples()
    poses = [gtsam.Pose3(gtsam.Pose2(*row[1:])).compose(true) for row in rows]
    steps = []
    for k in range(len(poses) - 1):
        motion = poses[k].between(poses[k + 1])
        turn = gtsam.Rot3.Expmap(rng.normal(0.0, 0.001, 3)).compose(motion.rotation())
        shift = scale * (np.asarray(motion.translation()) + rng.normal(0.0, 0.002, 3))
        steps.append(SensorStep(rows[k, 0] + late_s, rows[k + 1, 0] + late_s, gtsam.Pose3(turn, shift)))
    samples.steps = [steps]
    base = Base("odometry", BaseTrack(rows), certain)
    return base, seen_by("cameras", "camera", samples, stated, base)


def found(true: gtsam.Pose3, stated: gtsam.Pose3, **more: float) -> list[Finding]:
    base, seen = seen_moving(true, stated, **more)  # type: ignore[arg-type]
    return findings_against(base, [seen], frozenset())


def mended(findings: list[Finding], frame: RgbdFrame) -> RgbdFrame:
    (after,) = corrected([frame], remedied(Calibration(), findings, only_sure=False))
    assert isinstance(after, RgbdFrame)
    return after


def frame(stated: gtsam.Pose3 | None = None) -> RgbdFrame:
    color = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    lens = CameraIntrinsics(5.0, 5.0, 2.0, 1.5, 6, 4)
    return RgbdFrame(1.0, color, np.full((4, 6), 2.0, np.float32), lens, stated)


def test_a_sound_camera_gives_no_finding() -> None:
    assert found(camera_at(), camera_at()) == []
    assert found(camera_at(1.5), camera_at(1.5 + math.radians(2.0)), late_s=0.05) == []


@pytest.mark.parametrize(
    "stated",
    [
        camera_at(math.radians(10.0)),
        camera_at(math.pi),
        camera_at(pitch=0.5),
        camera_at(place=(0.5, -0.1, 0.7)),
        gtsam.Pose3(gtsam.Rot3.Roll(2.5), np.zeros(3)).compose(camera_at()),
    ],
)
def test_a_wrong_mounting_is_named_and_mended(stated: gtsam.Pose3) -> None:
    (finding,) = found(camera_at(), stated)
    assert finding.kind == "mounting" and finding.sure
    after = mended([finding], frame(stated)).T_base_camera
    assert after is not None
    step = gtsam.Pose3.Logmap(after.between(camera_at()))
    assert (
        np.linalg.norm(step[:3]) < 0.02
        and np.linalg.norm(np.asarray(after.translation())[:2] - PLACE[:2]) < 0.03
    )


def test_a_clock_and_a_scale_are_named_with_their_remedies() -> None:
    (clock,) = found(camera_at(), camera_at(), late_s=0.4)
    assert clock.kind == "clock" and clock.value == pytest.approx(0.4, abs=0.03)
    (scale,) = found(camera_at(), camera_at(), scale=1.2)
    assert scale.remedies == ({"cameras": {"camera": {"depth_scale": pytest.approx(1 / 1.2, abs=0.01)}}},)
    assert mended([scale], frame()).depth_m.mean() == pytest.approx(2.0 / 1.2, rel=0.01)


def test_by_wheels_alone_both_remedies_are_named_unless_the_floor_decides() -> None:
    base, seen = seen_moving(camera_at(), camera_at(), scale=1.2, certain=False)
    (open_,) = findings_against(base, [seen], frozenset())
    assert not open_.sure and len(open_.remedies) == 2
    seen.floor_m = 1.2 * PLACE[2]
    (depth,) = findings_against(base, [seen], frozenset())
    assert depth.sure and depth.kind == "depth scale" and len(depth.remedies) == 1
    seen.floor_m = PLACE[2]
    (way,) = findings_against(base, [seen], frozenset())
    assert way.sure and way.sensor == "odometry" and list(way.remedies[0]) == ["wheels"]


def test_two_sensors_that_agree_blame_the_wheels() -> None:
    base, seen = seen_moving(camera_at(), camera_at(), scale=0.5, certain=False)
    _, other = seen_moving(camera_at(1.0), camera_at(1.0), scale=0.5, certain=False)
    other.name = "other"
    (way,) = findings_against(base, [seen, other], frozenset())
    assert way.sensor == "odometry" and way.remedies[0]["wheels"]["odometry"]["scale"] == pytest.approx(
        0.5, abs=0.01
    )


def test_mirrored_images_are_distinguished_from_a_camera_on_its_head() -> None:
    mirror = np.diag([-1.0, 1.0, 1.0])
    base, seen = seen_moving(camera_at(), camera_at())
    assert seen.fit is not None
    # A mirror turns the upright round and leaves the way ahead.
    from dataclasses import replace

    seen.fit = replace(seen.fit, up=-mirror @ seen.fit.up, ahead=mirror @ seen.fit.ahead)
    seen.upside_down = False
    (finding,) = findings_against(base, [seen], frozenset())
    assert finding.kind == "mirrored" and finding.remedies == ({"cameras": {"camera": {"mirrored": True}}},)
    after = mended([finding], frame())
    assert np.array_equal(after.color, frame().color[:, ::-1]) and after.intrinsics.cx == 3.0
    seen.upside_down = True
    assert [one.kind for one in findings_against(base, [seen], frozenset())] == ["mounting"]


def pairs(
    focal: float,
    center: tuple[float, float],
    count: int = 40,
    turn_rad: float = 0.2,
    depth_share: float = 0.002,
) -> list[MatchedPair]:
    """Points that a camera of a lens sees from two sides."""
    rng, made = np.random.default_rng(2), []
    for _ in range(count):
        points = rng.uniform([-1.5, -1.0, 1.5], [1.5, 1.0, 4.0], (60, 3))
        turn = gtsam.Rot3.Expmap(rng.normal(0.0, turn_rad, 3)).matrix()
        sides = []
        for side in (points, points @ turn.T + rng.normal(0.0, 0.1, 3)):
            u, v = (
                focal * side[:, :2].T / side[:, 2] + np.array(center)[:, None] + rng.normal(0.0, 0.3, (2, 60))
            )
            sides.append(np.column_stack([u, v, side[:, 2] * (1.0 + rng.normal(0.0, depth_share, 60))]))
        made.append(MatchedPair(*sides))
    return made


def test_the_lens_follows_from_the_shape_of_what_is_seen() -> None:
    fit = lens_fit(pairs(400.0, (350.0, 240.0)), LENS)
    assert fit is not None
    assert fit.focal_gain == pytest.approx(0.8, abs=0.01)
    assert fit.center_px == pytest.approx([350.0, 240.0], abs=3.0)
    samples = CameraSamples(pairs=pairs(400.0, (320.0, 240.0)), intrinsics=LENS)
    (finding,) = lens_findings("camera", samples)
    assert finding.remedies[0]["cameras"]["camera"]["intrinsics"]["fx"] == pytest.approx(400.0, rel=0.02)
    assert lens_findings("camera", CameraSamples(pairs=pairs(500.0, (320.0, 240.0)), intrinsics=LENS)) == []
    assert (
        lens_findings("camera", CameraSamples(pairs=pairs(500.0, (320.0, 240.0), 5), intrinsics=LENS)) == []
    )


@pytest.mark.parametrize(("gain", "found"), [(0.88, True), (1.13, True), (0.97, False), (1.03, False)])
def test_the_lens_of_another_camera_is_found(gain: float, found: bool) -> None:
    samples = CameraSamples(pairs=pairs(gain * LENS.fx, (LENS.cx, LENS.cy)), intrinsics=LENS)
    assert bool(lens_findings("camera", samples)) is found


@pytest.mark.parametrize("focal", [500.0, 400.0])
def test_a_lens_is_not_shrunk_by_depths_that_are_noisy(focal: float) -> None:
    """Where a camera turns little, and its depths are off by more than its pixels, the interval holds."""
    fit = lens_fit(pairs(focal, (320.0, 240.0), turn_rad=0.06, depth_share=0.01), LENS)
    assert fit is not None
    assert abs(fit.focal_gain - focal / LENS.fx) < 3.0 * fit.sigmas[0] < 0.2


@pytest.mark.parametrize(
    ("middle_m", "scale"),
    [(1700.0, 0.001), (0.0017, 1000.0), (1.7, None), (6.5, None), (8.0, 0.2), (0.38, 5.0), (0.0, None)],
)
def test_depth_that_no_camera_sees_is_in_another_unit(middle_m: float, scale: float | None) -> None:
    # The camera looks at something near most of the time, but it sees more.
    depths_m = middle_m * np.array([0.5] * 60 + [1.0] * 30 + [2.0] * 10)
    samples = CameraSamples(count=5, points=[np.column_stack([0.0 * depths_m, 0.0 * depths_m, depths_m])])
    found = camera_findings("camera", samples, NO_WHEELS)
    remedies = [one.remedies[0]["cameras"]["camera"]["depth_scale"] for one in found]
    assert remedies == ([] if scale is None else [pytest.approx(scale)])
    assert all(one.sure == (middle_m > 30.0 or middle_m < 0.1) for one in found)


@pytest.mark.parametrize(
    ("median_m", "unit"),
    [(1800.0, 1000.0), (11_000.0, 1000.0), (180.0, 100.0), (1060.0, 100.0), (60.0, None)],
)
def test_clouds_beyond_all_ranges_are_in_another_unit(median_m: float, unit: float | None) -> None:
    samples = CloudSamples(count=5, points=[median_m * np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])])
    found = cloud_findings("lidar", samples)
    scales = [one.remedies[0]["lidars_3d"]["lidar"]["range_scale"] for one in found]
    assert scales == ([] if unit is None else [1.0 / unit]) and all(one.sure for one in found)


def test_what_repeats_itself_is_named() -> None:
    samples = CameraSamples()
    for stamp_s in STAMPS[:60]:
        samples.add(RgbdFrame(float(stamp_s), frame().color, frame().depth_m, LENS), compared=True)
    assert (samples.count, samples.repeats.count) == (60, 59)
    assert [one.kind for one in camera_findings("camera", samples, NO_WHEELS)] == ["repeated frames"]


def test_a_few_frames_that_repeat_are_named_where_the_wheels_drive_on() -> None:
    samples = CameraSamples()
    for number, stamp_s in enumerate(STAMPS[:60]):
        color = np.roll(frame().color, min(number, 40), axis=0)
        samples.add(RgbdFrame(float(stamp_s), color, frame().depth_m, LENS), compared=True)
    assert samples.repeats.count == 19 and not camera_findings("camera", samples, NO_WHEELS)
    (found,) = camera_findings("camera", samples, base_rows())
    assert (found.kind, found.sure) == ("repeated frames", True)


@pytest.mark.parametrize(
    ("stamps_s", "seeds", "left", "sure"),
    [
        ([0.0, 0.1, 0.2, 0.3], [0, 1, 1, 2], [0.0, 0.1, 0.3], True),
        ([0.0, 0.1, 0.1, 0.2], [0, 1, 2, 3], [0.0, 0.1, 0.2], True),
        ([5.0] * 4, [0, 1, 2, 3], [5.0], False),  # all of one stamp: the order of the log is left
    ],
)
def test_one_cloud_that_repeats_the_points_or_the_stamp_before_is_left_out(
    stamps_s: list[float], seeds: list[int], left: list[float], sure: bool
) -> None:
    log = [
        PointCloud(stamp_s, np.random.default_rng(seed).normal(size=(90, 3)).astype(np.float32))
        for stamp_s, seed in zip(stamps_s, seeds, strict=True)
    ]
    samples = CloudSamples()
    for cloud in log:
        samples.add(cloud)
    (found,) = (one for one in cloud_findings("lidar", samples) if one.kind == "repeated clouds")
    assert found.sure == sure
    mended = remedied(Calibration(), [found], only_sure=False)
    assert [one.stamp_s for one in corrected(log, mended)] == left


@pytest.mark.parametrize(("turn_s", "scale"), [(100.0, 0.001), (1e-7, 1e6), (9.8, 0.01), (0.2, 0.5)])
def test_times_of_points_that_cannot_be_are_named(turn_s: float, scale: float) -> None:
    samples = CloudSamples(count=50)
    for _ in range(50):
        samples.interval_s.add(0.1)
        samples.turn_s.add(turn_s)
    samples.close(compared=False)
    (finding,) = cloud_findings("lidar", samples)
    assert finding.remedies == ({"lidars_3d": {"lidar": {"times_scale": pytest.approx(scale)}}},)
    cloud = PointCloud(0.0, np.ones((2, 3), np.float32), np.array([0.0, turn_s]))
    (after,) = corrected([cloud], remedied(Calibration(), [finding], only_sure=True))
    assert isinstance(after, PointCloud) and after.times_s is not None
    assert after.times_s == pytest.approx([0.0, 0.1], rel=0.03)


def test_clouds_of_a_few_points_show_no_times() -> None:
    samples = CloudSamples()
    for n in range(60):
        count, rng = 1600 if n % 3 == 0 else 20, np.random.default_rng(n)
        points, times_s = rng.normal(size=(count, 3)).astype(np.float32), 1e-3 * (np.arange(count) // 16)
        samples.add(PointCloud(float(n), points, times_s))
    assert cloud_findings("lidar", samples) == []


def turns(stamps_s: list[float], turn_s: float) -> list[PointCloud]:
    times_s, rng = np.linspace(0.0, turn_s, 80), np.random.default_rng(3)
    return [PointCloud(one, rng.normal(size=(80, 3)).astype(np.float32), times_s) for one in stamps_s]


@pytest.mark.parametrize("apart_s", [0.03, 0.01])
def test_a_second_lidar_under_the_same_name_is_reported_and_left_out(apart_s: float) -> None:
    """Also where it starts so soon after the first as if times were ten times too long."""
    log = turns([0.1 * (n // 2) + apart_s * (n % 2) for n in range(80)], 0.1)
    (finding,) = [one for one in diagnose(log) if one.kind == "several lidars"]
    assert finding.text.startswith("40 of 80")
    left = list(corrected(log, remedied(Calibration(), [finding], only_sure=True)))
    assert [one.stamp_s for one in left] == [one.stamp_s for one in log[::2]]


@pytest.mark.parametrize(("turn_s", "step_s"), [(0.1, 0.1), (0.1, 0.05), (0.3, 0.1), (0.5, 0.1)])
def test_one_lidar_whose_turns_touch_or_overlap_is_one(turn_s: float, step_s: float) -> None:
    """Turns in two messages; windows of several turns that move on by one."""
    log = turns([step_s * n for n in range(80)], turn_s)
    assert not [one for one in diagnose(log) if one.kind == "several lidars"]


def test_the_floor_is_the_lowest_level_surface() -> None:
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(-2, 2, (300, 2)), rng.normal(-0.7, 0.01, 300)])
    table = np.column_stack([rng.uniform(-1, 1, (300, 2)), rng.normal(-0.2, 0.01, 300)])
    wall = rng.uniform([2.0, -2.0, -0.7], [2.1, 2.0, 1.5], (400, 3))
    up = np.array([0.0, 0.0, 1.0])
    assert floor_below_m(np.concatenate([floor, table, wall]), up) == pytest.approx(0.7, abs=0.02)
    assert floor_below_m(wall + np.array([0.0, 0.0, 2.0]), up) is None


def test_stretches_are_bounded_and_spread_over_a_long_log() -> None:
    for minutes in (1, 60):
        stretches, begun = Stretches(), []
        wanted = 0
        for stamp_s in np.arange(0.0, 60.0 * minutes, 0.05):
            if stretches.wants(float(stamp_s)):
                wanted += 1
                if stretches.begins:
                    begun.append(float(stamp_s))
        assert wanted < 2500
        assert begun[-1] > 0.7 * 60.0 * minutes


def test_motions_that_nothing_is_compared_with_are_not_sought() -> None:
    room, poses = furnished(), turning_walk(400)[:10]
    alone, beside_wheels = CameraSamples(), CameraSamples()
    for number, pose in enumerate(poses):
        alone.add(render(room, pose, stamp_s=0.1 * number), compared=False)
        beside_wheels.add(render(room, pose, stamp_s=0.1 * number), compared=True)
    assert [len(steps) for steps in alone.steps] == [0]
    assert [len(steps) for steps in beside_wheels.steps] == [9]
    assert 0 < len(alone.pairs) == len(beside_wheels.pairs)


def test_wheels_that_may_take_left_for_right_judge_no_camera() -> None:
    wheels, lidar = {"wheels": {"odometry": {"mirrored": True}}}, {"lidars": {"laser": {"upside_down": True}}}
    for remedies, known in (((lidar, wheels), False), ((wheels,), True), ((lidar,), True)):
        found = [Finding("laser", "mirrored", "", "", remedies)]
        rows = mended_rows("odometry", base_rows(), found)
        assert (rows is not None) == known
