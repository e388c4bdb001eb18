"""Bags as the drivers of cameras and lidars record them, and as robots that carry several."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bag_writing import (
    START_S,
    Sent,
    image,
    info,
    packed_image,
    png,
    scan,
    transforms,
    write_bag,
)

from slam.datasets import open_dataset
from slam.datasets.bags.clouds import CloudReader
from slam.datasets.bags.decoding import Decoder
from slam.datasets.bags.records import BagRecord, Channel
from slam.datasets.budget import Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.inspection import inspect_dataset
from slam.measurements import GnssFix, PointCloud

RNG = np.random.default_rng(3)
DEPTH = np.full((48, 64), 20_000, np.uint16)
GREY_RAMP = np.tile(np.arange(0, 256, 2, dtype=np.uint8)[None, :], (72, 1))
NATIVE = "/device_0/sensor_"


def read(tmp_path: Path, sent: list[Sent], *topics: str, writer: str = "mcap") -> tuple[list[Any], Any]:
    dataset = open_dataset(write_bag(tmp_path / "log", writer, sent), topics=topics)
    return list(dataset), dataset


def native() -> list[Sent]:
    """A recording of librealsense: another aspect, another unit, colour 5 cm beside depth."""
    shift = {"translation": {"x": -0.05}, "rotation": {"w": 1.0}}
    ramp = np.repeat(GREY_RAMP[..., None], 3, axis=2)
    return [
        info(f"{NATIVE}0/Depth_0/info/camera_info", 64, 48, 50.0, frame="0"),
        info(f"{NATIVE}0/Infrared_1/info/camera_info", 64, 48, 50.0, frame="0"),
        info(f"{NATIVE}1/Color_0/info/camera_info", 128, 72, 80.0, frame="0"),
        Sent(f"{NATIVE}0/option/Depth_Units/value", "std_msgs/msg/Float32", START_S, {"data": 0.0001}),
        Sent(f"{NATIVE}1/Color_0/tf/0", "geometry_msgs/msg/Transform", START_S, shift),
        image(f"{NATIVE}0/Infrared_1/image/data", DEPTH.astype(np.uint8), "8UC1", frame="0"),
        image(f"{NATIVE}0/Depth_0/image/data", DEPTH, "mono16", frame="0"),
        image(f"{NATIVE}1/Color_0/image/data", ramp, "rgb8", frame="0"),
    ]


def test_a_recording_of_librealsense_has_its_unit_its_lenses_and_its_colour_in_place(tmp_path: Path) -> None:
    (frame,), dataset = read(tmp_path, native(), writer="bag")
    assert np.allclose(frame.depth_m, 2.0)
    assert (frame.intrinsics.width, frame.intrinsics.fx) == (64, 50.0)
    column = np.arange(64)
    wanted = 2.0 * (64.0 + 80.0 * ((column - 32.0) / 50.0 - 0.05 / 2.0))
    inside = (wanted > 4.0) & (wanted < 250.0)
    assert inside.sum() > 50
    assert np.abs(frame.color[20, :, 0] - wanted)[inside].max() <= 2.0
    assert any("depth unit is 0.0001 m" in note for note in dataset.report.notes)
    why = dataset.report.reasons
    assert not any("Units" in name or "/tf/" in name for name in why)
    assert any("Infrared" in name for name in why)


def test_the_extrinsics_message_places_colour_and_tf_that_says_otherwise_is_reported(tmp_path: Path) -> None:
    turned = gtsam.Rot3.Rz(0.1).matrix()
    placed = {"rotation": turned.T.ravel(), "translation": [-0.05, 0.0, 0.0]}
    kind = "realsense2_camera_msgs/msg/Extrinsics"
    sent = [
        Sent("/camera/extrinsics/depth_to_color", kind, START_S, placed),
        info("/camera/color/camera_info", 128, 72, 80.0, frame="color"),
        info("/camera/depth/camera_info", 64, 48, 50.0, frame="depth"),
        image("/camera/color/image_raw", np.zeros((72, 128, 3), np.uint8), "rgb8", frame="color"),
        image("/camera/depth/image_rect_raw", DEPTH, "16UC1", frame="depth"),
    ]
    _, dataset = read(tmp_path, sent)
    opened: Any = dataset
    (camera,) = opened._open()[2].cameras
    T_color_depth = camera.T_depth_color.inverse()
    assert np.allclose(T_color_depth.rotation().matrix(), turned)  # column by column in the message
    assert np.allclose(T_color_depth.translation(), [-0.05, 0.0, 0.0])
    assert any("0.050 m from depth by /camera/extrinsics" in note for note in dataset.report.notes)
    other = transforms({"color": gtsam.Pose3(gtsam.Rot3(), np.array([0.02, 0, 0]))}, parent="depth")
    _, dataset = read(tmp_path, [other, *sent])
    (stated,) = [note for note in dataset.report.notes if note.startswith("warning")]
    assert "0.050 0.005" in stated.replace("-", "") and "0.020 0.000 0.000 m by tf" in stated


def test_extrinsics_are_those_of_their_own_camera(tmp_path: Path) -> None:
    sent = []
    for name, x in (("/robot/left", 0.01), ("/robot/right", 0.02)):
        placed = {"rotation": np.eye(3).ravel(), "translation": [-x, 0.0, 0.0]}
        kind = "realsense2_camera_msgs/msg/Extrinsics"
        sent += [
            Sent(f"{name}/extrinsics/depth_to_color", kind, START_S, placed),
            info(f"{name}/color/camera_info", 64, 48, 50.0, frame=f"{name}_color"),
            info(f"{name}/depth/camera_info", 64, 48, 50.0, frame=f"{name}_depth"),
            image(f"{name}/color/image_raw", COLOR, "rgb8", frame=f"{name}_color"),
            image(f"{name}/depth/image_rect_raw", DEPTH, "16UC1", frame=f"{name}_depth"),
        ]
    _, dataset = read(tmp_path, sent)
    opened: Any = dataset
    found = {camera.sensor: camera.T_depth_color.x() for camera in opened._open()[2].cameras}
    assert found == {"/robot/left": pytest.approx(0.01), "/robot/right": pytest.approx(0.02)}


def test_depth_that_the_driver_has_registered_stays_where_it_is(tmp_path: Path) -> None:
    ramp = np.repeat(GREY_RAMP[..., None], 3, axis=2)[:48, :64]
    placed = {"rotation": np.eye(3).ravel(), "translation": [-0.05, 0.0, 0.0]}
    sent = [
        Sent("/camera/extrinsics/depth_to_color", "realsense2_camera_msgs/msg/Extrinsics", START_S, placed),
        info("/camera/color/camera_info", 64, 48, 50.0, frame="color"),
        info("/camera/aligned_depth_to_color/camera_info", 64, 48, 50.0, frame="color"),
        image("/camera/color/image_raw", ramp, "rgb8", frame="color"),
        image("/camera/aligned_depth_to_color/image_raw", DEPTH, "16UC1", frame="color"),
    ]
    (frame,), _ = read(tmp_path, sent)
    assert (frame.color == ramp).all()


@pytest.mark.parametrize("writer", ["bag", "mcap"])
def test_livox_messages_are_clouds_with_times(tmp_path: Path, writer: str) -> None:
    points = [
        {
            "offset_time": 25_000_000 * n,
            "x": 1.0 + n,
            "y": 2.0,
            "z": 0.5,
            "reflectivity": 9,
            "tag": 1,
            "line": n,
        }
        for n in range(5)
    ]
    fields = {"timebase": 7, "point_num": 5, "points": points}
    kind = "livox_ros_driver2/msg/CustomMsg"
    (found,), dataset = read(
        tmp_path, [Sent("/livox/lidar", kind, START_S, fields, "livox_frame")], writer=writer
    )
    assert isinstance(found, PointCloud) and found.stamp_s == START_S
    assert np.allclose(found.points_lidar, [[1.0 + n, 2.0, 0.5] for n in range(5)])
    assert found.times_s is not None and np.allclose(found.times_s, 0.025 * np.arange(5))
    assert dataset.report.dropped_count == 0


COLOR = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)


def packed_yuv(order: str) -> np.ndarray:
    """An image of one colour, two bytes a pixel."""
    y, u, v = 120, 90, 200
    pair = {"yuyv": (y, u, y, v), "uyvy": (u, y, v, y)}[order]
    return np.tile(np.array(pair, np.uint8).reshape(1, 2, 2), (48, 32, 1))


@pytest.mark.parametrize(
    ("pixels", "encoding", "height"),
    [
        (packed_yuv("yuyv"), "yuv422_yuy2", 48),
        (packed_yuv("yuyv"), "yuyv", 48),
        (packed_yuv("uyvy"), "yuv422", 48),
        (packed_yuv("uyvy"), "UYVY", 48),
        (np.vstack([np.full((48, 64), 120), np.tile([90, 200], (24, 32))]).astype(np.uint8), "nv12", 48),
        (np.vstack([np.full((48, 64), 120), np.tile([200, 90], (24, 32))]).astype(np.uint8), "nv21", 48),
    ],
)
def test_yuv_is_one_colour_whatever_its_order(
    tmp_path: Path, pixels: np.ndarray, encoding: str, height: int
) -> None:
    color = image("/camera/color/image_raw", pixels, encoding)
    color.fields["height"] = height
    (frame,), _ = read(tmp_path, [color, image("/camera/depth/image", DEPTH, "16UC1")])
    # BT.601: R = 1.164 (Y - 16) + 1.596 (V - 128), G and B alike.
    red, green, blue = 236, 77, 44
    assert np.abs(frame.color.reshape(-1, 3).astype(int) - (red, green, blue)).max() <= 3


@pytest.mark.parametrize("bits", ["8", "16"])
def test_a_mosaic_and_wide_grey_are_colour(tmp_path: Path, bits: str) -> None:
    mosaic = np.zeros((48, 64), f"u{int(bits) // 8}")
    mosaic[::2, ::2] = 200 << (int(bits) - 8)  # red alone
    color = image("/camera/color/image_raw", mosaic, f"bayer_rggb{bits}")
    (frame,), _ = read(tmp_path, [color, image("/camera/depth/image", DEPTH, "16UC1")])
    assert tuple(frame.color[20, 20]) == (200, 0, 0)


def test_infrared_of_16_bits_is_no_depth(tmp_path: Path) -> None:
    sent = [
        image("/rgb/image_raw", COLOR, "rgb8", frame="rgb_camera_link"),
        image("/rgb_to_depth/image_raw", COLOR, "rgb8", frame="depth_camera_link"),
        image("/depth/image_raw", DEPTH, "16UC1", frame="depth_camera_link"),
        image("/depth_to_rgb/image_raw", DEPTH, "16UC1", frame="rgb_camera_link"),
        image("/ir/image_raw", DEPTH, "mono16", frame="depth_camera_link"),
        info("/rgb/camera_info", 64, 48, 50.0, frame="rgb_camera_link"),
        info("/depth_to_rgb/camera_info", 64, 48, 50.0, frame="rgb_camera_link"),
    ]
    (frame,), dataset = read(tmp_path, sent)
    opened: Any = dataset
    assert set(opened._open()[2].images) == {"/rgb/image_raw", "/depth_to_rgb/image_raw"}
    assert np.allclose(frame.depth_m, 20.0)
    assert not any("from depth" in note for note in dataset.report.notes)


def test_a_grey_png_of_16_bits_is_depth_whatever_its_format_says(tmp_path: Path) -> None:
    sent = [image("/a/rgb", COLOR, "rgb8"), packed_image("/a/depth/compressed", png(DEPTH), "png")]
    (frame,), _ = read(tmp_path, sent)
    assert np.allclose(frame.depth_m, 20.0)


def velodyne_scan() -> Sent:
    """A turn of a VLP-16 that sees a wall 5 m away all around."""
    packets = []
    for number in range(75):
        blocks = b""
        for block in range(12):
            azimuth = round((number * 12 + block) * 0.4 * 100) % 36000
            returns = np.zeros(32, [("away", "<u2"), ("light", "u1")])
            returns["away"], returns["light"] = 2500, 10
            blocks += b"\xff\xee" + azimuth.to_bytes(2, "little") + returns.tobytes()
        data = blocks + round(number * 1333).to_bytes(4, "little") + b"\x37\x22"
        at_ns = round((START_S + number * 0.001333) * 1e9)
        stamp = {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}
        packets.append({"stamp": stamp, "data": np.frombuffer(data, np.uint8)})
    return Sent(
        "/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", START_S + 0.1, {"packets": packets}, "v"
    )


def test_packets_of_a_velodyne_are_a_cloud(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    (found,), dataset = read(tmp_path, [velodyne_scan()])
    assert isinstance(found, PointCloud) and found.stamp_s == pytest.approx(START_S, abs=1e-3)
    assert np.linalg.norm(found.points_lidar, axis=1) == pytest.approx(5.0, abs=0.05)
    assert np.ptp(np.arcsin(found.points_lidar[:, 2] / 5.0)) == pytest.approx(np.radians(30.0), abs=0.02)
    assert found.times_s is not None and np.ptp(found.times_s) == pytest.approx(0.1, abs=0.005)
    assert dataset.report.dropped_count == 0


def test_without_the_extra_the_command_that_installs_it_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    bag = write_bag(tmp_path / "log", "mcap", [velodyne_scan()])
    refusal = inspect_dataset(open_dataset(bag))["refusal"]
    assert r"pip install 'scanweave[velodyne]'" in refusal


def test_packets_that_are_damaged_are_counted(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    bad = velodyne_scan()
    for packet in bad.fields["packets"]:
        packet["data"] = np.zeros(1206, np.uint8)
    found, dataset = read(tmp_path, [bad, scan()])
    assert len(found) == 1 and dataset.report.dropped_count == 1


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
def test_damaged_livox_messages_are_counted(tmp_path: Path, wire: str) -> None:
    rng = np.random.default_rng(4)
    channel = Channel("/l", "livox_ros_driver2/msg/CustomMsg", wire)
    decoder, refused = Decoder(Budget(10**9)), 0
    for size in range(0, 400, 2):
        content = rng.integers(0, 256, size, dtype=np.uint8).tobytes()
        try:
            message = decoder.decode(BagRecord(1, channel, 1.0, content))
            CloudReader("/l", gtsam.Pose3()).read(message)
        except RecordFault:
            refused += 1
    assert refused > 150


def test_fixes_of_a_satellite_receiver_are_read_and_those_without_one_counted(tmp_path: Path) -> None:
    def fix(stamp_s: float, status: int = 0, known: int = 2, **place: float) -> Sent:
        fields = {
            "latitude": 49.0,
            "longitude": 8.4,
            "altitude": 116.0,
            "status": {"status": status},
            **place,
        }
        fields |= {
            "position_covariance": [4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0],
            "position_covariance_type": known,
        }
        return Sent("/gps/fix", "sensor_msgs/msg/NavSatFix", START_S + stamp_s, fields, "antenna")

    antenna = transforms({"antenna": gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.2, 1.0]))})
    sent = [antenna, scan(), fix(0.1), fix(0.2, known=0), fix(0.3, status=-1), fix(0.4, latitude=np.nan)]
    dataset = open_dataset(write_bag(tmp_path / "log", "bag", sent))
    first, second = (one for one in dataset if isinstance(one, GnssFix))
    assert (first.latitude_deg, first.longitude_deg, first.altitude_m) == (49.0, 8.4, 116.0)
    assert first.covariance_m2 is not None
    assert np.diag(first.covariance_m2).tolist() == [4.0, 4.0, 9.0]
    assert first.antenna_m is not None
    assert first.antenna_m.tolist() == [0.1, 0.2, 1.0]
    assert second.covariance_m2 is None
    assert dataset.report.dropped["GNSS message without a fix"].count == 2
    (stated,) = (one for one in inspect_dataset(dataset)["sensors"] if one["gnss"])
    assert stated["gnss"]["first"] == [49.0, 8.4, 116.0]
    assert stated["gnss"]["median_sigma_m"] == 2.0
