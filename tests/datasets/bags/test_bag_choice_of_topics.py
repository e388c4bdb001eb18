"""Which of several topics of a bag are read, and what is its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bag_writing import (
    IMAGE,
    ODOMETRY,
    SCAN,
    START_S,
    Sent,
    cloud,
    image,
    odometry,
    scan,
    transforms,
    write_bag,
)
from typer.testing import CliRunner

from slam.datasets import open_dataset
from slam.datasets.bags.topics import choose
from slam.datasets.inspection import inspect_dataset
from slam.errors import DatasetError
from slam.measurements import LaserScan, WheelOdometry
from tools.layouts.messages import header

COLOR = np.random.default_rng(3).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def read(tmp_path: Path, sent: list[Sent], *topics: str, writer: str = "mcap") -> tuple[list[Any], Any]:
    dataset = open_dataset(write_bag(tmp_path / "log", writer, sent), topics=topics)
    return list(dataset), dataset


def lidar(stamp_s: float, topic: str = "/points", frame: str = "lidar", near: bool = False) -> Sent:
    """A cloud all around, or ahead."""
    around = np.linspace(-0.5, 0.5, 200) if near else np.linspace(-np.pi, np.pi, 200)
    columns = {
        "x": (5.0 * np.cos(around)).astype("<f4"),
        "y": (5.0 * np.sin(around)).astype("<f4"),
        "z": np.full(200, 0.2, "<f4"),
        "time": np.linspace(0.0, 0.1, 200).astype("<f4"),
    }
    sent = cloud(columns, stamp_s, topic)
    sent.frame = frame
    return sent


def test_of_several_lidars_the_one_with_the_better_view_is_read(tmp_path: Path) -> None:
    sent = [
        lidar(START_S, "/livox/points", near=True),
        lidar(START_S, "/velodyne_points"),
        lidar(START_S, "/velodyne_points_filtered"),
        lidar(START_S, "/cloud_registered", "camera_init"),
    ]
    found, dataset = read(tmp_path, sent)
    assert {one.sensor for one in found} == {"/velodyne_points"}
    why = {name.split(" (")[0]: text for name, text in dataset.report.reasons.items()}
    assert "already transformed by an estimated pose" in why["/cloud_registered"]
    assert "--topics /livox/points reads this one" in why["/livox/points"]
    found, _ = read(tmp_path, sent, "/livox/points")
    assert {one.sensor for one in found} == {"/livox/points"}


def test_two_scanners_whose_places_tf_shows_are_both_read(tmp_path: Path) -> None:
    places = {"front": gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0, 0])), "rear": gtsam.Pose3()}
    sent = [
        transforms(places),
        scan("/scan_front", START_S, "front"),
        scan("/scan_rear", START_S, "rear"),
        scan("/scan_front_filtered", START_S, "front"),
    ]
    found, _ = read(tmp_path, sent)
    assert {one.sensor for one in found} == {"/scan_front", "/scan_rear"}


@pytest.mark.parametrize("upright", [False, True])
def test_a_scanner_that_tilts_or_stands_on_edge_gives_way_to_one_that_lies(
    tmp_path: Path, upright: bool
) -> None:
    """As a PR2's, and as the second one of Cartographer's backpack."""
    sent = [transforms({"laser": gtsam.Pose3()}), scan("/base_scan", START_S)]
    for k in range(4):
        pose = gtsam.Pose3(gtsam.Rot3.Roll(1.5) if upright else gtsam.Rot3.Pitch(0.1 * k), np.zeros(3))
        sent += [transforms({"tilt": pose}, topic="/tf", stamp_s=START_S + 0.1 * k)]
        sent += [scan("/tilt_scan", START_S + 0.1 * k, "tilt")]
    found, dataset = read(tmp_path, sent)
    assert {one.sensor for one in found} == {"/base_scan"}
    (why,) = (text for name, text in dataset.report.reasons.items() if name.startswith("/tilt_scan"))
    assert ("nearly vertical" if upright else "tilts on the robot") in why


def test_a_lidar_that_pans_lies_in_its_plane(tmp_path: Path) -> None:
    sent = [scan("/scan", START_S + 0.1 * k, "head") for k in range(4)]
    for k in range(4):
        turned = gtsam.Pose3(gtsam.Rot3.Yaw(0.1 * k), np.zeros(3))
        sent.append(transforms({"head": turned}, topic="/tf", stamp_s=START_S + 0.1 * k))
    assert len(read(tmp_path, sent)[0]) == 4


def test_pictures_of_a_lidar_are_no_camera(tmp_path: Path) -> None:
    """As ouster-ros sends them: range and brightness of each point as images of 16 bits."""
    steps = np.full((48, 64), 900, np.uint16)
    pictures = [
        image(f"/ouster/{name}_image", steps, "mono16", frame="os_sensor")
        for name in ("range", "nearir", "signal", "reflec")
    ]
    found, dataset = read(tmp_path, [lidar(START_S, "/ouster/points", "os_sensor"), *pictures])
    assert {one.sensor for one in found} == {"/ouster/points"}
    assert sum("an image of the lidar data" in why for why in dataset.report.reasons.values()) == 4


def piece(number: int, of: int) -> Sent:
    """A part of a turn of 0.1 s."""
    around = 2.0 * np.pi * (number + np.linspace(0.0, 0.99, 50)) / of
    columns = {name: np.zeros(50, "<f4") for name in "xyz"}
    columns["x"][:], columns["y"][:] = 5.0 * np.cos(around), -5.0 * np.sin(around)
    return cloud(columns, START_S + 0.1 * number / of)


@pytest.mark.parametrize("count", [4, 36])
def test_pieces_of_turns_are_put_together(tmp_path: Path, count: int) -> None:
    found, dataset = read(tmp_path, [piece(number, count) for number in range(3 * count - 1)])
    assert [one.stamp_s - START_S for one in found] == pytest.approx([0.0, 0.1], abs=1e-6)
    for one in found:
        assert len(one.points_lidar) == 50 * count
        np.testing.assert_allclose(np.unique(one.times_s), 0.1 * np.arange(count) / count, atol=2e-6)
    assert len(list(dataset)) == 2
    assert any("parts of a revolution" in note for note in dataset.report.notes)


def test_a_lidar_that_looks_one_way_sends_no_pieces(tmp_path: Path) -> None:
    found, _ = read(tmp_path, [lidar(START_S + 0.1 * k, near=True) for k in range(3)])
    assert [len(one.points_lidar) for one in found] == [200] * 3


def test_what_a_camera_saw_of_the_way_is_no_wheels_in_tf_either(tmp_path: Path) -> None:
    """As of a ZED: its odometry moves its own frame in odom, and tf says the same."""
    sent = [scan("/scan", START_S + 0.1)]
    for k in range(3):
        moved = gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * k, 0.0, 0.0]))
        sent.append(transforms({"base_link": moved}, "odom", "/tf", START_S + 0.1 * k))
    assert any(isinstance(one, WheelOdometry) for one in read(tmp_path, sent)[0])
    sent.append(odom("/zed/odom", "base_link", 0.0))
    assert not any(isinstance(one, WheelOdometry) for one in read(tmp_path, sent)[0])


def test_packets_without_what_shows_how_to_read_them_name_it(tmp_path: Path) -> None:
    sent = [Sent("/ouster/lidar_packets", "ouster_sensor_msgs/msg/PacketMsg", START_S, {"buf": [1, 2]})]
    with pytest.raises(DatasetError, match=r"without its metadata: put its .json"):
        read(tmp_path, sent)


def odom(topic: str, child: str, x: float, parent: str = "odom") -> Sent:
    sent = odometry(START_S, x, topic=topic)
    sent.fields["child_frame_id"], sent.frame = child, parent
    return sent


def test_the_wheels_come_before_estimates_and_the_truth_is_no_odometry(tmp_path: Path) -> None:
    sent = [
        scan(),
        odom("/odometry/filtered", "base_link", 1.0),
        odom("/wheel/odometry", "base_link", 2.0),
        odom("/vins/odometry", "camera", 3.0, "world"),
        odom("/ground_truth/odom", "base_link", 4.0, "map"),
    ]
    found, dataset = read(tmp_path, sent)
    assert {one.T_odom_base.x() for one in found if isinstance(one, WheelOdometry)} == {2.0}
    why = {name.split(" (")[0]: text for name, text in dataset.report.reasons.items()}
    assert "it is ground truth" in why["/ground_truth/odom"]
    assert "estimate in world" in why["/vins/odometry"]
    assert why["/odometry/filtered"].startswith("/wheel/odometry is read")
    found, _ = read(tmp_path, sent, "/odometry/filtered")
    assert {one.T_odom_base.x() for one in found if isinstance(one, WheelOdometry)} == {1.0}


def test_odometry_of_a_camera_is_brought_to_the_robot(tmp_path: Path) -> None:
    ahead = gtsam.Pose3(gtsam.Rot3(), np.array([0.5, 0, 0]))
    sent = [
        transforms({"laser": gtsam.Pose3(), "t265_pose": ahead}),
        scan(),
        odom("/t265/odom/sample", "t265_pose", 3.0),
    ]
    found, dataset = read(tmp_path, sent)
    assert not [one for one in found if isinstance(one, WheelOdometry)]  # a camera moves as it likes
    found, dataset = read(tmp_path, sent, "/t265/odom/sample")
    assert dataset.figures.base == "base_link"
    (wheels,) = [one for one in found if isinstance(one, WheelOdometry)]
    assert wheels.T_odom_base.x() == pytest.approx(2.5)


def two_robots() -> list[Sent]:
    mounts = [
        transforms({"laser": gtsam.Pose3(gtsam.Rot3(), np.array([x, 0, 0]))}, topic=f"/robot{n}/tf_static")
        for n, x in ((1, 0.1), (2, 0.2))
    ]
    return [
        *mounts,
        *(scan(f"/robot{n}/scan") for n in (1, 2)),
        *(odometry(START_S, float(n), topic=f"/robot{n}/odom") for n in (1, 2)),
    ]


@pytest.mark.parametrize(("topics", "robot"), [((), 1), (("/robot2",), 2), (("/robot2/scan",), 2)])
def test_a_namespace_is_a_robot(tmp_path: Path, topics: tuple[str, ...], robot: int) -> None:
    found, _ = read(tmp_path, two_robots(), *topics)
    (laser,) = [one for one in found if isinstance(one, LaserScan)]
    (wheels,) = [one for one in found if isinstance(one, WheelOdometry)]
    assert laser.sensor == f"/robot{robot}/scan"
    assert wheels.T_odom_base.x() == robot
    assert laser.T_base_laser.x() == pytest.approx(0.1 * robot)


def test_inspect_gives_a_command_a_robot(tmp_path: Path) -> None:
    _, dataset = read(tmp_path, two_robots())
    first, second = inspect_dataset(dataset)["commands"]
    assert first.endswith("-o log-map") and second.endswith("--topics /robot2 -o log-robot2-map")


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        ([image("/camera/color/image_raw", COLOR, "rgb8")], "no usable scan, cloud, RGB-D pair or odometry"),
        ([odometry(START_S)], "no sensor of the surroundings is used"),
    ],
)
def test_inspect_shows_what_is_in_a_bag_that_cannot_be_mapped(
    tmp_path: Path, sent: list[Sent], said: str
) -> None:
    from slam.cli.app import app

    bag = write_bag(tmp_path / "log", "mcap", sent)
    result = CliRunner().invoke(app, ["inspect", str(bag)])
    assert result.exit_code == 0
    assert f"cannot be mapped: {said}" in result.output.replace(str(bag) + " holds ", "")
    assert sent[0].topic in result.output and "map it" not in result.output


def test_choices_do_not_hang_on_the_order_of_topics() -> None:
    kinds = {"/b/scan": SCAN, "/a/scan": SCAN, "/odom": ODOMETRY, "/image": IMAGE}
    turned = dict(reversed(kinds.items()))
    assert choose(kinds, {}, ()) == choose(turned, {}, ())
    assert choose(kinds, {}, ()).scans == ("/a/scan",)


def pose(x: float) -> dict[str, Any]:
    return {"position": {"x": x, "y": 1.0, "z": 2.0}, "orientation": {"z": 0.6, "w": 0.8}}


@pytest.mark.parametrize("kind", ["PoseStamped", "TransformStamped", "Path", "Odometry"])
def test_the_truth_is_read_and_compared_with(tmp_path: Path, kind: str) -> None:
    stamps = [START_S + 0.1 * n for n in range(3)]
    package, topic = "geometry_msgs/msg/", "/vicon/robot/pose"
    if kind == "Path":
        package, topic = "nav_msgs/msg/", "/gt/path"
        poses = [{"header": header(at, "map"), "pose": pose(10.0 * n)} for n, at in enumerate(stamps)]
        sent = [Sent(topic, f"{package}Path", at, {"poses": poses[: n + 1]}) for n, at in enumerate(stamps)]
    elif kind == "TransformStamped":
        moved = [
            {"translation": {"x": 10.0 * n, "y": 1.0, "z": 2.0}, "rotation": {"z": 0.6, "w": 0.8}}
            for n in range(3)
        ]
        sent = [
            Sent(topic, f"{package}{kind}", at, {"transform": one})
            for at, one in zip(stamps, moved, strict=True)
        ]
    elif kind == "Odometry":
        sent = [Sent(topic, ODOMETRY, at, {"pose": {"pose": pose(10.0 * n)}}) for n, at in enumerate(stamps)]
    else:
        sent = [Sent(topic, f"{package}{kind}", at, {"pose": pose(10.0 * n)}) for n, at in enumerate(stamps)]
    _, dataset = read(tmp_path, [scan(), *sent])
    truth = dataset.groundtruth()
    assert np.allclose(truth.stamps_s, stamps)
    assert np.allclose(truth.positions_m, [[10.0 * n, 1.0, 2.0] for n in range(3)])
    assert np.allclose(truth.quaternions_xyzw, [[0, 0, 0.6, 0.8]] * 3)
    assert any(
        name.startswith(topic) and "it is ground truth" in why for name, why in dataset.report.reasons.items()
    )


def test_a_pose_of_another_name_is_the_truth_where_it_is_named(tmp_path: Path) -> None:
    sent = [scan(), Sent("/tracker", "geometry_msgs/msg/PoseStamped", START_S, {"pose": pose(1.0)})]
    _, dataset = read(tmp_path, sent)
    assert dataset.groundtruth() is None
    _, dataset = read(tmp_path, sent, "/tracker")
    assert len(dataset.groundtruth()) == 1
