"""Which topics of a bag are read, and what is reported of them."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from bag_writing import START_S, Sent, image, odometry, scan, transforms, write_bag
from typer.testing import CliRunner

from slam.cli.app import topics_of, topics_override
from slam.config import load_config
from slam.datasets import open_dataset
from slam.datasets.bags.topics import choose
from slam.datasets.inspection import inspect_dataset
from slam.errors import DatasetError
from slam.evaluation.pages import inspection_text

IMAGE = "sensor_msgs/msg/Image"
REALSENSE = {
    "/camera/color/image_raw": False,
    "/camera/depth/image_rect_raw": True,
    "/camera/aligned_depth_to_color/image_raw": True,
    "/camera/infra1/image_rect_raw": False,
}


def two_lasers() -> list[Sent]:
    front = [scan("/front", START_S + 0.1 * k) for k in range(3)]
    return [*front, scan("/rear", START_S), odometry(START_S), odometry(START_S + 0.2)]


def test_of_two_lasers_without_tf_the_wider_view_is_read_and_both_where_they_are_named(
    tmp_path: Path,
) -> None:
    bag = write_bag(tmp_path / "log", "mcap", two_lasers())
    dataset = open_dataset(bag)
    assert {m.sensor for m in dataset} == {"/front", "/odom"}
    stated = dataset.report.reasons["/rear (sensor_msgs/msg/LaserScan)"]
    assert stated.startswith("/front is read") and "--topics /rear" in stated
    chosen = open_dataset(bag, topics=["/rear"])
    assert {m.sensor for m in chosen} == {"/rear", "/odom"}  # the wheels were no question
    assert chosen.report.reasons["/front (sensor_msgs/msg/LaserScan)"] == "--topics names others of its kind"
    assert {m.sensor for m in open_dataset(bag, topics=["/front", "/rear"])} == {"/front", "/rear", "/odom"}


def test_of_two_lasers_the_one_whose_mounting_tf_shows_is_read(tmp_path: Path) -> None:
    mount = transforms({"rear_laser": gtsam.Pose3()})
    sent = [scan("/front"), scan("/rear", frame="rear_laser", ranges=[1.0, 2.0]), mount]
    assert [m.sensor for m in open_dataset(write_bag(tmp_path / "log", "mcap", sent))] == ["/rear"]


def test_topics_that_are_not_there_or_not_read_are_reported(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "log", "db3", [*two_lasers(), transforms({"laser": gtsam.Pose3()})])
    with pytest.raises(DatasetError, match=r"no topic /scan; it holds /front \(LaserScan, 3 messages\)"):
        list(open_dataset(bag, topics=["/scan"]))
    with pytest.raises(DatasetError, match="TFMessage, which is not read"):
        list(open_dataset(bag, topics=["/tf_static"]))
    log = tmp_path / "a.log"
    log.write_text("ODOM 0 0 0 0 0 0 1 h 1\n")
    with pytest.raises(DatasetError, match="no topics; leave out --topics"):
        open_dataset(log, topics=["/scan"])


def test_the_option_becomes_a_setting_that_the_map_keeps() -> None:
    assert topics_of(["/a, /b", "/a"]) == ("/a", "/b")
    assert load_config(None, topics_override(["/a,/b"])).sensors.topics == ("/a", "/b")
    assert topics_override(None) == []


@pytest.mark.parametrize(
    ("topics", "wanted"),
    [
        (REALSENSE, ("/camera", "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw")),
        (
            {"/camera/rgb/image_color": False, "/camera/depth/image": True},
            ("/camera", "/camera/rgb/image_color", "/camera/depth/image"),
        ),
        (
            {"/rgb/image_raw": False, "/depth_to_rgb/image_raw": True, "/depth/image_raw": True},
            ("/camera", "/rgb/image_raw", "/depth_to_rgb/image_raw"),
        ),
        (
            {
                "/k/rgb/image_raw": False,
                "/k/rgb/image_raw/compressed": False,
                "/k/depth/image_raw/compressedDepth": True,
            },
            ("/k", "/k/rgb/image_raw", "/k/depth/image_raw/compressedDepth"),
        ),
        ({"/eye": False, "/range": True}, ("/camera", "/eye", "/range")),
    ],
)
def test_colour_finds_its_depth_by_the_names_of_usual_drivers(
    topics: dict[str, bool], wanted: tuple[str, str, str]
) -> None:
    (camera,) = choose(dict.fromkeys(topics, IMAGE), topics, ()).cameras
    assert (camera.name, camera.color, camera.depth) == wanted


def test_of_two_depths_of_a_rank_the_first_is_read_or_the_one_that_is_named() -> None:
    topics = {"/a/rgb/image": False, "/a/depth_left/image": True, "/a/depth_right/image": True}
    choice = choose(dict.fromkeys(topics, IMAGE), topics, ())
    assert choice.cameras[0].depth == "/a/depth_left/image"
    assert "--topics /a/depth_right/image reads it" in choice.left_out["/a/depth_right/image"]
    (camera,) = choose(dict.fromkeys(topics, IMAGE), topics, ("/a/rgb/image", "/a/depth_right/image")).cameras
    assert camera.depth == "/a/depth_right/image"


def test_colour_without_depth_is_noted(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4, 3), np.uint8)
    bag = write_bag(tmp_path / "log", "mcap", [scan(), image("/camera/color/image_raw", pixels, "rgb8")])
    dataset = open_dataset(bag)
    assert [m.sensor for m in dataset] == ["/scan"]
    assert any("no depth beside it" in note for note in dataset.report.notes)


def test_inspect_shows_rates_gaps_clocks_and_frames(tmp_path: Path) -> None:
    mounts = transforms({"laser": gtsam.Pose3()})
    wheels = [odometry(START_S + 0.1 * k) for k in range(30)]
    scans = [scan(stamp_s=START_S + 0.2 * k + 0.5) for k in range(12) if k not in (4, 5)]
    for sent in scans:
        sent.late_s = -0.3
    bag = write_bag(tmp_path / "log", "rosbags_mcap", [mounts, *wheels, *scans])
    inspection = inspect_dataset(open_dataset(bag))
    bag_facts = inspection["bag"]
    by_name = {topic["topic"]: topic for topic in bag_facts["topics"]}
    assert by_name["/odom"]["rate_hz"] == pytest.approx(10.0)
    assert by_name["/scan"]["longest_gap_s"] == pytest.approx(0.6)
    assert bag_facts["reference"] == "/odom"
    assert bag_facts["clock_offsets_s"]["/scan"] == pytest.approx(0.3, abs=1e-6)
    text = inspection_text(inspection)
    assert "/scan is stamped 0.300 s ahead of /odom" in text
    assert "frames, the robot's is base_link:\n    base_link\n      laser\n" in text


def test_the_command_asks_for_the_topic_in_one_line(tmp_path: Path) -> None:
    from slam.cli.app import app

    bag = write_bag(tmp_path / "log", "mcap", two_lasers())
    result = CliRunner().invoke(app, ["inspect", str(bag), "--topics", "/rear"])
    assert result.exit_code == 0 and "/rear: 1 readings" in result.output
