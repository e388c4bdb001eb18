"""Robot@Home in both editions: the same small session as text files and as a database."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rgbd_files import dropped, frames, read

from slam.datasets import open_dataset
from slam.datasets.frame_pairs import NO_COLOR
from slam.datasets.image_files import MISSING
from slam.datasets.robot_at_home import NO_SCAN_FILE
from slam.datasets.robot_at_home2 import NO_FILES
from slam.datasets.robot_at_home_rig import BAD_SCAN, BAD_TIME
from slam.datasets.stamped_files import WRONG_FIELDS
from slam.errors import BadRecordError, DatasetError
from slam.measurements import LaserScan, Measurement, RgbdFrame

START_S = 1400000000.5
APERTURE_RAD = 4.1847


def ticks(stamp_s: float) -> int:
    return round((stamp_s + 11644473600) * 10) * 1_000_000


def sideways_images(folder: Path, stem: str) -> None:
    """320 x 240 as stored; the corner that is above right when upright is marked."""
    folder.mkdir(parents=True, exist_ok=True)
    color, depth = np.zeros((240, 320, 3), np.uint8), np.full((240, 320), 6554, np.uint16)
    # Turned counter-clockwise, the last row and column come to the upper right.
    color[-1, -1], depth[-1, -1], depth[0, 0] = 255, 65535, 0
    cv2.imwrite(str(folder / f"{stem}_intensity.png"), color)
    cv2.imwrite(str(folder / f"{stem}_depth.png"), depth)


def scan_text(ranges: list[float], valid: list[int]) -> str:
    lines = ["# aperture", f"{APERTURE_RAD}", "# max", "5.6", f"{len(ranges)}"]
    return "\n".join([*lines, " ".join(map(str, ranges)), " ".join(map(str, valid)), ""])


def write_text_session(root: Path, session: str = "alma-s1") -> tuple[Path, Path]:
    """The folders of a session in the two trees."""
    trees = []
    for kind in ("laser_scans", "rgbd_data"):
        name = f"Robot@Home-dataset_{kind}-plain_text"
        trees.append(root / f"{name}-all" / f"{name}-{session}" / session)
    room = trees[0] / "kitchen1"
    (room / "1_hokuyo_processed").mkdir(parents=True)
    lines = ["# id label x y z yaw pitch roll time"]
    for k in range(4):
        lines.append(f"{k} HOKUYO1 0 0 0 0 0 0 {ticks(START_S + 0.1 * k)}")
        text = scan_text([1.0 + k, 0.0, 5.6, 2.0], [1, 0, 1, 0])
        (room / "1_hokuyo_processed" / f"{k}_scan.txt").write_text(text)
    (room / "1_hokuyo_processed.txt").write_text("\n".join(lines))
    images = trees[1] / "kitchen1_rgbd"
    lines = []
    for k, label in enumerate(("RGBD_4", "RGBD_1", "RGBD_4")):
        lines.append(f"{k} {label} 9 9 9 1 1 1 {ticks(START_S + 0.1 * k)}")
        sideways_images(images, str(k))
    (trees[1] / "kitchen1_rgbd.txt").write_text("\n".join(lines))
    return trees[0], trees[1]


def write_database(folder: Path, sessions: tuple[str, ...] = ("alma-s1",)) -> Path:
    """``rh.db`` with two scans and two frames a session; the tables have the columns that are read."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = "id, room_id, home_session_id, name, sensor_id, laser_aperture, laser_max_range, time_stamp"
    with sqlite3.connect(folder / "rh.db") as database:
        database.executescript(
            f"create table rh_raw ({columns}, sensor_file_1, sensor_file_2, sensor_file_3, files_path);"
            "create table rh_raw_scans (id, shot_id, scan, valid_scan, sensor_observation_id);"
            "create table rh_home_sessions (id, home_id, name); create table rh_rooms (id, home_id, name);"
            "create table rh_sensors (id, sensor_type_id, name);"
            "create table rh2_old2new_rgbd_files (id, new_path, new_file_1, new_file_2, new_file_3);"
            "insert into rh_rooms values (0, 0, 'alma_kitchen1'), (1, 0, 'alma_bedroom1');"
            "insert into rh_sensors values (0, 0, 'HOKUYO1'), (1, 1, 'RGBD_1'), (4, 1, 'RGBD_4');"
        )
        for s, session in enumerate(sessions):
            database.execute("insert into rh_home_sessions values (?, 0, ?)", (s, session))
            for k in range(2):
                laser, camera = 100 * s + 10 + k, 100 * s + 20 + k
                time = ticks(START_S + 1000 * s + 0.1 * k)
                row = (k, s, "x", 0, APERTURE_RAD, 5.6, time)
                database.execute(f"insert into rh_raw ({columns}) values (?,?,?,?,?,?,?,?)", (laser, *row))
                row = (k, s, "x", 4, None, None, time)
                database.execute(f"insert into rh_raw ({columns}) values (?,?,?,?,?,?,?,?)", (camera, *row))
                for shot, reading in enumerate((1.0 + k, 0.0, 5.6, 2.0)):
                    database.execute(
                        "insert into rh_raw_scans values (?,?,?,?,?)", (shot, 3 - shot, reading, 1, laser)
                    )
                names = (f"session_{s}", f"{camera}_depth.png", f"{camera}_intensity.png", "")
                database.execute("insert into rh2_old2new_rgbd_files values (?,?,?,?,?)", (camera, *names))
                sideways_images(folder / "files" / "rgbd" / f"session_{s}", str(camera))
    database.close()
    return folder


def scans(measurements: list[Measurement]) -> list[LaserScan]:
    return [m for m in measurements if isinstance(m, LaserScan)]


def check_upright(frame: RgbdFrame) -> None:
    """What was stored on its side stands upright, with its lens and mounting."""
    assert frame.color.shape == (320, 240, 3)
    assert frame.color.flags.c_contiguous
    assert frame.depth_m.flags.c_contiguous
    assert frame.color[0, -1].tolist() == [255, 255, 255]
    assert frame.depth_m[0, -1] == pytest.approx(10.0)
    assert frame.depth_m[-1, 0] == 0.0
    assert frame.depth_m[5, 5] == pytest.approx(1.0, abs=1e-3)
    lens = frame.intrinsics
    assert (lens.fx, lens.fy, lens.cx) == (271.370, 286.441, 120.080)
    # A ray through the marked pixel is the same before and after the turn, up to that turn.
    stored = ((319 - 157.325) / 286.441, (239 - 120.080) / 271.370)
    upright = ((239 - lens.cx) / lens.fx, (0 - lens.cy) / lens.fy)
    assert upright == pytest.approx((stored[1], -stored[0]))


def test_both_trees_of_a_session_are_one_log(tmp_path: Path) -> None:
    laser_tree, image_tree = write_text_session(tmp_path)
    for path in (laser_tree, image_tree, laser_tree / "kitchen1", tmp_path):
        found, dataset = read(path, strict=True)
        assert [m.sensor for m in found] == [
            *("HOKUYO1", "RGBD_4", "HOKUYO1", "RGBD_1", "HOKUYO1", "RGBD_4", "HOKUYO1")
        ]
        assert [m.stamp_s for m in scans(found)] == pytest.approx([START_S + 0.1 * k for k in range(4)])
        assert not dropped(dataset)
        assert dataset.groundtruth() is None


def test_a_scan_spreads_over_the_aperture_and_flags_are_believed(tmp_path: Path) -> None:
    scan = scans(read(write_text_session(tmp_path)[0])[0])[1]
    np.testing.assert_array_equal(scan.ranges_m, np.float32([2.0, np.nan, np.inf, np.nan]))
    assert scan.bearings_rad()[[0, -1]] == pytest.approx([-APERTURE_RAD / 2, APERTURE_RAD / 2])
    assert scan.range_max_m == 5.6
    assert scan.T_base_laser.x() == pytest.approx(0.205)


def test_images_are_turned_upright_with_lens_and_mounting(tmp_path: Path) -> None:
    found, _ = read(write_text_session(tmp_path)[1])
    ahead, right = frames(found)[0], frames(found)[1]
    check_upright(ahead)
    assert ahead.T_base_camera is not None
    assert right.T_base_camera is not None
    np.testing.assert_allclose(
        ahead.T_base_camera.rotation().matrix().T[1:], [[0, 0, -1], [1, 0, 0]], atol=1e-12
    )
    np.testing.assert_allclose(ahead.T_base_camera.translation(), [0.285, 0.0, 1.045])
    axis = right.T_base_camera.rotation().matrix()[:, 2]
    np.testing.assert_allclose(axis, [math.sqrt(0.5), -math.sqrt(0.5), 0.0], atol=1e-12)


def test_damage_is_counted_and_costs_only_itself(tmp_path: Path) -> None:
    laser_tree, image_tree = write_text_session(tmp_path)
    folder = laser_tree / "kitchen1" / "1_hokuyo_processed"
    (folder / "0_scan.txt").unlink()
    (folder / "1_scan.txt").write_text(scan_text([1.0, 2.0], [1, 1]).replace("\n2\n", "\n3\n"))
    (folder / "2_scan.txt").write_text(scan_text([1.0, 2.0], [1, 1])[:20])
    (image_tree / "kitchen1_rgbd" / "1_depth.png").unlink()
    with (image_tree / "kitchen1_rgbd.txt").open("a") as index:
        index.write("\n7 RGBD_1 0 0 0 0 0 0 12\n8 RGBD_1 0 0")
    found, dataset = read(laser_tree)
    assert (len(scans(found)), len(frames(found))) == (1, 2)
    assert dropped(dataset) == {NO_SCAN_FILE: 1, BAD_SCAN: 2, MISSING: 1, BAD_TIME: 1, WRONG_FIELDS: 1}
    with pytest.raises(BadRecordError):
        read(laser_tree, strict=True)


def test_several_sessions_are_not_mixed(tmp_path: Path) -> None:
    write_text_session(tmp_path, "alma-s1")
    write_text_session(tmp_path, "anto-s1")
    with pytest.raises(DatasetError, match=r"2 sessions \(alma-s1, anto-s1\); give the folder of one"):
        open_dataset(tmp_path)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(junk=st.binary(max_size=20), at=st.integers(0, 300), name=st.sampled_from(["index", "scan"]))
def test_random_damage_is_survived(tmp_path: Path, junk: bytes, at: int, name: str) -> None:
    laser_tree = tmp_path / "Robot@Home-dataset_laser_scans-plain_text-all" / "x" / "alma-s1"
    if not laser_tree.exists():
        laser_tree.parent.mkdir(parents=True)
        write_text_session(tmp_path / "whole")[0].rename(laser_tree)
    room = laser_tree / "kitchen1"
    path = room / "1_hokuyo_processed.txt" if name == "index" else room / "1_hokuyo_processed" / "1_scan.txt"
    content = path.read_bytes()
    path.write_bytes(content[:at] + junk + content[at + len(junk) :])
    try:
        for scan in open_dataset(laser_tree):
            assert isinstance(scan, LaserScan)
            assert math.isfinite(scan.stamp_s)
            assert not np.isnan(scan.ranges_m).all()
    except DatasetError as error:
        assert "\n" not in str(error)
    finally:
        path.write_bytes(content)


def test_a_database_gives_the_same_measurements(tmp_path: Path) -> None:
    folder = write_database(tmp_path)
    for path in (folder, folder / "rh.db", folder / "alma-s1", folder / "rh.db" / "alma-s1"):
        found, dataset = read(path, strict=True)
        assert [m.sensor for m in found] == ["HOKUYO1", "RGBD_4", "HOKUYO1", "RGBD_4"]
        assert not dropped(dataset)
    check_upright(frames(found)[0])
    # The shots are in the order of their numbers, not of their rows.
    np.testing.assert_array_equal(scans(found)[1].ranges_m, np.float32([2.0, np.inf, np.nan, 2.0]))
    assert scans(found)[1].stamp_s == pytest.approx(START_S + 0.1)


def test_a_session_or_a_room_of_a_database_has_a_path(tmp_path: Path) -> None:
    folder = write_database(tmp_path, ("alma-s1", "anto-s1"))
    with pytest.raises(DatasetError, match="holds several sessions; there are alma-s1, anto-s1: give"):
        open_dataset(folder)
    with pytest.raises(DatasetError, match="has no session 'anta-s1'; there are"):
        open_dataset(folder / "anta-s1")
    assert read(folder / "anto-s1")[0][0].stamp_s == pytest.approx(START_S + 1000)
    assert len(read(folder / "anto-s1")[0]) == 4
    assert len(read(folder / "anto-s1" / "bedroom1")[0]) == 2
    with pytest.raises(DatasetError, match="no usable frame"):
        read(folder / "anto-s1" / "garage")


def test_damage_in_a_database_is_counted(tmp_path: Path) -> None:
    folder = write_database(tmp_path)
    with sqlite3.connect(folder / "rh.db") as database:
        database.execute("update rh_raw set time_stamp = 'noon' where id = 10")
        database.execute(
            "update rh_raw_scans set scan = 'far' where sensor_observation_id = 11 and shot_id = 0"
        )
        database.execute("update rh2_old2new_rgbd_files set new_file_1 = null where id = 20")
    database.close()
    found, dataset = read(folder)
    assert dropped(dataset) == {BAD_TIME: 1, NO_FILES: 1}
    assert np.isnan(scans(found)[0].ranges_m[0])
    assert len(frames(found)) == 1
    assert NO_COLOR not in dropped(dataset)


def test_another_database_or_a_damaged_one_is_refused_in_one_line(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "other.db") as database:
        database.execute("create table things (id)")
    database.close()
    (tmp_path / "damaged.db").write_bytes(b"SQLite format 3\0" + bytes(5000))
    for name, words in (("other.db", "no known format"), ("damaged.db", "cannot be read")):
        with pytest.raises(DatasetError, match=words) as caught:
            open_dataset(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(DatasetError, match="does not exist"):
        open_dataset(tmp_path / "session")  # and not that another file is damaged
