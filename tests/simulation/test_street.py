"""A drive through streets: its files, read by the product's readers, against the truth and the labels."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.datasets import open_dataset
from slam.measurements import Float32Array, FloatArray, PointCloud
from slam.simulation.sensor_clock import generator
from slam.simulation.street import STREET_FAULTS, STREET_RIGS, StreetFaults, record_street
from slam.simulation.street_drive import drive_street
from slam.simulation.street_mesh import Label
from slam.simulation.street_plan import generate_town
from slam.storage.tum import read_tum

HOME, SEED, SECONDS = 2, 1, 0.5


def recorded(folder: Path, faults: StreetFaults = STREET_FAULTS["harsh"], **options: bool) -> Path:
    record_street(HOME, SEED, folder, STREET_RIGS["car16"], faults, SECONDS, **options)
    return folder


def clouds_of(path: Path) -> list[PointCloud]:
    return [reading for reading in open_dataset(path) if isinstance(reading, PointCloud)]


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("street") / "still", STREET_FAULTS["none"], undistorted=True)


def in_the_map(folder: Path, points: Float32Array, stamp_s: float) -> FloatArray:
    truth = read_tum(folder / "groundtruth.txt")
    nearest = int(np.argmin(np.abs(truth.stamps_s - stamp_s)))
    turned: FloatArray = Rotation.from_quat(truth.quaternions_xyzw[nearest]).apply(points)
    return turned + truth.positions_m[nearest]


def test_the_car_keeps_to_the_road_and_never_jumps() -> None:
    town = generate_town(HOME)
    drive = drive_street(town, generator(SEED, "street", HOME))
    times_s = np.linspace(0.0, 60.0, 6001)
    rotations, positions = drive.poses_at(times_s)
    off_x = np.abs(positions[:, None, 0] - town.across_x).min(axis=1)
    off_y = np.abs(positions[:, None, 1] - town.across_y).min(axis=1)
    assert np.minimum(off_x, off_y).max() < 3.2
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 0.01
    assert 6.0 < speed.max() < 8.5
    assert np.abs(np.diff(speed)).max() < 0.05
    turn = np.diff(np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))) / 0.01
    assert 0.6 < np.abs(turn).max() < 1.2
    assert np.degrees(np.arccos(rotations[:, 2, 2])).max() > 1.0


def test_undistorted_clouds_lie_on_the_ground_of_the_plan(still: Path) -> None:
    ground = generate_town(HOME).ground
    stamps = np.loadtxt(still / "times.txt")
    for number in (0, 4):
        rows = np.fromfile(still / "velodyne" / f"{number:06d}.bin", "<f4").reshape(-1, 4)
        label = np.fromfile(still / "labels" / f"{number:06d}.label", "<u4")
        world = in_the_map(still, rows[:, :3], stamps[number])[label == Label.ROAD]
        off = world[:, 2] - ground.height_m(world[:, 0], world[:, 1])
        assert len(off) > 1000
        assert np.abs(off).mean() < 0.03
        assert 0.0 < rows[:, 3].min() < rows[:, 3].max() <= 1.0


def test_the_bag_shows_the_times_and_the_folder_the_poses(still: Path) -> None:
    bag = clouds_of(still / "log.mcap")
    assert len(bag) == 5
    assert bag[0].times_s is not None
    assert bag[0].times_s.min() >= 0.0 and bag[0].times_s.max() == pytest.approx(0.1, abs=1e-3)
    truth = read_tum(still / "groundtruth.txt").positions_m
    poses = np.loadtxt(still / "poses.txt").reshape(-1, 3, 4)
    moved = math.dist(truth[5], truth[45])
    assert np.linalg.norm(poses[4, :, 3] - poses[0, :, 3]) == pytest.approx(moved, abs=1e-6)
    assert poses[4, 2, 3] > 0.9 * moved  # KITTI's z looks ahead


def test_traffic_is_labelled_and_hides_what_is_behind(still: Path, tmp_path: Path) -> None:
    busy = recorded(tmp_path / "busy", StreetFaults(density=9.0), undistorted=True)
    labels = [np.fromfile(path, "<u4") for path in sorted((busy / "labels").iterdir())]
    kinds = set((np.concatenate(labels) & 0xFFFF).tolist())
    assert {Label.MOVING_CAR, Label.MOVING_PERSON} <= kinds
    # The car in front is on all turns, and under the same number.
    numbers = [{int(one) for one in label if one & 0xFFFF == Label.MOVING_CAR} for label in labels]
    assert set.intersection(*numbers)
    empty = np.fromfile(still / "labels" / "000000.label", "<u4")
    assert (empty & 0xFFFF).max() < Label.MOVING_CAR


def test_a_tunnel_is_a_straight_road_and_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = (recorded(tmp_path / name, tunnel=True) for name in ("a", "b"))
    for path in sorted(first.rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (second / path.relative_to(first)).read_bytes()
    town = generate_town(HOME, tunnel=True)
    assert town.tunnel_m is not None and np.diff(town.tunnel_m)[0] == 200.0
