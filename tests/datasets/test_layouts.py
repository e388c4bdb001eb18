"""What is packed as each public layout is read back: images, lens, times, truth; or refused in one line."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rgbd_files import color_image, dropped, frames, read

from slam.datasets import open_dataset
from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.corrections_in_space import raised
from slam.datasets.open3d_folder import NO_NUMBER
from slam.datasets.record3d import unpacked_bytes
from slam.datasets.truth_files import read_truth
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics, LaserScan, PointCloud, WheelOdometry
from tools.pack_layouts import (
    CAMERAS,
    Footage,
    eth3d,
    numbers,
    put,
    quaternion,
    rows,
    rtabmap,
    scannet,
    stray_scanner,
)
from tools.pack_lidars import LIDARS, TILTED, Turns
from tools.pack_scenes import SCENES

FOLDERS = CAMERAS | SCENES
LENS = CameraIntrinsics(61.5, 62.0, 31.0, 24.5, 64, 48)
LOSSY = {
    "three_r_scan",
    "scannet",
    "scannet_sens",
    "replica",
    "open3d",
    "sun3d",
    "record3d",
    "polycam",
}  # of JPEG
RATES = {"tartanair": 10.0, "tartanair2": 10.0}
ROUNDED_M = {"replica": 1e-4}


def walk(count: int) -> list[np.ndarray]:
    return [
        gtsam.Pose3(
            gtsam.Rot3.Ypr(0.1 * k, 0.05 * k, 0.02 * k), np.array([0.3 * k, 0.1 * k * k, 0.02 * k])
        ).matrix()
        for k in range(count)
    ]


def footage(count: int = 4) -> Footage:
    rng = np.random.default_rng(1)
    depths = [rng.integers(500, 4000, (48, 64)).astype(np.uint16) for _ in range(count)]
    for depth in depths:
        depth[:5] = 0
    smooth = [np.repeat(np.repeat(color_image(k, 8, 6), 8, 0), 8, 1) for k in range(count)]
    return Footage([k / 30 for k in range(count)], smooth, depths, walk(count), LENS)


def turns(count: int = 4) -> Turns:
    rng = np.random.default_rng(2)
    points = [rng.uniform(-40, 40, (500, 3)).astype(np.float32) for _ in range(count)]
    times = [np.linspace(0, 0.0999, 500) for _ in range(count)]
    return Turns([0.1 * k for k in range(count)], points, times, walk(count))


def assert_same_shape(truth: Trajectory | None, poses: list[np.ndarray]) -> None:
    """Steps between poses as they were: the world's frame may be another."""
    assert truth is not None and len(truth) == len(poses)
    got = [
        gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), position)
        for position, (x, y, z, w) in zip(truth.positions_m, truth.quaternions_xyzw, strict=True)
    ]
    for k in range(1, len(poses)):
        wanted = gtsam.Pose3(poses[0]).between(gtsam.Pose3(poses[k]))
        assert got[0].between(got[k]).equals(wanted, 2e-5)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_camera_is_read_back(name: str, tmp_path: Path) -> None:
    if name == "record3d":
        pytest.importorskip("liblzfse", reason="pip install '.[phones]' needs a C compiler")
    given = footage()
    found, dataset = read(FOLDERS[name](tmp_path, given), strict=True)
    got = frames(found)
    assert len(got) == len(given.stamps_s) and not dropped(dataset)
    rate = RATES.get(name, 30.0)
    assert np.diff([frame.stamp_s for frame in got]) == pytest.approx(1 / rate, abs=2e-6)
    for k, frame in enumerate(got):
        assert frame.intrinsics == LENS
        np.testing.assert_allclose(frame.depth_m, given.depths_mm[k] / 1000, atol=ROUNDED_M.get(name, 1e-6))
        # Within a block of one colour JPEG changes little.
        assert np.abs(frame.color.astype(int) - given.colors[k]).max() <= (9 if name in LOSSY else 0)
    assert not any("assumed" in note for note in dataset.report.notes)
    poses = given.poses
    if name == "rtabmap":  # of the robot, not of the camera
        poses = [pose @ np.linalg.inv(got[0].T_base_camera.matrix()) for pose in poses]
    if name not in ("sun3d", "washington"):
        assert_same_shape(dataset.groundtruth(), poses)


@pytest.mark.parametrize("name", LIDARS)
def test_a_lidar_is_read_back(name: str, tmp_path: Path) -> None:
    given = turns()
    found, dataset = read(LIDARS[name](tmp_path, given), strict=True)
    clouds = [one for one in found if isinstance(one, PointCloud)]
    assert len(clouds) == len(given.stamps_s) and not dropped(dataset)
    assert np.diff([cloud.stamp_s for cloud in clouds]) == pytest.approx(0.1, abs=2e-6)
    for cloud, points, times_s in zip(clouds, given.points, given.times_s, strict=True):
        np.testing.assert_allclose(cloud.points_lidar, points, atol=0.003 if name == "nclt" else 1e-6)
        if name in ("helipr", "boreas", "numbered"):
            np.testing.assert_allclose(cloud.times_s, times_s, atol=1e-6)
    poses = given.poses
    if name in ("mulran", "complex_urban"):
        poses = [pose @ clouds[0].T_base_lidar.inverse().matrix() for pose in poses]
    if name == "complex_urban":
        np.testing.assert_allclose(clouds[0].T_base_lidar.matrix(), TILTED, atol=1e-9)
    if name == "numbered":
        assert dataset.groundtruth() is None
        return
    assert_same_shape(dataset.groundtruth(), poses)


def test_a_point_of_kitti_is_as_old_as_its_bearing(tmp_path: Path) -> None:
    given = turns()
    for points in given.points:
        points[:3] = [[5, 0, 1], [0, 5, 1], [0, -5, 1]]  # ahead, left, right: it turns clockwise
    cloud = next(m for m in read(LIDARS["kitti_raw"](tmp_path, given))[0] if isinstance(m, PointCloud))
    assert cloud.times_s is not None
    assert cloud.times_s[:3] == pytest.approx([0.0, -0.025, 0.025], abs=1e-6)


def test_nclt_has_wheels_with_z_up(tmp_path: Path) -> None:
    found, _ = read(LIDARS["nclt"](tmp_path, turns()))
    wheels = [one for one in found if isinstance(one, WheelOdometry)]
    assert wheels[3].T_odom_base.x() == pytest.approx(0.9) and wheels[3].T_odom_base.y() == pytest.approx(0.9)
    assert wheels[3].T_odom_base.theta() == pytest.approx(0.3)


def test_colour_of_another_lens_is_drawn_as_the_depth_camera_sees_it(tmp_path: Path) -> None:
    given = footage(1)
    tall = np.zeros((192, 256, 3), np.uint8)
    tall[:, 128:] = 200
    scannet(tmp_path, Footage(given.stamps_s, [tall], given.depths_mm, given.poses, LENS))
    matrix = [[300, 0, 127.5, 0], [0, 300, 96, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", matrix)
    color = frames(read(tmp_path)[0])[0].color
    # The edge in the middle of the colour camera is where the depth camera looks straight ahead, at cx = 31;
    # a mere change of size would leave it at 31.5. The sides that only the depth camera sees are black.
    assert color[24, 30].max() < 60 and color[24, 33].min() > 140 and color[24, 63].max() == 0


def test_depth_without_trust_is_left_out(tmp_path: Path) -> None:
    stray_scanner(tmp_path, footage(2))
    trust = np.full((48, 64), 1, np.uint8)
    trust[10:20] = 0
    put(tmp_path / "confidence" / "000000.png", trust)
    first, second = frames(read(tmp_path)[0])
    assert not first.depth_m[10:20].any() and first.depth_m[20:].all() and second.depth_m[10:20].all()


def test_the_lens_of_eth3d_must_be_one(tmp_path: Path) -> None:
    eth3d(tmp_path, footage(1))
    put(tmp_path / "calibration.txt", "0 61 31 24\n")
    with pytest.raises(DatasetError, match=r"calibration\.txt: fx 0") as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda place: put(place / "mav0" / "cam0" / "data.csv", "#t,name\n"), "neither depth nor a lidar"),
        (lambda place: put(place / "a.sens", struct.pack("<I", 4) + bytes(200)), "no whole .sens"),
        (lambda place: put(place / "keyframes" / "images" / "1.jpg", b"") and
            put(place / "keyframes" / "cameras" / "1.json", "{}"), "LiDAR mode"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_in_one_line(make, words: str, tmp_path: Path) -> None:
    make(tmp_path)
    with pytest.raises(DatasetError, match=words) as caught:
        list(open_dataset(tmp_path))
    assert "\n" not in str(caught.value)


def test_scans_of_a_database_of_rtabmap_get_their_angles_back(tmp_path: Path) -> None:
    angles = np.radians(np.arange(-90, 91, 1.0))
    ranges = np.linspace(1, 5, 181)
    points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])[10:].astype("<f4")
    scan = zlib.compress(points.tobytes()) + struct.pack("<3i", 1, len(points), 5 | 1 << 3)
    mount = np.array([[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0.1]], "<f4")
    info = np.array([1, 0, 8, angles[0], angles[-1], np.radians(1.0), 181], "<f4").tobytes() + mount.tobytes()
    found, dataset = read(rtabmap(tmp_path, footage(2), scan, info))
    got = next(one for one in found if isinstance(one, LaserScan))
    assert np.isnan(got.ranges_m[:10]).all()
    np.testing.assert_allclose(got.ranges_m[10:], ranges[10:], rtol=1e-5)
    assert got.T_base_laser.x() == pytest.approx(0.2) and got.range_max_m == 8.0
    assert "odometry" in dataset.report.ignored  # poses in space are not those of wheels


def test_truths_are_read_from_the_files_of_their_publishers(tmp_path: Path) -> None:
    given = turns()
    for name, file in (
        ("nclt", "2012-01-08/groundtruth_2012-01-08.csv"),
        ("mulran", "global_pose.csv"),
        ("boreas", "applanix/lidar_poses.csv"),
        ("newer_college", "ground_truth/registered_poses.csv"),
    ):
        LIDARS[name](tmp_path / name, given)
        truth = read_truth(tmp_path / name / file)
        assert truth is not None and np.diff(truth.stamps_s) == pytest.approx(0.1, abs=2e-6)
        if name != "mulran":  # of the car, not of the lidar
            assert_same_shape(truth, given.poses)
    head = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    )
    lines = ""
    for k, pose in enumerate(given.poses):
        x, y, z, w = quaternion(pose)
        lines += (
            f"{1403636580838555648 + 10**8 * k}," + numbers([*pose[:3, 3], w, x, y, z, 0, 0, 0], ",") + "\n"
        )
    assert_same_shape(read_truth(put(tmp_path / "data.csv", head + lines)), given.poses)
    put(tmp_path / "euroc" / "mav0" / "cam0" / "data.csv", "#t,name\n")
    put(tmp_path / "euroc" / "mav0" / "state_groundtruth_estimate0" / "data.csv", head + lines)
    assert_same_shape(open_dataset(tmp_path / "euroc").groundtruth(), given.poses)
    blocks = "".join(f"{k} {k} {k + 1}\n" + rows(pose) for k, pose in enumerate(given.poses))
    assert_same_shape(read_truth(put(tmp_path / "trajectory.log", blocks)), given.poses)
    kitti = put(tmp_path / "poses" / "03.txt", "".join(numbers(pose[:3]) + "\n" for pose in given.poses))
    with pytest.raises(DatasetError, match=r"times\.txt"):
        read_truth(kitti)
    put(tmp_path / "sequences" / "03" / "times.txt", "0.0\n0.1\n0.2\n0.3\n")
    assert_same_shape(read_truth(kitti), given.poses)
    for comment in ("", "# timestamp tx ty tz qx qy qz qw, base in map\n"):
        assert read_truth(put(tmp_path / "tum.txt", f"{comment}1.0 0 0 0 0 0 0 1\n")) is None


def test_what_lzfse_unpacks_to_is_known_before() -> None:
    liblzfse = pytest.importorskip("liblzfse", reason="pip install '.[phones]' needs a C compiler")
    rng = np.random.default_rng(0)
    for content in (
        b"a" * 300_000,
        rng.bytes(5000),
        b"hello " * 900,
        rng.random(300_000).astype("f4").tobytes(),
    ):
        packed = liblzfse.compress(content)
        assert unpacked_bytes(packed) == len(content)
        with pytest.raises((ValueError, struct.error)):
            unpacked_bytes(packed[:-4])
    huge = b"bvx2" + struct.pack("<I3Q", 2**32 - 1, 0, 0, 0) + b"bvx$"
    assert unpacked_bytes(huge) > LARGEST_BYTES


def test_beams_that_look_too_low_are_raised_about_the_lidar() -> None:
    points = turns(1).points[0]
    got = raised(points, 0.205).astype(np.float64)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    now = np.arctan2(got[:, 2], np.hypot(got[:, 0], got[:, 1]))
    np.testing.assert_allclose(now, elevation + np.radians(0.205), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), np.linalg.norm(points, axis=1), rtol=1e-6)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(np.arctan2(got[:, 1], got[:, 0]), bearing, atol=1e-6)
    assert raised(points, 0.0) is points


def test_names_that_are_no_numbers_among_many_that_are_cost_no_other(tmp_path: Path) -> None:
    CAMERAS["open3d"](tmp_path, footage(3))
    (tmp_path / "color" / "._00000.jpg").write_bytes(b"of macOS")
    image = next((tmp_path / "depth").iterdir())
    image.with_name(f"{image.stem} (1){image.suffix}").write_bytes(image.read_bytes())
    found, dataset = read(tmp_path)
    assert len(frames(found)) == 3
    assert {reason: tally.count for reason, tally in dataset.report.dropped.items()} == {NO_NUMBER: 1}


def test_folders_of_redwood_may_begin_with_the_name_of_their_scene(tmp_path: Path) -> None:
    CAMERAS["open3d"](tmp_path, footage(2))
    (tmp_path / "color").rename(tmp_path / "livingroom1-color")
    (tmp_path / "depth").rename(tmp_path / "livingroom1-depth-clean")
    (tmp_path / "camera_intrinsic.json").unlink()
    (tmp_path / "trajectory.log").rename(tmp_path / "livingroom1-traj.txt")
    found, dataset = read(tmp_path)
    assert len(frames(found)) == 2 and any("assumed" in note for note in dataset.report.notes)
    assert_same_shape(dataset.groundtruth(), footage(2).poses)
