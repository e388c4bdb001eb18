"""Folders of point clouds: KITTI odometry, lists of stamps, the simulator's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from carmen_lines import odom
from carmen_lines import write as write_log
from point_files import write_pcd, write_ply
from rgbd_files import dropped, read

from slam.datasets import open_dataset
from slam.datasets.budget import Budget
from slam.datasets.calibration import KINECT, Calibration
from slam.datasets.cloud_files import DAMAGED, MISSING, NO_POINTS, read_cloud
from slam.datasets.clouds_over_time import UNPAIRED, WITHOUT_CLOUD
from slam.datasets.dataset import RecordFault
from slam.datasets.image_files import depth_of
from slam.datasets.inspection import inspect_dataset
from slam.datasets.stamped_files import BAD_STAMP
from slam.errors import DatasetError
from slam.evaluation.pages import inspection_text
from slam.measurements import PointCloud, WheelOdometry

POINTS = np.array([[1, 2, 3], [4, 5, 6], [0, 0, 0], [np.nan, 1, 1], [7, 8, 9]], np.float32)
VALID = POINTS[[0, 1, 4]]


def bins(folder: Path, count: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        rows = np.column_stack([POINTS + np.float32(k), np.ones(5, np.float32)]).astype("<f4")
        rows[2, :3] = 0.0
        rows.tofile(folder / f"{k:06d}.bin")


def kitti(path: Path, count: int = 3) -> Path:
    folder = path / "sequences" / "04"
    bins(folder / "velodyne", count)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(count)))
    return folder


def clouds(path: Path) -> list[PointCloud]:
    return [m for m in open_dataset(path) if isinstance(m, PointCloud)]


def test_a_kitti_sequence_gives_clouds_and_the_truth_of_its_lidar(tmp_path: Path) -> None:
    folder = kitti(tmp_path)
    turn = gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]))
    T_camera_lidar = gtsam.Pose3(turn, np.array([0.1, 0.2, 0.3]))
    row = " ".join(map(str, T_camera_lidar.matrix()[:3].ravel()))
    projection = " ".join(["718.9", *["0"] * 11])
    (folder / "calib.txt").write_text(f"P0: {projection}\nTr: {row}\n")
    truth = [gtsam.Pose3(gtsam.Rot3.Yaw(0.2 * k), np.array([1.0 * k, 0.0, 0.0])) for k in range(3)]
    of_camera = [T_camera_lidar.compose(pose).compose(T_camera_lidar.inverse()) for pose in truth]
    (tmp_path / "poses").mkdir()
    lines = [" ".join(map(str, pose.matrix()[:3].ravel())) for pose in of_camera]
    (tmp_path / "poses" / "04.txt").write_text("\n".join(lines) + "\n")
    found = clouds(folder)
    assert [cloud.stamp_s for cloud in found] == pytest.approx([0.0, 0.1, 0.2])
    assert (found[0].points_lidar == VALID).all() and found[0].times_s is None
    trajectory = open_dataset(folder).groundtruth()
    assert trajectory is not None
    assert trajectory.positions_m == pytest.approx(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]]), abs=1e-6)
    assert trajectory.to_planar()[:, 2] == pytest.approx([0.0, 0.2, 0.4], abs=1e-6)


COLUMNS = dict(zip("xyz", POINTS.T, strict=True))


@pytest.mark.parametrize(("suffix", "write"), [("pcd", write_pcd), ("ply", write_ply)])
def test_pcd_and_ply_give_points_and_their_times(tmp_path: Path, suffix: str, write: Any) -> None:
    for k in (9, 10):
        write(
            tmp_path / f"{k}.{suffix}",
            COLUMNS | {"t": np.arange(5, dtype=np.float32) * 25, "i": np.arange(5, dtype=np.uint8)},
        )
    (tmp_path / "times.txt").write_text("# seconds\n5.0\n6.0\n")
    dataset = open_dataset(tmp_path)
    first, second = (m for m in dataset if isinstance(m, PointCloud))
    assert (first.stamp_s, second.stamp_s) == (5.0, 6.0)
    assert (first.points_lidar == VALID).all()
    assert first.times_s == pytest.approx([0.0, 0.025, 0.1], abs=1e-6)
    assert first.intensities is not None and first.intensities.tolist() == [0.0, 1.0, 4.0]
    assert any("milliseconds after the stamp" in note for note in dataset.report.notes)


def test_names_in_the_list_win_over_the_order_of_the_folder(tmp_path: Path) -> None:
    bins(tmp_path / "points", 2)
    (tmp_path / "points.txt").write_text(
        "1.0 points/000001.bin\n2.0 points/000000.bin\n3.0 points/9.bin\n4.0\n"
    )
    found, dataset = read(tmp_path)
    assert [m.stamp_s for m in found] == [1.0, 2.0]
    assert isinstance(found[1], PointCloud) and (found[1].points_lidar == VALID).all()
    assert dropped(dataset) == {MISSING: 1, "line with too few fields": 1}


@pytest.mark.parametrize(
    "names",
    [("scan_2", "scan_10"), ("2", "10"), ("9_left", "10_left"), ("7.25", "7.5"), ("9.5", "10.25")],
)
def test_clouds_come_in_the_order_of_the_numbers_in_their_names(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    bins(tmp_path / "points", 2)
    for k, name in enumerate(names):
        (tmp_path / "points" / f"{k:06d}.bin").rename(tmp_path / "points" / f"{name}.bin")
    (tmp_path / "times.txt").write_text("1.0\n2.0\n")
    assert [float(cloud.points_lidar[0, 0]) for cloud in clouds(tmp_path)] == [1.0, 2.0]


@pytest.mark.parametrize(("stamps", "reason"), [(2, UNPAIRED), (4, WITHOUT_CLOUD)])
def test_a_list_of_another_length_is_counted(tmp_path: Path, stamps: int, reason: str) -> None:
    bins(tmp_path, 3)
    (tmp_path / "times.txt").write_text("".join(f"{k}.0\n" for k in range(stamps)))
    found, dataset = read(tmp_path)
    assert len(found) == min(stamps, 3) and dropped(dataset) == {reason: 1}


@pytest.mark.parametrize("begun_s", [0.0, 1000.0, 1_700_000_000.0])
@pytest.mark.parametrize(("unit", "in_a_second"), [("milliseconds", 1e3), ("nanoseconds", 1e9)])
def test_stamps_that_are_no_seconds_are_read_in_their_unit(
    tmp_path: Path, unit: str, in_a_second: float, begun_s: float
) -> None:
    folder = kitti(tmp_path, 4)
    lines = [f"{(begun_s + 0.1 * k) * in_a_second:.0f}\n" for k in range(4)]
    (folder / "times.txt").write_text("".join(lines))
    found, dataset = read(folder)
    assert [one.stamp_s for one in found] == pytest.approx([begun_s + 0.1 * k for k in range(4)], rel=1e-15)
    assert any("times.txt" in text and unit in text for text in dataset.report.warnings) == (begun_s < 1e9)
    for k, line in enumerate(lines):  # the same as names
        (folder / "velodyne" / f"{k:06d}.bin").rename(folder / "velodyne" / f"{int(line):010d}.bin")
    (folder / "times.txt").unlink()
    named = [one.stamp_s for one in clouds(folder / "velodyne")]
    assert named == pytest.approx([one.stamp_s for one in found])


def test_stamps_may_be_dates(tmp_path: Path) -> None:
    folder = kitti(tmp_path, 3)
    for parted in ("T", " "):
        lines = [f"2011-09-26{parted}13:02:25.{k}00000500\n" for k in range(3)]
        (folder / "times.txt").write_text("".join(lines))
        stamps = [one.stamp_s - 1317042145.0 for one in clouds(folder)]
        assert stamps == pytest.approx([5e-7, 0.1 + 5e-7, 0.2 + 5e-7], abs=3e-7)
    named = [f"{k}.0 velodyne/{k:06d}.bin\n" for k in range(3)]
    (folder / "times.txt").write_text("".join(named))
    assert [one.stamp_s for one in clouds(folder)] == [0.0, 1.0, 2.0]


def test_clouds_that_come_seldom_keep_their_seconds_and_one_wrong_stamp_is_counted(tmp_path: Path) -> None:
    bins(tmp_path, 4)
    (tmp_path / "times.txt").write_text("0\n8\n16\n24000000000000\n")
    found, dataset = read(tmp_path)
    assert [one.stamp_s for one in found] == [0.0, 8.0, 16.0]
    assert dropped(dataset) == {BAD_STAMP: 1} and not any("unit" in note for note in dataset.report.notes)


def test_damaged_clouds_are_counted(tmp_path: Path) -> None:
    folder = kitti(tmp_path, 4)
    (folder / "velodyne" / "000001.bin").write_bytes(b"1234567")
    (folder / "velodyne" / "000002.bin").write_bytes(bytes(64))
    (folder / "velodyne" / "000003.bin").write_bytes(b"")
    found, dataset = read(folder)
    assert len(found) == 1 and dropped(dataset) == {DAMAGED: 2, NO_POINTS: 1}


@pytest.mark.parametrize(("suffix", "write"), [("pcd", write_pcd), ("ply", write_ply)])
def test_a_damaged_header_is_counted(tmp_path: Path, suffix: str, write: Any) -> None:
    whole = write(tmp_path / f"0.{suffix}", COLUMNS).read_bytes()
    (tmp_path / f"1.{suffix}").write_bytes(whole.replace(b"x", b"\xe2").replace(b"format", b"famrot"))
    (tmp_path / f"2.{suffix}").write_bytes(whole[:40])
    (tmp_path / "times.txt").write_text("1\n2\n3\n")
    found, dataset = read(tmp_path)
    assert len(found) == 1 and dropped(dataset) == {DAMAGED: 2}


def test_clouds_of_a_robot_come_between_its_readings_with_the_wheels_beside_them(tmp_path: Path) -> None:
    write_log(tmp_path, odom(0.0, stamp=1.0), odom(0.1, stamp=1.1), odom(0.2, stamp=1.2))
    bins(tmp_path / "points", 2)
    (tmp_path / "points.txt").write_text("1.05 points/000000.bin\n1.3 points/000001.bin\n")
    (tmp_path / "points" / "calibration.yaml").write_text(
        "T_base_lidar: {translation_m: [0.1, 0.0, 0.7], quaternion_xyzw: [0, 0, 0, 1]}\n"
    )
    found, dataset = read(tmp_path)
    assert [round(m.stamp_s, 2) for m in found] == [1.0, 1.05, 1.05, 1.1, 1.2, 1.3]
    assert isinstance(found[1], WheelOdometry) and found[1].T_odom_base.x() == pytest.approx(0.05)
    assert isinstance(found[2], PointCloud) and found[2].T_base_lidar.z() == pytest.approx(0.7)
    text = inspection_text(inspect_dataset(dataset))
    assert "3 points, 3.74 to" in text and "mounted at x 0.100 m, y 0.000 m, z 0.700 m" in text


def test_a_wrong_mounting_is_refused(tmp_path: Path) -> None:
    folder = kitti(tmp_path)
    (folder / "velodyne" / "calibration.yaml").write_text("T_base_lidar: {translation_m: [0, 0]}\n")
    with pytest.raises(DatasetError, match="T_base_lidar"):
        list(open_dataset(folder))


def test_numbered_clouds_without_stamps_come_ten_a_second_and_that_is_said(tmp_path: Path) -> None:
    bins(tmp_path, 3)
    found, dataset = read(tmp_path)
    assert [one.stamp_s for one in found] == [0.0, 0.1, 0.2]
    assert any("no stamps" in note for note in dataset.report.notes)
    with pytest.raises(DatasetError, match="no known format"):
        bins(tmp_path / "one", 1)
        open_dataset(tmp_path / "one")


def test_the_folder_of_clouds_of_a_sequence_has_its_stamps_above_it(tmp_path: Path) -> None:
    folder = kitti(tmp_path)
    (folder / "times.txt").write_text("7.0\n7.25\n7.5\n")
    assert [one.stamp_s for one in clouds(folder / "velodyne")] == [7.0, 7.25, 7.5]


NUMBERS = np.column_stack([np.random.default_rng(0).uniform(1.0, 9.0, (40, 3)), np.arange(40.0)]).round(3)


def plain_files(folder: Path, suffix: str, form: str) -> Path:
    folder.mkdir(parents=True)
    for k in range(3):
        file = folder / f"cloud_{k:04d}.{suffix}"
        if form == "array":
            np.save(file, NUMBERS[:, :3])
        elif form == "image":
            np.save(file, NUMBERS[:, :3].reshape(8, 5, 3))
        elif form == "records":
            np.save(file, np.rec.fromarrays(NUMBERS.T, names="x,y,z,intensity"))
        else:
            part = ", " if suffix == "csv" else " "
            head = {"names": f"//X{part}Y{part}Z{part}Intensity\n", "count": "40\n", "rows": ""}[form]
            file.write_text(head + "".join(part.join(map(str, row)) + "\n" for row in NUMBERS))
    return folder


@pytest.mark.parametrize(
    ("suffix", "form"),
    [
        *((suffix, form) for suffix in ("xyz", "txt", "csv") for form in ("rows", "names", "count")),
        *(("npy", form) for form in ("array", "image", "records")),
    ],
)
def test_clouds_of_text_and_of_numpy(tmp_path: Path, suffix: str, form: str) -> None:
    plain_files(tmp_path / "points", suffix, form)
    (tmp_path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    for folder in (tmp_path, tmp_path / "points"):
        found = clouds(folder)
        assert [cloud.stamp_s for cloud in found] == pytest.approx([0.0, 0.1, 0.2])
        np.testing.assert_allclose(found[0].points_lidar, NUMBERS[:, :3], rtol=1e-6)
        stated = found[0].intensities
        assert (stated is None) == (form in ("array", "image"))
        assert stated is None or (stated == NUMBERS[:, 3]).all()


def test_clouds_of_text_are_named_by_stamps(tmp_path: Path) -> None:
    (tmp_path / "lidar").mkdir()
    for name in ("1700000000.5", "scan_1700000000.6_top"):
        np.savetxt(tmp_path / "lidar" / f"{name}.txt", NUMBERS)
    assert [cloud.stamp_s for cloud in clouds(tmp_path)] == [1700000000.5, 1700000000.6]


def test_other_texts_and_arrays_are_no_clouds(tmp_path: Path) -> None:
    """Poses, labels and depth images, which are numbered, too."""
    for name, file in (("pose", np.eye(4)), ("label", np.ones((7, 15)))):
        (tmp_path / name).mkdir()
        for k in range(3):
            np.savetxt(tmp_path / name / f"{k:06d}.txt", file)
    (tmp_path / "depth").mkdir()
    for k in range(3):
        np.save(tmp_path / "depth" / f"{k:06d}.npy", np.ones((48, 64), np.float32))
    (tmp_path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    for folder in (tmp_path, *(tmp_path / name for name in ("pose", "label", "depth"))):
        with pytest.raises(DatasetError, match="no known format"):
            open_dataset(folder)


def test_a_damaged_row_of_text_is_counted(tmp_path: Path) -> None:
    folder = plain_files(tmp_path / "points", "xyz", "rows")
    (folder / "cloud_0001.xyz").write_text("1 2 3\n4 5\n")
    (folder / "cloud_0002.xyz").write_bytes(bytes(range(256)))
    log = open_dataset(folder)
    assert len(list(log)) == 1 and log.report.dropped_count == 2


def test_a_folder_of_e57_says_what_reads_them(tmp_path: Path) -> None:
    for k in range(2):
        (tmp_path / f"{k}.e57").write_bytes(b"ASTM-E57")
    with pytest.raises(DatasetError, match="pye57"):
        open_dataset(tmp_path)


def test_a_damaged_header_of_an_array_is_a_fault(tmp_path: Path) -> None:
    """NumPy's parser ends in an error of the tokenizer, which is no ValueError; of depth images, too."""
    np.save(tmp_path / "a.npy", NUMBERS)
    content = (tmp_path / "a.npy").read_bytes().replace(b"),", b"  ", 1)
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(RecordFault):
        read_cloud(tmp_path / "a.npy")
    with pytest.raises(RecordFault):
        depth_of(content, "a.npy", Calibration(KINECT, 1000.0), Budget(1 << 20))
