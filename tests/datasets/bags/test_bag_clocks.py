"""Stamps that are none or of another clock, scans made of clouds, images of a region of the sensor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writing import START_S, Sent, cloud, image, info, odometry, scan, write_bag

from slam.datasets import open_dataset
from slam.datasets.bags.decoding import _built_in
from slam.errors import DatasetError
from slam.measurements import LaserScan, PointCloud, RgbdFrame
from slam.zstandard import zstd


def read(tmp_path: Path, sent: list[Sent], *topics: str) -> tuple[list[Any], Any]:
    dataset = open_dataset(write_bag(tmp_path / "log", "mcap", sent), topics=topics)
    return list(dataset), dataset


def late(sent: Sent, late_s: float) -> Sent:
    sent.late_s = late_s
    return sent


def test_where_a_driver_sets_no_stamps_the_recorders_clock_is_taken(tmp_path: Path) -> None:
    scans = [late(scan(stamp_s=0.0), START_S + 0.1 * n) for n in range(3)]
    found, dataset = read(tmp_path, [*scans, odometry(START_S)])
    stamps = [one.stamp_s for one in found if isinstance(one, LaserScan)]
    assert stamps == pytest.approx([START_S, START_S + 0.1, START_S + 0.2], abs=1e-6)
    assert any("recorder's clock is used" in text for text in dataset.report.warnings)


def test_a_clock_since_the_start_of_the_sensor_is_brought_to_the_others(tmp_path: Path) -> None:
    scans = [late(scan(stamp_s=100.0 + 0.1 * n), START_S - 100.0) for n in range(3)]
    wheels = [odometry(START_S + 0.1 * n) for n in range(3)]
    found, dataset = read(tmp_path, [sent for pair in zip(wheels, scans, strict=True) for sent in pair])
    stamps = [one.stamp_s for one in found if isinstance(one, LaserScan)]
    assert stamps == pytest.approx([START_S, START_S + 0.1, START_S + 0.2], abs=1e-3)
    (stated,) = dataset.report.warnings
    assert stated.startswith("/scan: its clock is") and "behind the other topics'" in stated


@pytest.mark.parametrize("behind_s", [20.0, -20.0])
def test_a_clock_seconds_off_is_brought_to_the_others(tmp_path: Path, behind_s: float) -> None:
    wheels = [late(odometry(START_S + 0.1 * n - behind_s), behind_s) for n in range(3)]
    found, dataset = read(
        tmp_path, [one for n in range(3) for one in (scan(stamp_s=START_S + 0.1 * n), wheels[n])]
    )
    stamps = sorted({round(one.stamp_s - START_S, 3) for one in found})
    assert stamps == pytest.approx([0.0, 0.1, 0.2], abs=1e-3)
    assert len(dataset.report.warnings) == 1


@pytest.mark.parametrize(("late_wheels_s", "late_scans_s"), [(0.25, 0.0), (0.0, 0.25), (1.25, 0.0)])
def test_what_arrives_late_comes_in_the_order_of_the_stamps(
    tmp_path: Path, late_wheels_s: float, late_scans_s: float
) -> None:
    sent = [late(odometry(START_S + 0.05 * n, 0.01 * n), late_wheels_s) for n in range(60)]
    sent += [late(scan(stamp_s=START_S + 0.1 * n), late_scans_s) for n in range(30)]
    sent.sort(key=lambda one: one.stamp_s + one.late_s)
    found, _ = read(tmp_path, sent)
    stamps_s = [one.stamp_s for one in found if one.stamp_s > START_S + 2.0 * late_wheels_s]
    assert len(stamps_s) > 10 and stamps_s == sorted(stamps_s)


def test_a_first_message_that_waited_is_no_other_clock(tmp_path: Path) -> None:
    sent = [late(scan(stamp_s=START_S), 20.0), *[scan(stamp_s=START_S + 20.0 + 0.1 * n) for n in range(3)]]
    found, dataset = read(tmp_path, [odometry(START_S + 20.0), *sent])
    assert min(one.stamp_s for one in found) == START_S and not dataset.report.warnings


def test_clocks_that_run_alike_stay_whatever_the_recorders_says(tmp_path: Path) -> None:
    sent = [late(one, 1e6) for one in (scan(), odometry(START_S))]
    found, dataset = read(tmp_path, sent)
    assert {one.stamp_s for one in found} == {START_S} and not dataset.report.warnings


def ring(frame: str) -> list[Sent]:
    around = np.linspace(-np.pi, np.pi, 100)
    columns = {"x": np.cos(around), "y": np.sin(around), "z": 0.1 * around}
    made = cloud({name: values.astype("<f4") for name, values in columns.items()}, topic="/points")
    made.frame = "lidar"
    return [made, scan(frame=frame)]


def test_a_scan_that_is_made_of_a_cloud_gives_way_to_it(tmp_path: Path) -> None:
    found, dataset = read(tmp_path, ring("lidar"))
    assert [type(one) for one in found] == [PointCloud]
    assert any("made of /points" in why for why in dataset.report.reasons.values())
    found, _ = read(tmp_path, ring("lidar"), "/scan")
    assert {type(one) for one in found} == {PointCloud, LaserScan}
    # A scanner of its own may have the same stamps, as a simulator gives them, but not the same place.
    found, _ = read(tmp_path, ring("laser"))
    assert {type(one) for one in found} == {PointCloud, LaserScan}


def test_images_of_a_region_of_the_sensor_have_their_own_centre(tmp_path: Path) -> None:
    roi = {"x_offset": 10, "y_offset": 4, "width": 64, "height": 48}
    sent = [
        info("/camera/depth/camera_info", 128, 96, 50.0, roi=roi),
        image("/camera/depth/image_raw", np.full((48, 64), 1000, np.uint16), "16UC1"),
        image("/camera/rgb/image_raw", np.zeros((48, 64, 3), np.uint8), "rgb8"),
    ]
    (frame,), _ = read(tmp_path, sent)
    assert isinstance(frame, RgbdFrame)
    assert (frame.intrinsics.cx, frame.intrinsics.cy) == (54.0, 44.0)
    assert (frame.intrinsics.width, frame.intrinsics.height) == (64, 48)


@pytest.mark.parametrize("kind", ["velodyne_msgs/msg/VelodyneScan", "realsense2_camera_msgs/msg/Extrinsics"])
def test_drivers_messages_are_known_without_a_definition_in_the_bag(kind: str) -> None:
    assert _built_in("cdr", kind) is not None


@pytest.mark.parametrize("kept", [1.0, 0.9])
def test_a_bag_that_was_compressed_as_a_whole_is_read_up_to_a_cut(tmp_path: Path, kept: float) -> None:
    noise = np.random.default_rng(0).uniform(1.0, 2.0, (200, 900))
    sent = [scan(stamp_s=START_S + k, angle_increment=0.002, ranges=row) for k, row in enumerate(noise)]
    file = write_bag(tmp_path / "log", "mcap", sent)
    packed = zstd.compress(file.read_bytes())
    file.unlink()
    file = tmp_path / "log.mcap.zstd"
    file.write_bytes(packed[: int(kept * len(packed))])
    log = open_dataset(file)
    count = len(list(log))
    assert count == len(sent) if kept == 1.0 else len(sent) / 2 < count < len(sent)
    assert (log.report.dropped_count > 0) == (kept < 1.0)


def test_a_file_that_is_not_compressed_although_its_name_says_so_is_refused(tmp_path: Path) -> None:
    packed = tmp_path / "log_0.mcap.zstd"
    packed.write_bytes(b"\x28\xb5\x2f\xfd" + bytes(100))
    with pytest.raises(DatasetError, match=r"mcap\.zstd does not begin as a bag"):
        list(open_dataset(packed))


def test_a_bag_that_was_unpacked_is_read_though_its_index_names_the_packed_file(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "log", "db3", [scan()])
    index = folder / "metadata.yaml"
    (file,) = folder.glob("*.db3")
    index.write_text(index.read_text().replace(file.name, f"{file.name}.zstd"))
    (folder / f"{file.name}.zstd").write_bytes(b"\x28\xb5\x2f\xfd" + bytes(100))
    assert len(list(open_dataset(folder))) == 1


def turns(late_s: float, first_s: float = 0.0) -> list[Sent]:
    """Clouds of 0.1 s whose points have times, recorded some time after their stamp."""
    count = 400
    angle = np.linspace(0.0, 6.28, count)
    columns = {"x": np.cos(angle), "y": np.sin(angle), "z": np.zeros(count), "t": first_s + angle / 62.8}
    columns = {name: column.astype(np.float32) for name, column in columns.items()}
    return [late(cloud(columns, START_S + 0.1 * n, "/points"), late_s + 1e-3 * (n % 2)) for n in range(25)]


@pytest.mark.parametrize(
    ("late_s", "first_s", "wheels_s", "off_s"),
    [
        (0.004, 0.0, 0.001, 0.1),  # stamped at the end
        (0.104, 0.0, 0.001, 0.0),
        (0.004, -0.1, 0.001, 0.0),  # times before the stamp
        (0.004, 0.0, -0.1, 0.0),  # the recorder's clock is behind
        (0.0, 0.0, 0.001, 0.0),  # a converted log
        (0.002, 0.0, 0.001, 0.0),  # another one: the record times are as even as the stamps
        (0.25, 0.0, 0.001, 0.0),
        (20.1, 0.0, 0.0, -20.0),  # another clock: the last point is what arrives
    ],
)
def test_a_cloud_does_not_arrive_before_its_last_point(
    tmp_path: Path, late_s: float, first_s: float, wheels_s: float, off_s: float
) -> None:
    sent = turns(late_s, first_s)
    if late_s in (0.0, 0.002):
        sent = [late(one, late_s) for one in sent]
    sent += [late(odometry(START_S + 0.05 * n, 0.01 * n), wheels_s) for n in range(50)]
    found, dataset = read(tmp_path, sorted(sent, key=lambda one: one.stamp_s + one.late_s))
    first = next(one for one in found if isinstance(one, PointCloud))
    assert START_S - first.stamp_s == pytest.approx(off_s, abs=2e-3)
    assert any("arrives before its last" in one for one in dataset.report.warnings) == (off_s > 0.0)


@pytest.mark.parametrize(
    ("unit", "beam_s"), [(1.0, 0.1 / 360), (1e3, 0.1 / 360), (1e-3, 0.1 / 360), (36.0, 0.01)]
)
def test_times_of_beams_in_another_unit_are_divided_by_it(tmp_path: Path, unit: float, beam_s: float) -> None:
    around = {"angle_increment": 2.0 * np.pi / 360, "time_increment": unit * 0.1 / 360}
    sent = [late(scan(stamp_s=START_S + 0.1 * n, **around), 0.11) for n in range(25)]
    found, dataset = read(tmp_path, sent)
    assert [one.beam_s for one in found] == pytest.approx([beam_s] * 25, rel=1e-5)
    assert any("time_increment" in text for text in dataset.report.warnings) == (unit in (1e3, 1e-3))
