"""Lenses and mountings from files as other tools write them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.datasets.bags.lens import Lens
from slam.datasets.calibration_files import contradiction, known_beside
from slam.errors import DatasetError

CAMERA_INFO = """
image_width: 640
image_height: 480
camera_name: rgb_PS1080
camera_matrix: {rows: 3, cols: 3, data: [600.5, 0, 320.5, 0, 601.5, 240.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [610, 0, 321, 0, 0, 611, 241, 0, 0, 0, 1, 0]}
"""
PRINTED_INFO = """
header: {stamp: {sec: 1, nanosec: 2}, frame_id: camera_color_optical_frame}
height: 480
width: 640
distortion_model: plumb_bob
d: [0.0, 0.0, 0.0, 0.0, 0.0]
k: [600.5, 0, 320.5, 0, 601.5, 240.5, 0, 0, 1]
---
"""
CAMCHAIN = """
cam0:
  camera_model: pinhole
  intrinsics: [600.5, 601.5, 320.5, 240.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  T_cam_imu: [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]
  rostopic: /camera/color/image_raw
  resolution: [640, 480]
cam1:
  camera_model: pinhole
  intrinsics: [300.5, 301.5, 160.5, 120.5]
  distortion_model: equidistant
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  T_cn_cnm1: [[1, 0, 0, -0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  rostopic: /camera/depth/image_raw
  resolution: [320, 240]
"""
ORB_SLAM = "%YAML:1.0\n---\nCamera.fx: 600.5\nCamera.fy: 601.5\nCamera.cx: 320.5\nCamera.cy: 240.5\n"
ORB_SLAM += "Camera.k1: 0.1\nCamera.k2: 0.0\nCamera.p1: 0.0\nCamera.p2: 0.0\nDepthMapFactor: 5000.0\n"
OWN = "intrinsics: {fx: 600.5, fy: 601.5, cx: 320.5, cy: 240.5, width: 640, height: 480}\n"
URDF = """<?xml version="1.0"?>
<robot name="r">
  <link name="base_link"/><link name="camera_link"/><link name="optical"/>
  <joint name="a" type="fixed"><parent link="base_link"/><child link="camera_link"/>
    <origin xyz="0.1 0.2 0.3" rpy="0 0 1.5707963267948966"/></joint>
  <joint name="b" type="fixed"><origin rpy="-1.5707963 0 -1.5707963"/>
    <parent link="camera_link"/><child link="optical"/></joint>
</robot>
"""
PRINTED_TF = """
transforms:
- header: {stamp: {sec: 0, nanosec: 0}, frame_id: base_link}
  child_frame_id: laser
  transform:
    translation: {x: 0.25, y: 0.0, z: 0.1}
    rotation: {x: 0.0, y: 0.0, z: 1.0, w: 0.0}
---
"""


def opencv_text(suffix: str) -> str:
    """What OpenCV itself writes."""
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[600.5, 0, 320.5], [0, 601.5, 240.5], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", np.array([[0.1, -0.2, 0.001, 0.002, 0.0]]))
    return str(storage.releaseAndGetString())


@pytest.mark.parametrize(
    ("name", "text", "distorted"),
    [
        ("rgb.yaml", CAMERA_INFO, True),
        ("info.yaml", PRINTED_INFO, False),
        ("camchain.yaml", CAMCHAIN, True),
        ("TUM1.yaml", ORB_SLAM, True),
        ("calibration.yaml", OWN, False),
        ("opencv.yml", opencv_text(".yml"), True),
        ("opencv.xml", opencv_text(".xml"), True),
    ],
)
def test_a_lens_of_every_kind_of_file(tmp_path: Path, name: str, text: str, distorted: bool) -> None:
    (tmp_path / name).write_text(text)
    found = known_beside(tmp_path).lens("color", ["/camera/color/image_raw"], (640, 480))
    assert found is not None and found.lens is not None and found.source == name
    lens = found.lens.intrinsics
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (600.5, 601.5, 320.5, 240.5)
    assert bool(found.lens.distortion.size) == distorted and not found.lens.unknown_model


def test_which_of_two_lenses_is_whose(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    known = known_beside(tmp_path)
    depth = known.lens("depth", ["camera/depth/image_raw"])
    assert depth is not None and depth.lens is not None
    assert depth.lens.intrinsics.fx == 300.5 and depth.lens.fisheye
    # By its name; another of the size of the colour camera is not the colour camera.
    assert known.lens("depth", ["/another"]) is depth
    assert known.lens("depth", ["/another"], (640, 480)) is None


def test_mountings_of_every_kind_of_file(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    (tmp_path / "tf.yaml").write_text(PRINTED_TF)
    (tmp_path / "chain.yaml").write_text(CAMCHAIN)
    found = {(one.parent, one.child): one.pose for one in known_beside(tmp_path).transforms}
    assert np.allclose(found["base_link", "camera_link"].translation(), [0.1, 0.2, 0.3])
    assert found["base_link", "camera_link"].rotation().yaw() == pytest.approx(np.pi / 2)
    # The optical axis, z, looks along the x of the body.
    assert np.allclose(found["camera_link", "optical"].rotation().matrix()[:, 2], [1, 0, 0], atol=1e-6)
    assert np.allclose(found["base_link", "laser"].translation(), [0.25, 0.0, 0.1])
    assert np.allclose(found["cam0", "imu"].translation(), [0.1, 0.2, 0.3])
    assert np.allclose(found["cam1", "cam0"].translation(), [-0.05, 0, 0])


def test_a_file_that_was_given_must_show_something_and_comes_first(tmp_path: Path) -> None:
    log, given = tmp_path / "log", tmp_path / "mine.yaml"
    log.mkdir()
    (log / "rgb.yaml").write_text(CAMERA_INFO)
    given.write_text(CAMERA_INFO.replace("600.5", "555.5"))
    found = known_beside(log, [given]).lens("color")
    assert found is not None and found.lens is not None and found.lens.intrinsics.fx == 555.5
    given.write_text("title: a recipe\n")
    with pytest.raises(DatasetError, match="neither lens"):
        known_beside(log, [given])


@pytest.mark.parametrize("text", [CAMERA_INFO.replace("600.5", ".nan"), CAMCHAIN.replace("600.5", "none")])
def test_a_damaged_file_is_reported_and_refused_where_it_was_given(tmp_path: Path, text: str) -> None:
    log, file = tmp_path / "log", tmp_path / "log" / "a.yaml"
    log.mkdir()
    file.write_text(text)
    known = known_beside(log)
    assert not known.cameras and "a.yaml" in known.notes[0]
    with pytest.raises(DatasetError, match=r"a\.yaml"):
        known_beside(log, [file])


def test_strangers_files_beside_a_recording_show_nothing(tmp_path: Path) -> None:
    for name, text in {
        "notes.yaml": "- a\n- b\n",
        "broken.yaml": "a: [",
        "bomb.xml": '<!DOCTYPE a [<!ENTITY b "c">]><robot>&b;</robot>',
        "half.urdf": "<robot><joint>",
        "metadata.yaml": CAMERA_INFO,
    }.items():
        (tmp_path / name).write_text(text)
    known = known_beside(tmp_path)
    assert not known.cameras and not known.transforms


def test_a_contradiction_shows_both_values() -> None:
    from slam.measurements import CameraIntrinsics

    one = Lens(CameraIntrinsics(600.0, 600.0, 320.0, 240.0, 640, 480), np.zeros(0))
    half = Lens(CameraIntrinsics(300.2, 300.2, 160.0, 120.0, 320, 240), np.zeros(0))
    other = Lens(CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480), np.zeros(0))
    assert contradiction("/image", (one, "a.yaml"), (half, "the bag")) == ""
    stated = contradiction("/image", (one, "a.yaml"), (other, "the bag"))
    assert "600.0" in stated and "525.0" in stated and "a.yaml" in stated and "the bag" in stated


@pytest.mark.parametrize(
    "text", [CAMERA_INFO, CAMCHAIN, ORB_SLAM, OWN, URDF, PRINTED_TF, opencv_text(".yml"), opencv_text(".xml")]
)
def test_damage_is_reported_in_a_line_or_ignored(tmp_path: Path, text: str) -> None:
    rng = np.random.default_rng(5)
    for number in range(200):
        damaged = list(text)
        for _ in range(rng.integers(1, 4)):
            at, kind = int(rng.integers(len(damaged))), int(rng.integers(3))
            if kind == 0:
                damaged[at] = chr(int(rng.integers(1, 0x250)))
            elif kind == 1:
                damaged[at : at + int(rng.integers(1, 9))] = list(
                    str(rng.choice(["9" * 400, "-1", "[", ": ", "nan"]))
                )
            else:
                del damaged[at : at + int(rng.integers(1, 60))]
        (tmp_path / "calibration.yaml").write_text("".join(damaged), encoding="utf-8", errors="replace")
        try:
            known_beside(tmp_path)
        except DatasetError as error:
            assert "\n" not in str(error), number
