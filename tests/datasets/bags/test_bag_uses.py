"""Every topic of a bag is used, or the reason is reported; a depth camera's cloud is no lidar."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writing import START_S, Sent, cloud, image, info, odometry, scan, transforms, write_bag
from numpy.typing import NDArray

from slam.datasets import open_dataset
from slam.datasets.bags.imu import NO_VALUES
from slam.datasets.inspection import inspect_dataset
from slam.evaluation.pages import inspection_text

COLOR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_raw"
OPTICAL = "camera_depth_optical_frame"


def points(seen: str) -> NDArray[np.float32]:
    """(N, 3) of a camera in its optical frame or its body's, or of a lidar all around."""
    rng = np.random.default_rng(1)
    ahead = rng.uniform(1.0, 4.0, 300)
    side, up = ahead * rng.uniform(-0.5, 0.5, 300), ahead * rng.uniform(-0.4, 0.4, 300)
    if seen == "around":
        angle = rng.uniform(-np.pi, np.pi, 300)
        return np.column_stack([ahead * np.cos(angle), ahead * np.sin(angle), up]).astype(np.float32)
    rows = [side, up, ahead] if seen == "optical" else [ahead, side, up]
    return np.column_stack(rows).astype(np.float32)


def clouds(seen: str, frame: str, late_s: float = 0.0, timed: bool = False, **fields: Any) -> list[Sent]:
    columns = dict(zip("xyz", points(seen).T.copy(), strict=True))
    if timed:
        columns["time"] = np.linspace(0.0, 0.1, len(columns["x"])).astype(np.float32)
    sent = [cloud(columns, START_S + 0.1 * k + late_s, "/depth/points", **fields) for k in range(30)]
    for one in sent:
        one.frame = frame
        one.fields["row_step"] = one.fields["point_step"] * one.fields["width"]
    return sent


def camera(space: str = "/camera") -> list[Sent]:
    color, depth = np.zeros((4, 6, 3), np.uint8), np.full((4, 6), 1000, np.uint16)
    topics = f"{space}/color/image_raw", f"{space}/depth/image_raw"
    sent = [info(f"{space}/color/camera_info", 6, 4)]
    for stamp_s in START_S + 0.1 * np.arange(30):
        sent += [image(topics[0], color, "rgb8", stamp_s), image(topics[1], depth, "16UC1", stamp_s)]
    return sent


def uses(folder: Path, sent: list[Sent], topics: tuple[str, ...] = ()) -> dict[str, tuple[str, int, str]]:
    bag = write_bag(folder / "log", "mcap", sorted(sent, key=lambda one: one.stamp_s))
    found = inspect_dataset(open_dataset(bag, topics=topics))["uses"]
    return {use["sensor"]: (use["kind"], use["readings"], use["why_not"]) for use in found}


@pytest.mark.parametrize(
    ("sent", "because"),
    [
        (clouds("optical", OPTICAL, 0.03), "its frame is"),
        (clouds("body", "optical", 0.03), "its frame is optical"),
        (clouds("around", OPTICAL, 0.03), "its frame is"),
        (clouds("body", "camera_link"), "its stamps are those of"),
        (clouds("optical", "camera_link", 0.03), "its view is along z"),
        (clouds("body", "camera_link", 0.03, height=4, width=75), "in the order of an image"),
    ],
)
def test_a_depth_cameras_cloud_is_no_lidar(tmp_path: Path, sent: list[Sent], because: str) -> None:
    found = uses(tmp_path, [*camera(), *sent])
    assert found["/camera"] == ("RGB-D camera", 30, "")
    kind, count, why_not = found["/depth/points"]
    assert (kind, count) == ("sensor_msgs/msg/PointCloud2", 30)
    assert because in why_not and "--topics /depth/points" in why_not


@pytest.mark.parametrize(
    "sent",
    [
        clouds("around", OPTICAL, timed=True),
        clouds("body", "livox_frame", 0.03),
        clouds("around", "lidar", height=4, width=75),
    ],
)
def test_a_lidar_beside_a_camera_is_one(tmp_path: Path, sent: list[Sent]) -> None:
    assert uses(tmp_path, [*camera(), *sent])["/depth/points"] == ("3D lidar", 30, "")


def test_a_cameras_cloud_is_read_where_it_is_named_or_all_there_is(tmp_path: Path) -> None:
    sent = clouds("optical", OPTICAL)
    assert uses(tmp_path, [*camera(), *sent], ("/depth/points",))["/depth/points"][2] == ""
    assert uses(tmp_path, sent)["/depth/points"] == ("3D lidar", 30, "")


def test_the_images_and_the_lens_of_a_camera_that_is_not_used_are_not_used(tmp_path: Path) -> None:
    found = uses(tmp_path, [*camera("/a"), *camera("/b")])
    used = {name for name, use in found.items() if not use[2]}
    assert used == {"/a", "/a/color/image_raw", "/a/depth/image_raw", "/a/color/camera_info"}
    assert found["/b/color/camera_info"][2] == found["/b/color/image_raw"][2] == found["/b"][2]


@pytest.mark.parametrize(("encoding", "channels"), [("rgb8", 3), ("mono8", 1)])
def test_pictures_of_depth_are_no_depth(tmp_path: Path, encoding: str, channels: int) -> None:
    picture = np.zeros((4, 6, channels), np.uint8)
    pictures = [image(DEPTH, picture, encoding, START_S + 0.1 * k) for k in range(30)]
    colors = [one for one in camera() if one.topic != DEPTH]
    scans = [scan(stamp_s=START_S + 0.1 * k) for k in range(30)]
    assert "record it as 16UC1 or 32FC1" in uses(tmp_path, [*colors, *pictures, *scans])[DEPTH][2]


def test_every_topic_is_reported(tmp_path: Path) -> None:
    imu = [Sent("/imu", "sensor_msgs/msg/Imu", START_S + 0.1 * k, {}, "imu") for k in range(5)]
    scans = [scan(stamp_s=START_S + 0.1 * k) for k in range(30)]
    wheels = [odometry(START_S + 0.1 * k) for k in range(31)]
    infra = image("/camera/infra1/image_rect_raw", np.zeros((4, 6), np.uint8), "mono8")
    broken = [image("/eye/image_raw", np.zeros((4, 6, 3), np.uint8), "rgb8")]
    lidar = clouds("around", "lidar")
    sent = [*camera(), infra, *imu, *scans, *wheels, *broken, *lidar, transforms({})]
    found = uses(tmp_path, sent)
    assert {name for name, use in found.items() if not use[2]} == {
        *("/camera", COLOR, DEPTH, "/camera/color/camera_info", "/scan", "/odom", "/tf_static")
    }
    assert found["/imu"] == ("sensor_msgs/msg/Imu", 5, NO_VALUES)
    assert "no depth beside it" in found["/eye/image_raw"][2]
    assert "another image topic" in found["/camera/infra1/image_rect_raw"][2]
    assert "sensors.motion=spatial" in found["/depth/points"][2]
    text = inspection_text(inspect_dataset(open_dataset(tmp_path / "log.mcap")))
    assert f"not used, because {NO_VALUES}: /imu (sensor_msgs/msg/Imu, 5)" in text


def test_a_topic_of_which_nothing_could_be_read_is_not_used(tmp_path: Path) -> None:
    damaged = [scan(ranges=[], stamp_s=START_S + 0.1 * k) for k in range(3)]
    found = uses(tmp_path, [*damaged, odometry(START_S), odometry(START_S + 0.3)])
    assert found["/scan"][1:] == (3, "none of its messages could be read")
