"""A recorded drive of the true sensors fits the true grid: poses, mounts and stamps hang together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
import yaml
from scipy import ndimage

from slam.datasets import open_dataset
from slam.measurements import LaserScan
from slam.simulation.drive_faults import DriveFaults
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS
from slam.simulation.sensor_models import XTION_PRO_LIVE

# The clocks are off, so that a mix-up of stamp and true time would show.
FAULTS = DriveFaults(lidar_clock_offset_s=0.7, camera_clock_offset_s=-0.4)
# Few pixels at a low rate: the slowest part of these tests is what the camera sees.
RIG = RIGS["turtlebot_low"]
RIG = replace(RIG, cameras=tuple(replace(camera, model=XTION_PRO_LIVE) for camera in RIG.cameras))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("real") / "drive"
    record_drive(generate_home(3), RIG, 5, out, FAULTS, 3.0, formats=("folder",))
    return out


def distance_to_truth_m(folder: Path, points_map: np.ndarray) -> np.ndarray:
    """From each point to the nearest occupied cell at the lidar's height."""
    grid = np.load(folder / "truth" / "grid_lidar.npz")
    away = ndimage.distance_transform_edt(~grid["occupied"]) * float(grid["resolution_m"])
    cells = np.floor((points_map[:, :2] - grid["origin_xy"]) / float(grid["resolution_m"])).astype(int)
    return away[cells[:, 1], cells[:, 0]]


def truth_of(folder: Path, sensor: str) -> dict[str, np.ndarray]:
    chunks = [np.load(path) for path in sorted((folder / "truth" / sensor).iterdir())]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0].files}


def test_sound_beams_end_on_obstacles(folder: Path) -> None:
    truth = truth_of(folder, "lidar")
    scans = [item for item in open_dataset(folder / "scans.log") if isinstance(item, LaserScan)]
    away = []
    for scan, stamp_s, xyt, fault in zip(
        scans, truth["stamp_s"], truth["T_map_base_xyt"], truth["fault"], strict=True
    ):
        assert scan.stamp_s == pytest.approx(stamp_s, abs=1e-6)
        laser = gtsam.Pose2(*xyt).compose(scan.T_base_laser)
        sound = np.isfinite(scan.ranges_m) & (fault == 0) & (scan.ranges_m < 3.0)
        angle = laser.theta() + scan.bearings_rad()[sound]
        ends = np.column_stack([np.cos(angle), np.sin(angle)]) * scan.ranges_m[sound, None]
        away.append(distance_to_truth_m(folder, ends + laser.translation()))
    assert np.mean(np.concatenate(away) <= 0.1) > 0.98


def test_sound_pixels_at_the_lidars_height_lie_on_the_same_obstacles(folder: Path) -> None:
    truth = truth_of(folder, "camera")
    calibration = yaml.safe_load((folder / "calibration.yaml").read_text())
    k, mount = calibration["intrinsics"], calibration["T_base_camera"]
    x, y, z, w = mount["quaternion_xyzw"]
    T_base_camera = gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(mount["translation_m"]))
    lines = [line.split() for line in (folder / "depth.txt").read_text().splitlines()[3:]]
    columns, rows = np.meshgrid(np.arange(k["width"]), np.arange(k["height"]))
    away = []
    for index in range(0, len(lines), 4):
        depth = (
            cv2.imread(str(folder / lines[index][1]), cv2.IMREAD_UNCHANGED) / calibration["depth_steps_per_m"]
        )
        sound = (depth > 0.0) & (truth["fault"][index] == 0)
        assert sound.mean() > 0.2
        d = depth[sound]
        camera = [(columns[sound] - k["cx"]) / k["fx"] * d, (rows[sound] - k["cy"]) / k["fy"] * d, d]
        T_map_camera = gtsam.Pose3(gtsam.Pose2(*truth["T_map_base_xyt"][index])).compose(T_base_camera)
        points = T_map_camera.matrix()[:3, :3] @ np.array(camera) + T_map_camera.translation()[:, None]
        height = RIG.lidar.T_base_laser.z()  # type: ignore[union-attr]
        away.append(distance_to_truth_m(folder, points.T[np.abs(points[2] - height) < 0.015]))
    assert len(np.concatenate(away)) > 500
    assert np.mean(np.concatenate(away) <= 0.1) > 0.95
