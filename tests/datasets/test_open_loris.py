"""OpenLORIS-Scene folders with the publishers' calibration files, or without."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from rgbd_files import HEIGHT, WIDTH, dropped, frames, read, write_color, write_depth

from slam.datasets import open_dataset
from slam.datasets.open_loris import ASSUMED, ASSUMED_MOUNT, UNALIGNED
from slam.datasets.stamped_files import BAD_POSE
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, WheelOdometry

SENSORS = f"""%YAML:1.0
---
d400_color_optical_frame:
   sensor_type: camera
   fps: 30
   width: {WIDTH}
   height: {HEIGHT}
   model: pinhole
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 6.1e+01, 3.1e+01,
          6.2e+01, 2.3e+01 ]
"""
TRANSFORMS = """%YAML:1.0
---
trans_matrix:
   -
      parent_frame: base_link
      child_frame: laser
      matrix: !!opencv-matrix
         rows: 4
         cols: 4
         dt: d
         data: [ 1., 0., 0., 9., 0., 1., 0., 9., 0., 0., 1., 9., 0., 0., 0., 1. ]
   -
      parent_frame: base_link
      child_frame: d400_color_optical_frame
      matrix: !!opencv-matrix
         rows: 4
         cols: 4
         dt: d
         data: [ 0., 0., 1., 0.25, -1., 0., 0., -0.05, 0., -1., 0., 0.9, 0., 0., 0., 1. ]
"""


def write_loris(folder: Path, count: int = 3, depth: str = "aligned_depth") -> Path:
    lists: dict[str, list[str]] = {"color": ["#Time"], depth: ["#Time"]}
    for k in range(count):
        stamp_s = 1560000000.5 + 0.1 * k
        write_color(folder / "color" / f"{stamp_s:.6f}.png", seed=k)
        write_depth(folder / depth / f"{stamp_s + 0.001:.6f}.png", seed=k)
        lists["color"].append(f"{stamp_s:.6f} color/{stamp_s:.6f}.png")
        lists[depth].append(f"{stamp_s + 0.001:.6f} {depth}/{stamp_s + 0.001:.6f}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines))
    half = np.sin(0.25), np.cos(0.25)
    wheels = [f"{1560000000.45 + 0.1 * k} {k} 2 0 0 0 {half[0]} {half[1]} 1 0 0 0 0 0" for k in range(4)]
    (folder / "odom.txt").write_text("\n".join(["#Time px py", *wheels, "1560000001 nan 0 0 0 0 0 1", ""]))
    (folder / "groundtruth.txt").write_text("1560000000.5 1 2 0 0 0 0 1\n")
    return folder


def test_wheels_and_frames_with_the_publishers_calibration(tmp_path: Path) -> None:
    write_loris(tmp_path)
    (tmp_path / "sensors.yaml").write_text(SENSORS)
    (tmp_path / "trans_matrix.yaml").write_text(TRANSFORMS)
    found, dataset = read(tmp_path)
    assert [type(m).__name__[0] for m in found] == list("WWRWRWR")
    wheels = [m.T_odom_base for m in found if isinstance(m, WheelOdometry)]
    assert wheels[2].equals(gtsam.Pose2(2.0, 2.0, 0.5), 1e-9)
    frame = frames(found)[0]
    assert frame.intrinsics == CameraIntrinsics(61, 62, 31, 23, WIDTH, HEIGHT)
    assert frame.T_base_camera is not None
    np.testing.assert_allclose(frame.T_base_camera.translation(), [0.25, -0.05, 0.9])
    np.testing.assert_allclose(frame.T_base_camera.rotation().matrix() @ [0, 0, 1], [1, 0, 0])
    assert frame.depth_m.max() == pytest.approx(20.0, abs=0.1)
    assert dropped(dataset) == {BAD_POSE: 1}
    notes = " ".join(dataset.report.notes)
    assert not any(text in notes for text in (ASSUMED, ASSUMED_MOUNT, UNALIGNED))
    truth = dataset.groundtruth()
    assert truth is not None
    assert truth.positions_m.tolist() == [[1, 2, 0]]


def test_without_calibration_the_published_one_is_assumed_and_it_is_said(tmp_path: Path) -> None:
    found, dataset = read(write_loris(tmp_path, depth="depth"))
    frame = frames(found)[0]
    assert frame.intrinsics.fx == pytest.approx(611.451 * WIDTH / 848)
    assert frame.T_base_camera is not None
    # It looks ahead, upright, from a mast.
    assert frame.T_base_camera.rotation().matrix()[:, 2][0] > 0.99
    assert frame.T_base_camera.rotation().matrix()[:, 1][2] < -0.99
    assert frame.T_base_camera.z() == pytest.approx(0.916)
    notes = " ".join(dataset.report.notes)
    assert all(text in notes for text in (ASSUMED, ASSUMED_MOUNT, UNALIGNED))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("sensors.yaml", "d400_color_optical_frame: {width: 848}"),
        ("sensors.yaml", SENSORS.replace("6.2e+01", "")),
        ("sensors.yaml", SENSORS.replace("6.1e+01", "-6.1e+01")),
        ("trans_matrix.yaml", TRANSFORMS.replace("0.25,", "")),
        ("trans_matrix.yaml", TRANSFORMS.replace("-1., 0., 0., -0.05", "-3., 0., 0., -0.05")),
        ("trans_matrix.yaml", "trans_matrix: 5"),
    ],
)
def test_a_wrong_calibration_is_an_error_in_one_line(tmp_path: Path, name: str, content: str) -> None:
    (write_loris(tmp_path) / name).write_text(content)
    with pytest.raises(DatasetError, match=f"{name}.*correct") as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_folder_without_wheels_has_frames_only(tmp_path: Path) -> None:
    (write_loris(tmp_path) / "odom.txt").unlink()
    assert len(list(open_dataset(tmp_path))) == 3
