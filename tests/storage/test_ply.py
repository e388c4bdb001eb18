import os

import numpy as np
import pytest

from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredCloud, ColoredMesh
from slam.storage.ply import read_cloud_ply, read_mesh_ply, write_cloud_ply, write_mesh_ply


def some_mesh(count=300):
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = rng.integers(0, 256, size=(count, 3), dtype=np.uint8)
    colors[:256] = np.arange(256, dtype=np.uint8)[:, None]  # every grey level: rounding must keep them all
    faces = rng.permuted(np.tile(np.arange(count, dtype=np.int32), (90, 1)), axis=1)[:, :3]
    points = rng.normal(scale=50.0, size=(count, 3)).astype(np.float32)
    return ColoredMesh(points, colors, normals.astype(np.float32), faces)


def some_cloud():
    mesh = some_mesh()
    return ColoredCloud(mesh.vertices_map, mesh.colors, mesh.normals_map)


def test_a_mesh_comes_back_bit_for_bit(tmp_path):
    mesh = some_mesh()
    write_mesh_ply(tmp_path / "mesh.ply", mesh)
    back = read_mesh_ply(tmp_path / "mesh.ply")
    for name in ("vertices_map", "colors", "normals_map", "faces"):
        np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
        assert getattr(back, name).dtype == getattr(mesh, name).dtype
    assert [file.name for file in tmp_path.iterdir()] == ["mesh.ply"]


def test_a_cloud_comes_back_bit_for_bit(tmp_path):
    cloud = some_cloud()
    write_cloud_ply(tmp_path / "cloud.ply", cloud)
    back = read_cloud_ply(tmp_path / "cloud.ply")
    for name in ("points_map", "colors", "normals_map"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    assert b"format binary_little_endian" in (tmp_path / "cloud.ply").read_bytes()[:100]


@pytest.mark.parametrize(
    ("write", "read", "content"),
    [(write_mesh_ply, read_mesh_ply, some_mesh()), (write_cloud_ply, read_cloud_ply, some_cloud())],
)
@pytest.mark.parametrize("kept", [0.01, 0.5, 0.999])
def test_a_file_that_is_cut_off_is_refused(tmp_path, write, read, content, kept):
    path = tmp_path / "cut.ply"
    write(path, content)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(MapFileError, match=r"cut\.ply: (cut off|not a binary PLY file)"):
        read(path)


def test_a_writer_that_fails_halfway_leaves_the_old_file(tmp_path, monkeypatch):
    import open3d

    # What Open3D does on a full disk: half a file, and success reported.
    def half(name, cloud, full=open3d.t.io.write_point_cloud):
        full(name, cloud)
        os.truncate(name, 1000)
        return True

    path = tmp_path / "cloud.ply"
    path.write_bytes(b"old")
    monkeypatch.setattr(open3d.t.io, "write_point_cloud", half)
    with pytest.raises(MapFileError, match="cut off, 1000 of"):
        write_cloud_ply(path, some_cloud())
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_to_write_is_an_error_and_no_file(tmp_path):
    mesh, cloud = some_mesh(), some_cloud()
    with pytest.raises(MapFileError, match=r"no triangles for .*mesh\.ply"):
        write_mesh_ply(
            tmp_path / "mesh.ply",
            ColoredMesh(mesh.vertices_map, mesh.colors, mesh.normals_map, np.empty((0, 3), np.int32)),
        )
    with pytest.raises(MapFileError, match=r"no points for .*cloud\.ply"):
        write_cloud_ply(
            tmp_path / "cloud.ply",
            ColoredCloud(cloud.points_map[:0], cloud.colors[:0], cloud.normals_map[:0]),
        )
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_a_missing_file_and_other_formats(tmp_path):
    with pytest.raises(MapFileError, match="cannot write"):
        write_mesh_ply(tmp_path / "none" / "mesh.ply", some_mesh())
    with pytest.raises(MapFileError, match="cannot read"):
        read_cloud_ply(tmp_path / "none.ply")
    other = tmp_path / "other.ply"
    other.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    with pytest.raises(MapFileError, match="not a binary PLY"):
        read_mesh_ply(other)
    other.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex many\nend_header\n")
    with pytest.raises(MapFileError, match="damaged PLY header"):
        read_mesh_ply(other)
