"""TUM folders: what is read, what is counted, what is assumed."""

from __future__ import annotations

import os
import shutil
import threading
import tracemalloc
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rgbd_files import (
    HEIGHT,
    WIDTH,
    color_image,
    depth_image,
    dropped,
    frames,
    read,
    write_color,
    write_depth,
    write_tum,
)

from slam.datasets import open_dataset
from slam.datasets.calibration import OTHER_ASPECT
from slam.datasets.camera_frames import SIZE_CHANGED, SIZES_DIFFER
from slam.datasets.frame_pairs import NO_DEPTH
from slam.datasets.image_files import DAMAGED, MISSING, NOT_16_BIT
from slam.datasets.recording import fewer_frames
from slam.datasets.stamped_files import BAD_NAME, BAD_POSE, BAD_STAMP, WRONG_FIELDS
from slam.errors import BadRecordError, DatasetError
from slam.measurements import CameraIntrinsics, RgbdFrame
from slam.simulation.tum_writer import calibration, write_yaml


def test_frames_are_read_in_order_with_the_stamp_of_their_colour(tmp_path: Path) -> None:
    found, dataset = read(write_tum(tmp_path))
    got = frames(found)
    assert [frame.stamp_s for frame in got] == pytest.approx([100.0, 100.1, 100.2, 100.3])
    for k, frame in enumerate(got):
        np.testing.assert_array_equal(frame.color, color_image(k))
        np.testing.assert_array_equal(frame.depth_m, (depth_image(k) / 5000.0).astype(np.float32))
    assert got[0].T_base_camera is None
    assert got[0].sensor == "camera"
    assert not dropped(dataset)
    assert any("paired within 0.020 s" in note for note in dataset.report.notes)


def test_the_truth_lies_beside(tmp_path: Path) -> None:
    truth = open_dataset(write_tum(tmp_path)).groundtruth()
    assert truth is not None
    np.testing.assert_allclose(truth.positions_m, [[1, 2, 3], [1, 2, 4]])
    np.testing.assert_allclose(np.linalg.norm(truth.quaternions_xyzw, axis=1), 1.0, atol=1e-12)
    (tmp_path / "groundtruth.txt").unlink()
    assert open_dataset(tmp_path).groundtruth() is None


def test_a_damaged_truth_line_is_left_out_or_stops_a_strict_reading(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n3 x 0 0 0 0 0 1\n4 1 2\n")
    truth = open_dataset(tmp_path).groundtruth()
    assert truth is not None
    assert truth.stamps_s.tolist() == [1.0]
    with pytest.raises(BadRecordError, match=f"groundtruth.txt, record 2: {BAD_POSE}"):
        open_dataset(tmp_path, strict=True).groundtruth()


@pytest.mark.parametrize(
    ("name", "focal", "assumed"),
    [("rgbd_dataset_freiburg1_desk", 517.3, False), ("freiburg3_x", 535.4, False), ("kitchen", 525.0, True)],
)
def test_intrinsics_by_the_name_of_the_folder_or_assumed_and_said(
    tmp_path: Path, name: str, focal: float, assumed: bool
) -> None:
    found, dataset = read(write_tum(tmp_path / name, 1))
    lens = frames(found)[0].intrinsics
    assert lens.fx == pytest.approx(focal * WIDTH / 640)
    assert (lens.width, lens.height) == (WIDTH, HEIGHT)
    stated = [note for note in dataset.report.warnings if "intrinsics assumed" in note]
    assert bool(stated) == assumed and all("5000 depth steps" in note for note in stated)
    assert assumed != any("published for" in note for note in dataset.report.notes)
    if assumed:
        # The middle of the image stays the middle: pixel centres are whole numbers.
        assert (lens.cx, lens.cy) == pytest.approx((0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)))


def test_the_simulators_calibration_is_read_back(tmp_path: Path) -> None:
    write_tum(tmp_path, 1)
    lens = CameraIntrinsics(60.0, 61.0, 31.0, 24.0, WIDTH, HEIGHT)
    mount = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.2, 0.1), np.array([0.1, 0.2, 0.3]))
    write_yaml(tmp_path / "calibration.yaml", {**calibration(lens, mount), "depth_steps_per_m": 1000.0})
    found, dataset = read(tmp_path)
    frame = frames(found)[0]
    assert frame.intrinsics == lens
    assert frame.T_base_camera is not None
    assert frame.T_base_camera.equals(mount, 1e-9)
    np.testing.assert_allclose(frame.depth_m, depth_image() / 1000.0, rtol=1e-6)
    assert not any("assumed" in note for note in dataset.report.notes)


@pytest.mark.parametrize(
    "content",
    [
        "intrinsics: {fx: 0, fy: 1, cx: 1, cy: 1}",
        "intrinsics: {fx: 500, fy: 500, cx: 1}",
        "intrinsics: {fx: wide, fy: 500, cx: 1, cy: 1}",
        "intrinsics: [1, 2, 3, 4]",
        "depth_steps_per_m: -5000",
        "T_base_camera: {translation_m: [0, 0, 0], quaternion_xyzw: [0, 0, 0, 2]}",
        "T_base_camera: {translation_m: [0, .nan, 0], quaternion_xyzw: [0, 0, 0, 1]}",
        "just text",
        "{",
    ],
)
def test_a_wrong_calibration_is_an_error_in_one_line(tmp_path: Path, content: str) -> None:
    write_tum(tmp_path, 1)
    (tmp_path / "calibration.yaml").write_text(content)
    with pytest.raises(DatasetError, match=r"calibration\.yaml.*(correct|remove)") as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_calibration_of_another_aspect_costs_every_frame_but_a_larger_one_is_scaled(tmp_path: Path) -> None:
    write_tum(tmp_path, 2)
    pose = gtsam.Pose3()
    write_yaml(
        tmp_path / "calibration.yaml", calibration(CameraIntrinsics(500, 500, 319.5, 239.5, 640, 480), pose)
    )
    assert frames(read(tmp_path)[0])[0].intrinsics == CameraIntrinsics(50, 50, 31.5, 23.5, WIDTH, HEIGHT)
    write_yaml(
        tmp_path / "calibration.yaml", calibration(CameraIntrinsics(500, 500, 320, 180, 640, 360), pose)
    )
    with pytest.raises(DatasetError, match=f"no usable frame.*2 x {OTHER_ASPECT}"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["associations.txt", "associate.txt"])
@pytest.mark.parametrize("depth_first", [False, True])
def test_a_list_of_associations_will_do(tmp_path: Path, name: str, depth_first: bool) -> None:
    write_tum(tmp_path, 2)
    for index in ("rgb.txt", "depth.txt"):
        (tmp_path / index).unlink()
    halves = [[f"{k}.0 rgb/{k}.png", f"{k}.001 depth/{k}.png"] for k in range(2)]
    lines = [" ".join(reversed(half) if depth_first else half) for half in halves]
    (tmp_path / name).write_text("\n".join(lines))
    got = frames(read(tmp_path)[0])
    assert [frame.stamp_s for frame in got] == [0.0, 1.0]
    np.testing.assert_array_equal(got[1].color, color_image(1))


def spoil_missing(folder: Path) -> None:
    (folder / "depth/1.png").unlink()


def spoil_cut(folder: Path) -> None:
    path = folder / "rgb/1.png"
    path.write_bytes(path.read_bytes()[:-40])


def spoil_8_bit(folder: Path) -> None:
    write_depth(folder / "depth/1.png", (depth_image() >> 8).astype(np.uint8))


def spoil_aspect(folder: Path) -> None:
    write_color(folder / "rgb/1.png", color_image(1, WIDTH, HEIGHT - 8))


def spoil_size(folder: Path) -> None:
    write_color(folder / "rgb/1.png", color_image(1, 2 * WIDTH, 2 * HEIGHT))
    write_depth(folder / "depth/1.png", depth_image(1, 2 * WIDTH, 2 * HEIGHT))


def spoil_list(folder: Path) -> None:
    index = folder / "depth.txt"
    index.write_text("\n".join(line for line in index.read_text().splitlines() if "/1.png" not in line))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (spoil_missing, MISSING),
        (spoil_cut, DAMAGED),
        (spoil_8_bit, NOT_16_BIT),
        (spoil_aspect, SIZES_DIFFER),
        (spoil_size, SIZE_CHANGED),
        (spoil_list, NO_DEPTH),
    ],
)
def test_a_bad_frame_is_counted_and_costs_only_itself(tmp_path: Path, spoil, reason: str, capfd) -> None:
    spoil(write_tum(tmp_path))
    found, dataset = read(tmp_path)
    assert [frame.stamp_s for frame in frames(found)] == pytest.approx([100.0, 100.2, 100.3])
    assert dropped(dataset) == {reason: 1}
    assert dataset.report.dropped[reason].lines == [3]
    with pytest.raises(BadRecordError, match=f"record 3: {reason}.*--strict") as caught:
        read(tmp_path, strict=True)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_colour_of_another_size_but_the_same_aspect_is_resized_and_it_is_said(tmp_path: Path) -> None:
    write_tum(tmp_path, 1)
    write_color(tmp_path / "rgb/0.png", np.full((2 * HEIGHT, 2 * WIDTH, 3), 90, np.uint8))
    found, dataset = read(tmp_path)
    assert frames(found)[0].color.shape == (HEIGHT, WIDTH, 3)
    assert (frames(found)[0].color == 90).all()
    assert any("resized" in note and "128 x 96" in note for note in dataset.report.notes)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("100.05", WRONG_FIELDS),
        ("nan rgb/0.png", BAD_STAMP),
        ("1e300 rgb/0.png", BAD_STAMP),
        ("rgb/0.png 100.05", BAD_STAMP),
        ("100.05 a\0b", BAD_NAME),
        ("100.05 rgb/no such.png", NO_DEPTH),
    ],
)
def test_a_damaged_line_of_a_list_is_counted(tmp_path: Path, line: str, reason: str) -> None:
    write_tum(tmp_path)
    with (tmp_path / "rgb.txt").open("a") as index:
        index.write(line + "\n")
    found, dataset = read(tmp_path)
    assert len(frames(found)) == 4
    assert dropped(dataset) == {reason: 1}


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(
    junk=st.binary(max_size=30),
    at=st.integers(0, 200),
    name=st.sampled_from(["rgb.txt", "depth.txt", "groundtruth.txt", "calibration.yaml"]),
)
def test_random_damage_of_any_list_is_survived(tmp_path: Path, junk: bytes, at: int, name: str) -> None:
    folder = tmp_path / "log"
    if not folder.exists():
        write_tum(folder, 2)
    other = tmp_path / "damaged"
    shutil.rmtree(other, ignore_errors=True)
    shutil.copytree(folder, other, copy_function=os.link)
    content = (folder / name).read_bytes() if (folder / name).exists() else b"depth_steps_per_m: 5000\n"
    (other / name).unlink(missing_ok=True)
    (other / name).write_bytes(content[:at] + junk + content[at + len(junk) :])
    try:
        dataset = open_dataset(other)
        for frame in dataset:
            assert isinstance(frame, RgbdFrame)
            assert np.isfinite(frame.stamp_s)
            assert frame.color.shape[:2] == frame.depth_m.shape
        dataset.groundtruth()
    except DatasetError as error:
        assert not isinstance(error, BadRecordError)
        assert "\n" not in str(error)


def test_a_folder_without_what_it_needs_is_refused_in_one_line(tmp_path: Path) -> None:
    for folder, words in (
        ("absent", "does not exist"),
        ("empty", "empty folder"),
        ("half", "both rgb.txt and"),
    ):
        path = tmp_path / folder
        if folder != "absent":
            path.mkdir()
        if folder == "half":
            (path / "rgb.txt").write_text("1 rgb/1.png\n")
        with pytest.raises(DatasetError, match=words) as caught:
            open_dataset(path)
        assert "\n" not in str(caught.value)
    shutil.rmtree(write_tum(tmp_path / "bare") / "rgb")
    with pytest.raises(DatasetError, match=f"no usable frame.*4 x {MISSING}.*images or clouds in place"):
        read(tmp_path / "bare")
    write_tum(tmp_path / "full")
    with pytest.raises(DatasetError, match="holds some; give one of bare, full"):
        open_dataset(tmp_path)


def test_an_abandoned_reading_leaves_no_thread_and_a_second_pass_is_the_first_again(tmp_path: Path) -> None:
    dataset = open_dataset(write_tum(tmp_path, 8))
    stream = iter(dataset)
    next(stream)
    assert any(thread.name.startswith("prepare") for thread in threading.enumerate())
    del stream
    assert not any(thread.name.startswith("prepare") for thread in threading.enumerate())
    first = [m.stamp_s for m in dataset]
    report = repr(dataset.report)
    assert [m.stamp_s for m in dataset] == first
    assert repr(dataset.report) == report


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    def peak(count: int) -> int:
        folder = write_tum(tmp_path / str(count), 1)
        for name in ("rgb", "depth"):
            lines = [f"{k}.0 {name}/0.png" for k in range(count)]
            (folder / f"{name}.txt").write_text("\n".join(lines))
        dataset = open_dataset(folder)
        sum(1 for _ in dataset)
        tracemalloc.start()
        assert sum(1 for _ in dataset) == count
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    # A frame takes 21 kB, its lines in the lists less than 1.5 kB.
    assert peak(400) - peak(40) < 360 * 1500


def test_where_the_frames_that_were_chosen_are_damaged_others_are_read(tmp_path: Path) -> None:
    dataset = open_dataset(write_tum(tmp_path))
    for number in (0, 2):
        (tmp_path / f"depth/{number}.png").write_bytes(b"")
    with fewer_frames(dataset, lambda _, stamps_s: [number % 2 == 0 for number in range(len(stamps_s))]):
        assert [frame.stamp_s for frame in frames(list(dataset))] == pytest.approx([100.1, 100.3])
    for number in (1, 3):
        (tmp_path / f"depth/{number}.png").write_bytes(b"")
    with (
        fewer_frames(dataset, lambda _, stamps_s: [True] * len(stamps_s)),
        pytest.raises(DatasetError, match=f"4 x {DAMAGED}"),
    ):
        list(dataset)


def test_lists_may_be_parted_by_commas(tmp_path: Path) -> None:
    for name in ("rgb", "depth"):
        file = write_tum(tmp_path) / f"{name}.txt"
        file.write_text(file.read_text().replace(" ", ",").replace("\n", "\r\n"))
        found, dataset = read(tmp_path)
        assert len(frames(found)) == 4 and not dropped(dataset)
