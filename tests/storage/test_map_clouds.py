"""Clouds in a map: what was kept comes back, lies are named by table and row, older maps are still read."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from box_world import box_frames
from test_saved_map import IDENTITY, MOUNT, contents, features, forge

from slam.errors import MapFileError
from slam.mapping.sensor_packing import packed_cloud
from slam.measurements import FloatArray, RgbdFrame
from slam.outputs.finished_map import load_map
from slam.storage.map_clouds import MapClouds
from slam.storage.map_contents import write_contents
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.packing import pack

LIDAR = gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([0.0, 0.1, 0.7]))


def clouds(count: int = 5) -> list[FloatArray]:
    rng = np.random.default_rng(3)
    return [np.round(rng.normal(0.0, 5.0, (40 * n, 3)), 3) for n in range(count)]


def write(path: Path, kept: list[FloatArray], frames: list[RgbdFrame] = [], *, planar: bool = False) -> Path:  # noqa: B006
    file = MapFile.create(path)
    for key, value in IDENTITY.to_meta().items():
        file.add_meta(key, value)
    spool, images = MapClouds(file, begun=True), MapFrames(file, begun=True)
    for number, points in enumerate(kept):
        assert spool.add(0.5 * number, points, LIDAR) == number == len(spool) - 1
        np.testing.assert_allclose(spool.points(number), points, atol=1e-9)
    for number, frame in enumerate(frames):
        images.add(frame, number, features())
    reported = contents(planar=planar)
    write_contents(
        file, reported if planar else replace(reported, measured_scans=[], keyframe_scans=[], grids={})
    )
    file.seal()
    return path


def test_they_come_back(tmp_path: Path) -> None:
    saved = load_map(write(tmp_path / "map.db", clouds()))
    saved.check()
    kept = saved.contents.clouds
    assert kept is not None and len(kept) == len(saved.keyframe_poses) == 5
    for found, points in zip(kept, clouds(), strict=True):
        np.testing.assert_allclose(found, points, atol=1e-9)
    np.testing.assert_array_equal(kept.T_base_lidar(4).matrix(), LIDAR.matrix())
    with pytest.raises(IndexError):
        kept.points(5)
    saved.close()


def test_intensities_come_back_without_those_of_erased_points(tmp_path: Path) -> None:
    rows = np.column_stack([clouds()[2], np.arange(80.0)])
    kept = MapClouds(MapFile.temporary())
    kept.add(0.0, rows, LIDAR)
    kept.add(0.5, clouds()[2], LIDAR)
    found = kept.without({0: np.packbits(np.arange(80) < 30).tobytes()})
    np.testing.assert_array_equal(found.intensities(0), np.arange(30.0, 80.0))
    np.testing.assert_array_equal(found.intensities(0, everything=True), np.arange(80.0))
    np.testing.assert_array_equal(found.points(0), kept.points(1)[30:])
    assert found.points(0).flags.c_contiguous and found.intensities(1) is None


def test_frames_beside_clouds_sit_on_bases(tmp_path: Path) -> None:
    frames = [replace(frame, T_base_camera=MOUNT) for frame in box_frames(count=2)]
    saved = load_map(write(tmp_path / "map.db", clouds(), frames))
    node = saved.contents.node_poses[1]
    assert isinstance(node, gtsam.Pose3)
    np.testing.assert_array_equal(saved.contents.frame_poses()[1].matrix(), node.compose(MOUNT).matrix())
    saved.close()
    write(tmp_path / "lost.db", clouds(), [replace(frames[0], T_base_camera=None)])
    with pytest.raises(MapFileError, match=r"table frames, row 0: .*pose of the camera"):
        load_map(tmp_path / "lost.db")


def test_what_is_known_already_is_not_written_again(tmp_path: Path) -> None:
    file = MapFile.create(tmp_path / "map.db")
    MapClouds(file, begun=True).add(1.0, clouds()[1], LIDAR)
    again = MapClouds(file, begun=True)
    assert len(again) == 0
    again.add(1.0, clouds()[1], LIDAR)
    again.add(2.0, clouds()[2], LIDAR)
    assert len(MapClouds(file)) == len(again) == 2
    with pytest.raises(MapFileError, match=r"cannot be resumed: it has a cloud at 1.0.* where one at 1.5"):
        MapClouds(file, begun=True).add(1.5, clouds()[1], LIDAR)
    file.close()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"points": b""}, "ends too soon"),
        ({"points": packed_cloud(np.ones((9, 3)))[:-4]}, "not of 9 points"),
        ({"points": 3}, "int"),
        ({"lidar": pack(None)}, "NoneType where a Pose3 belongs"),
        ({"lidar": b"\x80\x04."}, "not packed values"),
    ],
)
def test_a_lie_is_reported_by_table_and_row(tmp_path: Path, values: dict[str, object], said: str) -> None:
    path = forge(write(tmp_path / "map.db", clouds()), "clouds", 2, **values)
    with pytest.raises(MapFileError, match=rf"table clouds, row 2: .*{said}") as caught:
        load_map(path).check()
    assert len(str(caught.value).splitlines()) == 1


def test_clouds_that_fit_no_nodes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="4 clouds for 5 nodes, 5 of them in space"):
        load_map(write(tmp_path / "few.db", clouds(4)))
    with pytest.raises(MapFileError, match="5 clouds for 5 nodes, 0 of them in space"):
        load_map(write(tmp_path / "planar.db", clouds(), planar=True))


def test_a_map_older_than_clouds_is_read(tmp_path: Path) -> None:
    """Schema 1 ended with the checkpoint."""
    path = tmp_path / "map.db"
    now = load_map(write(path, []))
    digest = now.digest
    now.close()
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE edits")
        connection.execute("DROP TABLE covariances")
        connection.execute("DROP TABLE cameras")
        connection.execute("DROP TABLE clouds")
        connection.execute("PRAGMA user_version = 1")
        connection.execute("DELETE FROM meta WHERE key = 'seal'")
    connection.close()
    file = MapFile.resume(path)
    assert file is not None
    file.seal()
    saved = load_map(path)
    saved.check()
    assert saved.contents.clouds is None and len(saved.keyframe_poses) == 5
    assert saved.digest != digest
    saved.close()


def test_clouds_come_back_as_they_were() -> None:
    kept, rng = MapClouds(MapFile.temporary()), np.random.default_rng(0)
    clouds = [np.round(rng.normal(size=(count, 3)), 3) for count in (5, 0, 300)]
    assert [kept.add(0.1, cloud, MOUNT) for cloud in clouds] == [0, 1, 2]
    np.testing.assert_allclose(kept.points(2), clouds[2], atol=1e-12)
    for _ in range(2):
        for found, cloud in zip(kept, clouds, strict=True):
            np.testing.assert_allclose(found, cloud, atol=1e-12)
