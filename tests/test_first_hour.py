"""What a newcomer tries first in Python: lists for arrays, paths for maps, names for settings, mistakes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fusion
import slam
from slam.cli.saved import Format
from slam.outputs.exports import FORMATS
from slam.simulation.synthetic_log import write_synthetic_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_log(tmp_path_factory.mktemp("hour") / "monday", seed=1, duration_s=10.0).log_path


@pytest.fixture(scope="module")
def house(log: Path) -> Path:
    slam.map_log(log, out=log.parent / "house").close()
    return log.parent / "house"


def scans(kind: object) -> list[slam.LaserScan]:
    """A robot that stands in a room of 6 m by 4 m; its ranges as a type or a list."""
    bearings = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    far = np.minimum(3.0 / np.abs(np.cos(bearings)), 2.0 / np.abs(np.sin(bearings) + 1e-9))
    given = far.tolist() if kind is list else far.astype(kind)
    return [slam.LaserScan(0.1 * n, given, -np.pi, np.pi / 180, 20.0) for n in range(3)]


IMAGE, LENS = np.zeros((4, 6, 3), np.uint8), slam.CameraIntrinsics(5.0, 5.0, 3.0, 2.0, 6, 4)


@pytest.mark.parametrize("kind", [list, np.float64, np.int64])
def test_ranges_of_any_numbers_are_mapped(kind: object) -> None:
    with slam.build_map(scans(kind)) as room, slam.build_map(scans(np.float32)) as same:
        assert room.grid is not None and same.grid is not None
        if kind is not np.int64:  # whole metres are another room
            assert (room.grid.steps == same.grid.steps).all()


@pytest.mark.parametrize(
    ("measurement", "stated"),
    [
        (
            slam.LaserScan(0.0, np.ones((3, 3)), 0.0, 0.1, 9.0),
            r"ranges_m is float64\[3, 3\]; give numbers of shape \(N\)",
        ),
        (slam.LaserScan(0.0, ["near"], 0.0, 0.1, 9.0), r"ranges_m is <U4\[1\]"),
        (
            slam.WheelOdometry(0.0, (1, 2, 0)),
            r"its T_odom_base cannot be: \(1, 2, 0\); help\(slam.WheelOdometry\)",
        ),
        (
            slam.PointCloud(0.0, [1.0, 2.0, 3.0]),
            r"points_lidar is float64\[3\]; give numbers of shape \(N, 3\)",
        ),
        (slam.LaserScan(math.nan, np.ones(3), 0.0, 0.1, 9.0), "its stamp_s cannot be: nan"),
        (slam.LaserScan(0.0, np.ones(0), 0.0, 0.1, 9.0), r"its ranges_m cannot be: float32\[0\]"),
        (slam.LaserScan(0.0, np.ones(3), 0.1, -0.1, 9.0), "its step_rad cannot be: -0.1"),
        (slam.LaserScan(0.0, np.ones(360), 0.0, 1.0, 9.0), "its beams span 359 rad"),
        (slam.LaserScan(0.0, np.ones(3), 0.0, 0.1, 0.0), "its range_max_m cannot be: 0.0"),
        (
            slam.RgbdFrame(0.0, IMAGE, np.ones((6, 8)), LENS),
            r"colour .*, depth \(6, 8\), lens",
        ),
        (
            slam.RgbdFrame(0.0, IMAGE.transpose(2, 0, 1), np.ones((4, 6)), LENS),
            r"color is uint8\[3, 4, 6\]; give numbers of shape \(N, N, 3\)",
        ),
        (slam.RgbdFrame(0.0, IMAGE, np.full((4, 6), 900, np.uint16), LENS), "depth_m is uint16"),
        (
            slam.RgbdFrame(0.0, IMAGE * 0 + 999 * np.ones(3, np.uint16), np.ones((4, 6)), LENS),
            "color is uint16",
        ),
        (slam.RgbdFrame(0.0, IMAGE, np.ones((4, 6)), replace(LENS, width=60)), r"colour .*, lens \(4, 60\)"),
    ],
)
def test_what_is_no_array_of_a_measurement_is_named(measurement: object, stated: str) -> None:
    with pytest.raises(slam.ScanweaveError, match=f"number 4: {stated}"):
        slam.build_map([*scans(np.float32), measurement])


def test_maps_are_given_by_their_paths(house: Path, log: Path) -> None:
    found = slam.localize_log(house, log)
    drawn = slam.localize_log(str(house / "map.yaml"), log)
    assert len(found.trajectory) == len(drawn.trajectory) == 51
    localizer = slam.Localizer(house / "map.db")
    outputs = [localizer.add(one) for one in slam.open_dataset(log)]
    assert any(one.state is slam.State.TRACKING for one in outputs if one is not None)
    with pytest.raises(slam.ScanweaveError, match=r"is already in .*map\.db"):
        slam.join(house, log)
    same = slam.diff_maps(house, str(house))
    assert (same.things, same.written) == ([], ())
    with pytest.raises(slam.ScanweaveError, match="no map at nowhere"):
        slam.localize_log("nowhere", log)


def test_settings_are_given_by_a_name(log: Path, tmp_path: Path) -> None:
    (tmp_path / "coarse.yaml").write_text("grid: {resolution_m: 0.2}\n")
    with slam.map_log(log, str(tmp_path / "coarse.yaml")) as coarse:
        assert coarse.config.grid.resolution_m == 0.2
    assert slam.load_config(overrides="grid.resolution_m=0.1").grid.resolution_m == 0.1
    with pytest.raises(
        slam.ScanweaveError, match=r"a dict is no configuration; give one by slam\.load_config"
    ):
        slam.map_log(log, {"grid": {}})


def test_a_map_is_scored_as_its_trajectory(house: Path) -> None:
    with slam.load_map(house) as map_:
        scores = slam.evaluate(map_, groundtruth=map_)
        assert scores["ate"]["translation_m"]["max"] < 1e-9 and scores["coverage"]["position"] == 1.0
        assert slam.evaluate(map_.trajectory, groundtruth=map_)["ate"] == scores["ate"]


def test_a_map_closes_itself(house: Path) -> None:
    with slam.load_map(house) as map_:
        map_.check()
    with pytest.raises(slam.ScanweaveError, match="closed"):
        map_.check()


def test_unknown_formats_are_refused_and_all_are_commands(house: Path, tmp_path: Path) -> None:
    with (
        slam.load_map(house) as map_,
        pytest.raises(slam.ScanweaveError, match=r"no format 'pdf'"),
    ):
        map_.export("pdf", tmp_path / "map.pdf")
    assert not (tmp_path / "map.pdf").exists()
    assert sorted(FORMATS) == sorted(one.value for one in Format)


def test_fusion_names_what_it_wants() -> None:
    curve = fusion.LidarCurve(np.ones(360), -np.pi, np.pi / 180)
    with pytest.raises(ValueError, match=r"depth is ndarray; give DepthImage"):
        fusion.register(curve, np.ones((4, 4)))
    image = fusion.DepthImage(np.ones((4, 4)), fusion.Intrinsics(4, 4, 2, 2))
    with pytest.raises(ValueError, match=r"scan is LaserScan; give LidarCurve"):
        fusion.register(scans(np.float32)[0], image)


def test_what_slam_lists_is_what_it_offers() -> None:
    assert {name for name in dir(slam) if not name.startswith("_")} == set(slam._HOMES)
