"""7-Scenes folders, small ones and the real kitchen."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
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
)

from slam.datasets import open_dataset
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH
from slam.datasets.image_files import DAMAGED
from slam.datasets.pose_files import BAD_MATRIX
from slam.errors import BadRecordError, DatasetError
from slam.measurements import CameraIntrinsics

REDKITCHEN = Path(__file__).parents[3] / "shared" / "data" / "rgbd" / "redkitchen"


def write_scene(folder: Path, numbers: tuple[int, ...] = (0, 1, 5)) -> Path:
    for number in numbers:
        stem = f"frame-{number:06d}"
        write_color(folder / f"{stem}.color.png", seed=number)
        steps = depth_image(number)
        steps[1] = 65535
        write_depth(folder / f"{stem}.depth.png", steps)
        pose = gtsam.Pose3(gtsam.Rot3.Ypr(0.1 * number, 0, 0), np.array([number, 2.0, 3.0])).matrix()
        pose[:3, :3] *= 0.9998
        np.savetxt(folder / f"{stem}.pose.txt", pose)
    return folder


def test_frames_keep_the_stamps_of_their_numbers(tmp_path: Path) -> None:
    found, dataset = read(write_scene(tmp_path))
    got = frames(found)
    assert [frame.stamp_s for frame in got] == [0.0, 1 / 30, 5 / 30]
    np.testing.assert_array_equal(got[2].color, color_image(5))
    expected = depth_image(5) / 1000.0
    expected[1] = 0.0
    np.testing.assert_array_equal(got[2].depth_m, expected.astype(np.float32))
    assert got[0].T_base_camera is None
    assert got[0].intrinsics.fx == pytest.approx(585 * WIDTH / 640)
    assert any("585" in note for note in dataset.report.notes)
    assert not dropped(dataset)


def test_the_camera_matrix_beside_the_frames_is_used(tmp_path: Path) -> None:
    write_scene(tmp_path)
    np.savetxt(tmp_path / "camera-intrinsics.txt", [[60, 0, 30], [0, 61, 20], [0, 0, 1]])
    found, dataset = read(tmp_path)
    assert frames(found)[0].intrinsics == CameraIntrinsics(60, 61, 30, 20, WIDTH, HEIGHT)
    assert not dataset.report.notes
    (tmp_path / "camera-intrinsics.txt").write_text("60 0 30\n0 61")
    with pytest.raises(DatasetError, match=r"camera-intrinsics\.txt.*correct"):
        read(tmp_path)


def test_poses_become_true_rotations_and_bad_ones_are_left_out(tmp_path: Path) -> None:
    write_scene(tmp_path, (0, 1, 2, 3, 4))
    (tmp_path / "frame-000002.pose.txt").write_text("1 0 0 0 0 1 0")
    np.savetxt(tmp_path / "frame-000003.pose.txt", np.diag([1.0, 1.0, -1.0, 1.0]))
    np.savetxt(tmp_path / "frame-000004.pose.txt", np.full((4, 4), np.nan))
    truth = open_dataset(tmp_path).groundtruth()
    assert truth is not None
    assert truth.stamps_s.tolist() == [0.0, 1 / 30]
    np.testing.assert_allclose(truth.positions_m[1], [1, 2, 3])
    np.testing.assert_allclose(truth.quaternions_xyzw[1], [0, 0, np.sin(0.05), np.cos(0.05)], atol=1e-12)
    with pytest.raises(BadRecordError, match=BAD_MATRIX):
        open_dataset(tmp_path, strict=True).groundtruth()


def test_a_frame_with_half_its_images_or_a_cut_one_is_counted(tmp_path: Path) -> None:
    write_scene(tmp_path, (0, 1, 2, 3))
    (tmp_path / "frame-000001.depth.png").unlink()
    (tmp_path / "frame-000002.color.png").unlink()
    cut = tmp_path / "frame-000003.depth.png"
    cut.write_bytes(cut.read_bytes()[:100])
    found, dataset = read(tmp_path)
    assert len(frames(found)) == 1
    assert dropped(dataset) == {NO_DEPTH: 1, NO_COLOR: 1, DAMAGED: 1}


def test_a_scene_of_sequences_says_which_to_give(tmp_path: Path) -> None:
    write_scene(tmp_path / "seq-01", (0,))
    write_scene(tmp_path / "seq-02", (0,))
    with pytest.raises(DatasetError, match="give one of seq-01, seq-02"):
        open_dataset(tmp_path)


def test_the_real_kitchen() -> None:
    if not REDKITCHEN.is_dir():
        pytest.skip(f"REAL LOG ABSENT, not tested: {REDKITCHEN}")
    dataset = open_dataset(REDKITCHEN, strict=True)
    count, valid = 0, 0.0
    for count, frame in enumerate(frames(list(_first(dataset, 40))), 1):
        assert frame.stamp_s == (count - 1) / 30
        assert frame.intrinsics == CameraIntrinsics(585, 585, 320, 240, 640, 480)
        assert 0.4 < frame.depth_m[frame.depth_m > 0].min() < frame.depth_m.max() < 5.0
        valid += float((frame.depth_m > 0).mean())
    assert count == 40
    assert 0.8 < valid / count < 0.95
    truth = dataset.groundtruth()
    assert truth is not None
    assert len(truth) == 500
    steps = np.linalg.norm(np.diff(truth.positions_m, axis=0), axis=1)
    assert steps.sum() == pytest.approx(3.98, abs=0.01)


def _first(dataset, count: int):
    for _, measurement in zip(range(count), dataset, strict=False):
        yield measurement


def test_an_info_file_gives_both_lenses_and_the_unit(tmp_path: Path) -> None:
    write_scene(tmp_path)
    one = "60 0 30 0 0 61 20 0 0 0 1 0 0 0 0 1"
    sizes = "".join(f"m_{kind}Width = {WIDTH}\nm_{kind}Height = {HEIGHT}\n" for kind in ("color", "depth"))
    lenses = f"m_calibrationColorIntrinsic = {one}\nm_calibrationDepthIntrinsic = {one}\n"
    (tmp_path / "_info.txt").write_text(f"{sizes}m_depthShift = 2000\n{lenses}")
    found, dataset = read(tmp_path)
    assert frames(found)[0].intrinsics == CameraIntrinsics(60, 61, 30, 20, WIDTH, HEIGHT)
    np.testing.assert_allclose(frames(found)[0].depth_m[2:], depth_image(0)[2:] / 2000.0, rtol=1e-6)
    assert not any("assumed" in note for note in dataset.report.notes)
    for wrong in ("m_depthShift = 0", "m_depthShift = x", ""):
        (tmp_path / "_info.txt").write_text(f"{sizes}{wrong}\n{lenses}")
        with pytest.raises(DatasetError, match=r"_info\.txt gives no lens"):
            read(tmp_path)
