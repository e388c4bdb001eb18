"""Lenses and mountings of a bag from files beside it and from files that were given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bag_writing import Sent, image, info, scan, transforms, write_bag

from slam.config import load_config
from slam.datasets import open_dataset
from slam.datasets.dataset import WARNING
from slam.errors import DatasetError
from slam.measurements import RgbdFrame

COLOR, DEPTH = np.full((48, 64, 3), 90, np.uint8), np.full((48, 64), 2000, np.uint16)
CAMERA = [image("/camera/color/image_raw", COLOR, "rgb8"), image("/camera/depth/image_raw", DEPTH, "16UC1")]
INFO = """
image_width: 64
image_height: 48
camera_name: {name}
camera_matrix: {{rows: 3, cols: 3, data: [{focal}, 0, 32, 0, {focal}, 24, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""
URDF = """<robot name="r"><joint name="j" type="fixed"><parent link="base_link"/>
<child link="{child}"/><origin xyz="0.3 0 0.2" rpy="0 0 0"/></joint></robot>"""


def frame_of(log: Path, **more: Any) -> tuple[RgbdFrame, list[str]]:
    dataset = open_dataset(log, **more)
    frame = next(one for one in dataset if isinstance(one, RgbdFrame))
    list(dataset)
    return frame, list(dataset.report.notes)


def test_a_lens_beside_the_bag_is_found_and_reported(tmp_path: Path) -> None:
    log = write_bag(tmp_path / "log", "mcap", CAMERA)
    assert any(note.startswith(WARNING) and "assumed" in note for note in frame_of(log)[1])
    (tmp_path / "depth.yaml").write_text(INFO.format(name="depth_camera", focal=55.0))
    frame, notes = frame_of(log)
    assert frame.intrinsics.fx == 55.0
    assert "/camera/depth/image_raw: lens by depth.yaml" in notes
    assert not any("assumed" in note for note in notes)


@pytest.mark.parametrize("given", [False, True])
def test_two_lenses_that_differ_are_a_warning_with_both(tmp_path: Path, given: bool) -> None:
    log = write_bag(tmp_path / "log", "mcap", [*CAMERA, info("/camera/depth/camera_info", 64, 48, 50.0)])
    file = tmp_path / "depth.yaml"
    file.write_text(INFO.format(name="depth_camera", focal=55.0))
    frame, notes = frame_of(log, calibration=[file] if given else [])
    assert frame.intrinsics.fx == (55.0 if given else 50.0)
    (stated,) = [note for note in notes if note.startswith("warning")]
    assert "fx 55.0" in stated and "fx 50.0" in stated
    assert stated.endswith("that of depth.yaml is used" if given else "that of the bag is used")


def test_our_own_file_places_the_camera_and_shows_its_unit(tmp_path: Path) -> None:
    log = write_bag(tmp_path / "log", "mcap", CAMERA)
    (tmp_path / "calibration.yaml").write_text(
        "intrinsics: {fx: 60, fy: 60, cx: 32, cy: 24, width: 64, height: 48}\ndepth_steps_per_m: 500\n"
        "T_base_camera: {translation_m: [0.1, 0, 0.4], quaternion_xyzw: [-0.5, 0.5, -0.5, 0.5]}\n"
    )
    frame, notes = frame_of(log)
    assert frame.intrinsics.fx == 60.0 and np.allclose(frame.depth_m, 4.0)
    assert frame.T_base_camera is not None and np.allclose(frame.T_base_camera.translation(), [0.1, 0, 0.4])
    assert not any("not known" in note for note in notes)


def test_the_calibration_of_images_is_not_that_of_the_bag_beside_them(tmp_path: Path) -> None:
    """A simulated drive has both; by the unit of its images the depth of its bag was a fifth."""
    log = write_bag(tmp_path / "log", "mcap", CAMERA)
    for name in ("rgb.txt", "depth.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "calibration.yaml").write_text("depth_steps_per_m: 5000\n")
    assert np.allclose(frame_of(log)[0].depth_m, 2.0)


def scan_mount(log: Path, **more: Any) -> tuple[gtsam.Pose2, list[str]]:
    dataset = open_dataset(log, **more)
    (found,) = dataset
    return found.T_base_laser, list(dataset.report.notes)


def robot(tmp_path: Path, *sent: Sent) -> Path:
    return write_bag(tmp_path / "log", "mcap", [*sent, scan()])


def test_a_urdf_beside_the_bag_places_a_scanner_where_no_tf_does(tmp_path: Path) -> None:
    log = robot(tmp_path)
    (tmp_path / "robot.urdf").write_text(URDF.format(child="laser"))
    mount, notes = scan_mount(log)
    assert mount.x() == pytest.approx(0.3) and "mountings by robot.urdf" in notes


@pytest.mark.parametrize("given", [False, True])
def test_a_urdf_and_tf_that_differ_are_a_warning_with_both(tmp_path: Path, given: bool) -> None:
    log = robot(tmp_path, transforms({"laser": gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0, 0.2]))}))
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(child="laser"))
    mount, notes = scan_mount(log, calibration=[file] if given else [])
    assert mount.x() == pytest.approx(0.3 if given else 0.1)
    (stated,) = [note for note in notes if note.startswith("warning")]
    assert "x 0.300" in stated and "x 0.100" in stated


def test_a_camchain_places_the_camera_by_the_topics_in_it(tmp_path: Path) -> None:
    laser = transforms({"laser": gtsam.Pose3(), "imu_link": gtsam.Pose3()})
    log = write_bag(tmp_path / "log", "mcap", [laser, scan(), *CAMERA])
    (tmp_path / "chain.yaml").write_text(
        "cam0: {camera_model: pinhole, intrinsics: [61, 61, 32, 24], distortion_model: none,\n"
        "  distortion_coeffs: [], resolution: [64, 48], rostopic: /camera/depth/image_raw}\n"
    )
    frame, _ = frame_of(log)
    assert frame.intrinsics.fx == 61.0


def test_a_file_that_was_given_and_helps_nothing_is_reported(tmp_path: Path) -> None:
    log, file = robot(tmp_path), tmp_path / "other" / "robot.urdf"
    file.parent.mkdir()
    file.write_text(INFO.format(name="depth", focal=50.0))
    _, notes = scan_mount(log, calibration=[file])
    assert "warning: robot.urdf describes no sensor that is read" in notes
    with pytest.raises(DatasetError, match="nowhere"):
        list(open_dataset(log, calibration=[tmp_path / "nowhere.yaml"]))


@pytest.mark.parametrize(
    ("text", "is_foreign"),
    [(INFO.format(name="a", focal=1.0), True), (URDF, True), ("wheels: {odometry: {scale: 2}}\n", False)],
)
def test_the_option_takes_either_sort_of_file(tmp_path: Path, text: str, is_foreign: bool) -> None:
    file = tmp_path / "file.yaml"
    file.write_text(text)
    sensors = load_config(calibration=file).sensors
    assert sensors.calibration_files == ((str(file),) if is_foreign else ())
    assert bool(sensors.calibration.wheels) == (not is_foreign)


def test_tf_whose_transforms_are_all_invalid_is_a_warning(tmp_path: Path) -> None:
    bad = transforms({"laser": gtsam.Pose3()})
    bad.fields["transforms"][0]["transform"]["rotation"]["w"] = 0.0
    _, notes = scan_mount(robot(tmp_path, bad))
    assert any(note.startswith("warning: /scan: tf has no mounting for it") for note in notes)


def test_a_scanner_that_tf_leaves_out_is_a_warning_until_a_file_places_it(tmp_path: Path) -> None:
    log = robot(tmp_path, transforms({"camera": gtsam.Pose3()}))
    _, notes = scan_mount(log)
    assert any(note.startswith("warning: /scan: tf has no mounting for it") for note in notes)
    (tmp_path / "robot.urdf").write_text(URDF.format(child="laser"))
    mount, notes = scan_mount(log)
    assert mount.x() == pytest.approx(0.3) and not any(note.startswith("warning") for note in notes)
