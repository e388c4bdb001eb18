"""Clouds for other programs, read as those read them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.datasets.pcd_points import read_pcd_points
from slam.datasets.ply_points import read_ply_points
from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import AnyFloatArray, BoolArray, Float32Array
from slam.storage import lidar_cloud_files
from slam.storage.lidar_cloud_files import (
    CLOUD_FORMATS,
    LidarCloud,
    export_cloud,
    sixteen_bits,
    write_lidar_cloud,
)
from slam.storage.ply import read_cloud_ply

COUNT = 400


@pytest.fixture
def cloud() -> LidarCloud:
    rng = np.random.default_rng(3)
    places = rng.uniform([-70.0, -20.0, -1.0], [60.0, 40.0, 9.0], (COUNT, 3)).astype(np.float32)
    normals = np.tile(np.array([[0.0, 0.6, 0.8]], np.float32), (COUNT, 1))
    bright = rng.integers(0, 256, COUNT).astype(np.float32)
    colors = rng.integers(0, 256, (COUNT, 3)).astype(np.uint8)
    halves = [
        ColoredCloud(places[part], colors[part], normals[part], bright[part])
        for part in (slice(COUNT // 3), slice(COUNT // 3, None))
    ]
    return LidarCloud(halves, low, None)


def low(points: Float32Array) -> BoolArray:
    return np.asarray(points[:, 2] < 0.0)


def column(cloud: LidarCloud, name: str) -> AnyFloatArray:
    return np.concatenate([getattr(part, name) for part in cloud.stays])


def test_las(cloud: LidarCloud, tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    (path,) = export_cloud("las", tmp_path, cloud)
    rows = laspy.read(path)
    np.testing.assert_allclose(np.asarray(rows.xyz), column(cloud, "points_map"), atol=6e-4)
    np.testing.assert_array_equal(np.asarray(rows.classification) == 2, low(column(cloud, "points_map")))
    np.testing.assert_array_equal(np.asarray(rows.green) // 257, column(cloud, "colors")[:, 1])
    np.testing.assert_array_equal(np.asarray(rows.intensity), 257 * column(cloud, "intensities"))
    before = path.read_bytes()
    export_cloud("las", path, cloud)
    assert path.read_bytes() == before


def test_pcd(cloud: LidarCloud, tmp_path: Path) -> None:
    (path,) = export_cloud("pcd", tmp_path / "mine.pcd", cloud)
    columns = read_pcd_points(path)
    np.testing.assert_array_equal(columns["x"], column(cloud, "points_map")[:, 0])
    np.testing.assert_array_equal(columns["normal_z"], column(cloud, "normals_map")[:, 2])
    np.testing.assert_array_equal(columns["rgb"] >> 16 & 255, column(cloud, "colors")[:, 0])
    np.testing.assert_array_equal(columns["intensity"], column(cloud, "intensities"))
    np.testing.assert_array_equal(columns["label"] == 2, low(column(cloud, "points_map")))


def test_intensities_of_16_bits() -> None:
    for stated, kept in ((1.0, 65535), (0.5, 32767.5), (2.0, 514), (255, 65535), (256, 256), (65535, 65535)):
        assert sixteen_bits(np.array([0.0, stated, np.nan], np.float32))[1] == pytest.approx(kept)
    np.testing.assert_array_equal(sixteen_bits(np.array([-1.0, 131070.0], np.float32)), [0.0, 65535.0])


def test_without_intensities_no_file_has_any(cloud: LidarCloud, tmp_path: Path) -> None:
    bare = LidarCloud([replace(part, intensities=None) for part in cloud.stays], low, None)
    for format_, read in (("pcd", read_pcd_points), ("ply-tiles", read_ply_points)):
        for name, one in (("bright", cloud), ("bare", bare)):
            written = export_cloud(format_, tmp_path / format_ / name, one)
            assert all(("intensity" in read(path)) == (name == "bright") for path in written)


def test_tiles_hold_every_point_once(cloud: LidarCloud, tmp_path: Path) -> None:
    written = export_cloud("ply-tiles", tmp_path / "tiles", cloud)
    assert len(written) == 4 * 2
    found = {path.stem: read_cloud_ply(path) for path in written}
    parts = {name: one.points_map for name, one in found.items()}
    bright = np.concatenate([one.intensities for one in found.values() if one.intensities is not None])
    assert sorted(bright) == sorted(column(cloud, "intensities"))
    assert sum(map(len, parts.values())) == COUNT
    for name, points in parts.items():
        corner = np.array(name.split("_"), dtype=float)
        assert ((points[:, :2] >= corner) & (points[:, :2] < corner + 50.0)).all()


def test_interrupted_tiles_leave_no_folder_but_keep_what_was_there(
    cloud: LidarCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "old").mkdir()
    write = lidar_cloud_files.write_cloud_ply

    def interrupted(path: Path, parts: list[ColoredCloud]) -> None:
        write(path, parts)
        raise KeyboardInterrupt

    monkeypatch.setattr(lidar_cloud_files, "write_cloud_ply", interrupted)
    for name in ("old", "new"):
        with pytest.raises(KeyboardInterrupt):
            export_cloud("ply-tiles", tmp_path / name, cloud)
    assert [one.name for one in tmp_path.iterdir()] == ["old"] and len([*(tmp_path / "old").iterdir()]) == 1


def test_what_has_gone_lies_beside_the_cloud(cloud: LidarCloud, tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    both = LidarCloud(cloud.stays, cloud.is_ground, cloud.stays)
    assert [one.name for one in write_lidar_cloud(path, both)] == ["cloud.ply", "cloud_passed_by.ply"]
    assert write_lidar_cloud(path, cloud) == [path]
    assert [one.name for one in tmp_path.iterdir()] == ["cloud.ply"]


@pytest.mark.parametrize("format_", [name for name in CLOUD_FORMATS if not name.endswith("-tiles")])
def test_nothing_is_no_file(format_: str, tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    none = ColoredCloud(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32)
    )
    with pytest.raises(MapFileError, match="no points"):
        export_cloud(format_, tmp_path / "x", LidarCloud([none], low, None))
