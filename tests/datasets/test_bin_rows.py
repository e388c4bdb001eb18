"""Rows of ``.bin`` clouds, which nothing names: recognised by how their numbers repeat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.datasets import open_dataset
from slam.datasets.cloud_files import KITTI_ROWS
from slam.datasets.clouds_over_time import rows_of
from slam.errors import DatasetError
from slam.measurements import FloatArray, PointCloud


def room(rng: np.random.Generator, count: int) -> FloatArray:
    """A wall, a floor, an intensity, a ring and a time, (count, 6), in any order of points."""
    x, y = rng.uniform(2.0, 30.0, count), rng.uniform(-20.0, 20.0, count)
    z = np.where(rng.random(count) < 0.5, -1.7, rng.uniform(-1.7, 3.0, count))
    return np.column_stack(
        [x, y, z, rng.random(count), rng.integers(0, 64, count), rng.uniform(0, 0.1, count)]
    )


def folder(path: Path, kind: str, fields: int) -> tuple[Path, list[FloatArray]]:
    """Three clouds of so many numbers a point."""
    rng, rows = np.random.default_rng(0), []
    (path / "velodyne").mkdir()
    for number in range(3):
        rows.append(room(rng, 900)[:, :fields])
        rows[-1].astype(kind).tofile(path / "velodyne" / f"{number:06d}.bin")
    (path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    return path, rows


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("fields", [3, 4, 5, 6])
def test_rows_of_any_length_are_read_and_reported(tmp_path: Path, kind: str, fields: int) -> None:
    path, rows = folder(tmp_path, kind, fields)
    log = open_dataset(path)
    clouds = [one for one in log if isinstance(one, PointCloud)]
    assert len(clouds) == 3
    for cloud, truth in zip(clouds, rows, strict=True):
        np.testing.assert_array_equal(cloud.points_lidar, truth[:, :3].astype(np.float32))
        assert (cloud.intensities is None) == (fields == 3)
    stated = f"the .bin files hold {fields} numbers of {kind[2]} bytes a point"
    assert (stated in log.report.notes) == ((kind, fields) != ("<f4", 4))


def test_what_is_no_rows_of_coordinates_is_refused_in_a_line(tmp_path: Path) -> None:
    path, _ = folder(tmp_path, "<f4", 4)
    rng = np.random.default_rng(1)
    for file in (path / "velodyne").iterdir():
        file.write_bytes(rng.bytes(24000))
    with pytest.raises(DatasetError, match=r"no rows of 3 to 6 floats or doubles.*convert"):
        list(open_dataset(path))


def test_no_numbers_among_the_points_do_not_hide_what_the_rows_are(tmp_path: Path) -> None:
    path, _ = folder(tmp_path, "<f4", 3)
    for file in (path / "velodyne").iterdir():
        points = np.fromfile(file, "<f4").reshape(-1, 3)
        points[::3] = np.nan
        points[1::3] = 0.0
        points.tofile(file)
    assert [len(one.points_lidar) for one in open_dataset(path) if isinstance(one, PointCloud)] == [300] * 3


def test_a_file_that_cannot_be_read_is_left_for_its_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _ = folder(tmp_path, "<f4", 5)
    monkeypatch.setattr(np, "fromfile", lambda *_: (_ for _ in ()).throw(PermissionError("not yours")))
    assert rows_of(sorted((path / "velodyne").iterdir())) == KITTI_ROWS
