"""Scans, clouds, wheels and mounts of bags."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
from bag_writing import ECHOES, START_S, Sent, cloud, odometry, scan, transforms, write_bag

from slam.datasets import open_dataset
from slam.datasets.bags.clouds import BAD_LAYOUT, NO_POINTS
from slam.datasets.bags.decoding import BAD_STAMP
from slam.datasets.bags.laser import BAD_ANGLES, NO_VALID_RANGE, ZERO_BEAMS
from slam.datasets.dataset import Dataset
from slam.errors import BadRecordError, DatasetError
from slam.measurements import LaserScan, Measurement, PointCloud, WheelOdometry

XYZ = {name: np.array([1.0, 2.0, 3.0, math.nan, 0.0], "<f4") for name in "xyz"}


def read(path: Path, *sent: Sent, writer: str = "mcap") -> tuple[list[Measurement], Dataset]:
    dataset = open_dataset(write_bag(path / "log", writer, list(sent)))
    return list(dataset), dataset


def test_no_return_and_invalid_readings_are_distinguished(tmp_path: Path) -> None:
    ranges = [0.05, 1.0, math.inf, math.nan, 8.0]
    (found,), _ = read(tmp_path, scan(ranges=ranges))
    assert isinstance(found, LaserScan)
    assert np.isnan(found.ranges_m[[0, 3]]).all() and np.isinf(found.ranges_m[[2, 4]]).all()
    assert found.ranges_m[1] == 1.0


def test_a_minimum_in_millimetres_beside_a_maximum_in_metres_takes_no_reading(tmp_path: Path) -> None:
    (found,), _ = read(tmp_path, scan(ranges=[0.5, 1.0, math.inf], range_min=50.0))
    assert isinstance(found, LaserScan)
    assert found.ranges_m.tolist() == [0.5, 1.0, math.inf]


def test_of_several_echoes_the_nearest_valid_one_is_taken(tmp_path: Path) -> None:
    fields = dict(scan().fields)
    fields["ranges"] = [
        {"echoes": beam} for beam in ([2.0, 1.0], [], [math.nan, 3.0], [0.0, 4.0, 5.0], [7.0])
    ]
    (found,), _ = read(tmp_path, Sent("/echoes", ECHOES, START_S, fields, "laser"))
    assert isinstance(found, LaserScan)
    assert found.ranges_m[[0, 2, 3, 4]].tolist() == [1.0, 3.0, 4.0, 7.0] and np.isnan(found.ranges_m[1])


@pytest.mark.parametrize(
    ("mounted", "fields"),
    [
        (gtsam.Rot3.Rx(math.pi), {}),
        (gtsam.Rot3(), {"angle_min": 0.5, "angle_max": -0.5, "angle_increment": -0.25}),
    ],
    ids=["upside down", "clockwise"],
)
def test_beams_are_counter_clockwise_seen_from_above(
    tmp_path: Path, mounted: gtsam.Rot3, fields: dict[str, float]
) -> None:
    fields["time_increment"] = 0.03125
    (found,), _ = read(tmp_path, transforms({"laser": gtsam.Pose3(mounted, np.zeros(3))}), scan(**fields))
    assert isinstance(found, LaserScan)
    assert found.ranges_m.tolist() == [5.0, 4.0, 3.0, 2.0, 1.0]
    assert (found.start_angle_rad, found.step_rad, found.beam_s) == (-0.5, 0.25, -0.03125)


@pytest.mark.parametrize(
    ("fields", "stamp_s", "reason"),
    [
        ({"ranges": []}, START_S, ZERO_BEAMS),
        ({"ranges": [math.nan] * 3}, START_S, NO_VALID_RANGE),
        ({"angle_increment": 3.0}, START_S, BAD_ANGLES),
        ({"angle_increment": math.nan}, START_S, BAD_ANGLES),
        ({"angle_increment": 0.0}, START_S, BAD_ANGLES),
        ({}, 0.0, BAD_STAMP),
    ],
)
def test_a_scan_that_cannot_be_is_counted(
    tmp_path: Path, fields: dict[str, object], stamp_s: float, reason: str
) -> None:
    bad = scan(stamp_s=stamp_s, **fields)
    found, dataset = read(tmp_path, scan(), bad, scan(stamp_s=START_S + 1.0))
    assert len(found) == 2
    assert {why: tally.count for why, tally in dataset.report.dropped.items()} == {reason: 1}
    with pytest.raises(BadRecordError, match="without --strict"):
        list(open_dataset(dataset.path, strict=True))


NS, S = 1_700_000_000_000_000_000, 1_700_000_000.0


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("t", np.array([0, 25, 50, 75, 100], "<u4") * 1_000_000, "nanoseconds after"),
        ("time", np.array([-0.1, -0.075, -0.05, -0.025, 0.0], "<f4"), "seconds after"),
        ("timestamp", S + np.array([0.0, 0.025, 0.05, 0.075, 0.1]), "seconds by a clock"),
        ("timestamp", NS + np.array([0.0, 0.025, 0.05, 0.075, 0.1]) * 1e9, "nanoseconds by a clock"),
        ("offset_time", np.array([0, 25, 50, 75, 100], "<u4") * 1000, "microseconds after"),
        ("ts", np.array([0.0, 25.0, 50.0, 75.0, 100.0], "<f4"), "milliseconds after"),
        ("timestamp", 5e6 + np.array([0.0, 0.025, 0.05, 0.075, 0.1]), "seconds by a clock"),
        ("timestamp", 1e3 + np.array([0.0, 0.025, 0.05, 0.075, 0.1]), "seconds by a clock"),
        ("stamp", S + np.array([0.0, 0.025, 0.05, 0.075, 0.1]), "seconds by a clock"),
        ("time_offset_ns", np.array([0, 25, 50, 75, 100], "<i4") * 1_000_000, "nanoseconds after"),
    ],
)
def test_times_of_points_are_found_by_name_and_their_unit_by_the_turn(
    tmp_path: Path, name: str, values: np.ndarray, said: str
) -> None:
    (found,), dataset = read(tmp_path, cloud({**XYZ, "intensity": XYZ["x"], name: values}))
    assert isinstance(found, PointCloud) and found.times_s is not None
    assert found.points_lidar.tolist() == [[1, 1, 1], [2, 2, 2], [3, 3, 3]]  # without NaN and the origin
    assert found.intensities is not None and found.intensities.tolist() == [1, 2, 3]
    start_s = -0.1 if name == "time" else 0.0
    assert found.times_s == pytest.approx(start_s + np.array([0.0, 0.025, 0.05]), abs=1e-6)
    assert any(said in note and f"field {name} " in note for note in dataset.report.notes)


def test_a_time_field_without_values_does_not_hide_another(tmp_path: Path) -> None:
    times = S + np.array([0.0, 0.025, 0.05, 0.075, 0.1])
    (found,), dataset = read(tmp_path, cloud({**XYZ, "t": np.zeros(5, "<u4"), "timestamp": times}))
    assert isinstance(found, PointCloud) and found.times_s == pytest.approx([0.0, 0.025, 0.05], abs=1e-6)
    assert any("field timestamp" in note for note in dataset.report.notes)


@pytest.mark.parametrize(
    "values", [np.full(5, 7.0), np.array([0.0, 1.0, math.nan, 2.0, 3.0]), np.arange(5) * 1e-9]
)
def test_times_that_are_none_are_not_used_and_that_is_said(tmp_path: Path, values: np.ndarray) -> None:
    (found,), dataset = read(tmp_path, cloud({**XYZ, "t": values}))
    assert isinstance(found, PointCloud) and found.times_s is None
    assert any("not used" in note for note in dataset.report.notes)


def test_clouds_of_several_rows_with_padding_and_of_doubles_are_read(tmp_path: Path) -> None:
    packed = cloud({name: np.arange(1.0, 7.0).astype("<f8") for name in "xyz"})
    step = packed.fields["point_step"]
    rows = np.pad(packed.fields["data"].reshape(2, 3 * step), ((0, 0), (0, 5)))
    packed.fields |= {"height": 2, "width": 3, "row_step": rows.shape[1], "data": rows}
    (found,), _ = read(tmp_path, packed)
    assert isinstance(found, PointCloud) and found.points_lidar[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert found.times_s is None
    for row_step in (0, step, 6 * step):  # as drivers write it that do not use it
        data = rows[:, : 3 * step].copy()
        packed.fields |= {"row_step": row_step, "data": data}
        (found,), _ = read(tmp_path, packed)
        assert isinstance(found, PointCloud) and found.points_lidar[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    swapped = cloud({name: np.arange(1.0, 7.0).astype(">f4") for name in "xyz"})
    (found,), _ = read(tmp_path, swapped)
    assert isinstance(found, PointCloud) and found.points_lidar[:, 2].tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"point_step": 5}, BAD_LAYOUT),
        ({"width": 10**6}, BAD_LAYOUT),
        ({"fields": []}, BAD_LAYOUT),
        ({"data": np.zeros(500), "width": 1}, NO_POINTS),
        ({"is_bigendian": True}, NO_POINTS),  # which it is not
    ],
)
def test_a_cloud_that_cannot_be_is_counted(tmp_path: Path, change: dict[str, object], reason: str) -> None:
    bad = cloud(XYZ, START_S + 0.1)
    bad.fields |= change
    found, dataset = read(tmp_path, cloud(XYZ), bad)
    assert len(found) == 1 and dataset.report.dropped[reason].count == 1


def test_a_mount_is_a_chain_of_transforms_and_the_robot_is_what_the_wheels_move(tmp_path: Path) -> None:
    base, tower = (
        gtsam.Pose3(gtsam.Rot3(), np.array([0, 0, 0.1])),
        gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([1, 0, 0])),
    )
    found, _ = read(
        tmp_path,
        transforms({"base_link": base}, "base_footprint"),
        transforms({"/tower": tower}, "/base_link"),
        transforms({"laser": tower}, "tower"),
        odometry(START_S),
        scan(stamp_s=START_S + 0.1),
    )
    laser = found[-1]
    assert isinstance(laser, LaserScan)
    assert laser.T_base_laser.equals(gtsam.Pose2(1.0 + math.cos(0.5), math.sin(0.5), 1.0), 1e-9)


def test_without_transforms_the_mount_is_noted_and_an_upright_laser_is_refused(tmp_path: Path) -> None:
    _, dataset = read(tmp_path, scan())
    assert any("no tf in the bag" in note for note in dataset.report.notes)
    _, dataset = read(tmp_path, transforms({"camera": gtsam.Pose3()}), scan())
    assert any("does not connect laser with base_link" in note for note in dataset.report.notes)
    with pytest.raises(DatasetError, match="nearly vertical"):
        read(tmp_path, transforms({"laser": gtsam.Pose3(gtsam.Rot3.Pitch(1.5), np.zeros(3))}), scan())


@pytest.mark.parametrize(("tilt_deg", "stated"), [(20.0, "6% too long"), (3.0, "")])
def test_a_laser_that_tf_tilts_is_reported(tmp_path: Path, tilt_deg: float, stated: str) -> None:
    tilted = gtsam.Pose3(gtsam.Rot3.Pitch(math.radians(tilt_deg)), np.zeros(3))
    _, dataset = read(tmp_path, transforms({"laser": tilted}), scan())
    assert any(stated in one for one in dataset.report.warnings) if stated else not dataset.report.warnings


def test_a_joint_that_moves_is_noted_but_the_way_of_the_robot_is_no_joint(tmp_path: Path) -> None:
    def step(parent: str, child: str, k: int) -> Sent:
        pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * k, 0.0, 0.0]))
        return transforms({child: pose}, parent, "/tf", START_S + 0.1 * k)

    for moving, noted in ((("odom", "base_link"), False), (("base_link", "laser"), True)):
        still = ("base_link", "laser") if moving[0] == "odom" else ("odom", "base_link")
        sent = [step(*moving, k) for k in range(4)]
        _, dataset = read(tmp_path, transforms({still[1]: gtsam.Pose3()}, still[0]), scan(), *sent)
        list(dataset)
        assert any("moves on the robot" in note for note in dataset.report.notes) == noted


def test_without_odometry_the_wheels_come_from_tf(tmp_path: Path) -> None:
    sent = [
        transforms(
            {"base_link": gtsam.Pose3(gtsam.Rot3.Yaw(0.1 * k), np.array([k, 0.0, 0.0]))},
            "odom",
            "/tf",
            START_S + k,
        )
        for k in range(3)
    ]
    found, dataset = read(tmp_path, *sent, writer="bag")
    assert [type(m) for m in found] == [WheelOdometry] * 3
    assert isinstance(found[2], WheelOdometry) and found[2].T_odom_base.equals(
        gtsam.Pose2(2.0, 0.0, 0.2), 1e-9
    )
    assert any("wheels from tf, odom to base_link" in note for note in dataset.report.notes)
