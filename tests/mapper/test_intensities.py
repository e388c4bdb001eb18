"""How bright the points of a 3D lidar are: from the log to the kept clouds and every file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import SMALL, T_BASE_LIDAR, look, look_on_the_way, way_round, write_log

from slam.config import load_config
from slam.config.clouds import CloudOdometryConfig
from slam.datasets import open_dataset
from slam.datasets.cloud_files import read_cloud
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.matching.cloud_points import at_middle_of_turn, base_points, usable_intensities
from slam.measurements import Float32Array, FloatArray
from slam.outputs.exports import Exports
from slam.storage.lidar_cloud_files import sixteen_bits

COUNT = 12


def brightness(points_map: FloatArray) -> FloatArray:
    """Of a place in the room: dark floor and low walls, bright above."""
    return np.where(points_map[:, 2] < 0.4, 20.0, 100.0)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> MapResult:
    clouds, poses = [], way_round(3 * COUNT)[:COUNT]
    for n, pose in enumerate(poses):
        cloud, T = look(pose, 0.1 * n, seed=n), pose.compose(T_BASE_LIDAR).matrix()
        bright = brightness(cloud.points_lidar @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        clouds.append(replace(cloud, intensities=bright))
    folder = write_log(tmp_path_factory.mktemp("room") / "log", clouds, poses)
    return build_map(open_dataset(folder), load_config(None, SMALL))


def stated_right(points: FloatArray | Float32Array, bright: FloatArray | Float32Array) -> float:
    """Share of points away from the border that are as bright as they were."""
    clear = np.abs(points[:, 2] - 0.4) > 0.05
    return float((brightness(points)[clear] == bright[clear]).mean())


def test_kept_clouds_show_it(mapped: MapResult) -> None:
    clouds = mapped.map.clouds
    assert clouds is not None and len(clouds) > 2
    for key in range(len(clouds)):
        bright = clouds.intensities(key)
        assert bright is not None and stated_right(clouds.points(key), bright) == 1.0


def test_every_file_shows_it(mapped: MapResult, tmp_path: Path) -> None:
    exports = Exports(mapped.map, load_config(None, SMALL))
    for format_, change in (("ply", None), ("pcd", None), ("las", sixteen_bits)):
        if format_ == "las":
            pytest.importorskip("laspy")
        (path, *_) = exports.write(format_, tmp_path / f"cloud.{format_}")
        found = read_cloud(path)
        bright = found.fields["intensity"] / (257.0 if change else 1.0)
        assert stated_right(found.points_lidar, bright) > 0.99


def test_each_usable_point_keeps_its_own() -> None:
    """Those out of range go with their points, and the turn is straightened as if there were none."""
    twist = np.array([0.0, 0.0, 0.5, 1.0, 0.0, 0.0])
    cloud = look_on_the_way(gtsam.Pose3(), twist, 0.0)
    config = CloudOdometryConfig(range_min_m=3.0)
    stated = at_middle_of_turn(replace(cloud, intensities=np.arange(len(cloud.points_lidar))), config)
    bright = usable_intensities(stated, config)
    assert bright is not None and len(bright) < len(cloud.points_lidar)
    kept = replace(cloud, points_lidar=cloud.points_lidar[bright], times_s=cloud.times_s[bright])
    wanted = base_points(at_middle_of_turn(kept, config), twist, config)
    np.testing.assert_allclose(base_points(stated, twist, config), wanted, atol=5e-3)
    assert usable_intensities(cloud, config) is None
