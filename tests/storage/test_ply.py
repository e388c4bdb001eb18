import resource

import numpy as np
import pytest

from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredCloud, ColoredMesh
from slam.storage.ply import read_cloud_ply, write_cloud_ply, write_mesh_ply


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
    path = tmp_path / "mesh.ply"
    write_mesh_ply(path, mesh)
    vertices = read_cloud_ply(path)
    np.testing.assert_array_equal(vertices.points_map, mesh.vertices_map)
    np.testing.assert_array_equal(vertices.colors, mesh.colors)
    np.testing.assert_array_equal(vertices.normals_map, mesh.normals_map)
    assert b"element face 90\nproperty list uchar int vertex_indices\nend_header\n" in path.read_bytes()
    faces = np.frombuffer(
        path.read_bytes()[-90 * 13 :], np.dtype([("count", "u1"), ("corners", "<i4", (3,))])
    )
    assert (faces["count"] == 3).all()
    np.testing.assert_array_equal(faces["corners"], mesh.faces)
    assert [file.name for file in tmp_path.iterdir()] == ["mesh.ply"]


def test_open3d_reads_what_is_written(tmp_path, open3d):
    mesh, cloud = some_mesh(), some_cloud()
    write_mesh_ply(tmp_path / "mesh.ply", mesh)
    write_cloud_ply(tmp_path / "cloud.ply", [cloud])
    found = open3d.t.io.read_triangle_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(found.triangle.indices.numpy(), mesh.faces)
    np.testing.assert_array_equal(np.rint(found.vertex.colors.numpy() * 255.0), mesh.colors)
    points = open3d.t.io.read_point_cloud(tmp_path / "cloud.ply").point
    np.testing.assert_array_equal(points.colors.numpy(), cloud.colors)
    for part in (found.vertex, points):
        np.testing.assert_array_equal(part.positions.numpy(), cloud.points_map)
        np.testing.assert_array_equal(part.normals.numpy(), cloud.normals_map)


def test_a_cloud_comes_back_bit_for_bit(tmp_path):
    cloud = some_cloud()
    write_cloud_ply(tmp_path / "cloud.ply", [cloud])
    back = read_cloud_ply(tmp_path / "cloud.ply")
    for name in ("points_map", "colors", "normals_map"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    assert b"format binary_little_endian" in (tmp_path / "cloud.ply").read_bytes()[:100]


@pytest.mark.parametrize("kept", [0.01, 0.5, 0.999])
def test_a_file_that_is_cut_off_is_refused(tmp_path, kept):
    path = tmp_path / "cut.ply"
    write_cloud_ply(path, [some_cloud()])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(MapFileError, match=r"cut\.ply: (cut off|no end of the header)"):
        read_cloud_ply(path)


def test_a_full_disk_leaves_the_old_file(tmp_path):
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(MapFileError, match=r"cannot write .*cloud\.ply: .* free space"):
            write_cloud_ply(path, [some_cloud()])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
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
            [ColoredCloud(cloud.points_map[:0], cloud.colors[:0], cloud.normals_map[:0])],
        )
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_a_missing_file_and_other_formats(tmp_path):
    with pytest.raises(MapFileError, match="cannot write"):
        write_mesh_ply(tmp_path / "none" / "mesh.ply", some_mesh())
    with pytest.raises(MapFileError, match="cannot read"):
        read_cloud_ply(tmp_path / "none.ply")
    other = tmp_path / "other.ply"
    other.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(MapFileError, match="points without 'y'"):
        read_cloud_ply(other)
    other.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex many\nend_header\n")
    with pytest.raises(MapFileError, match="'element vertex many' in the header"):
        read_cloud_ply(other)
    write_cloud_ply(other, [some_cloud()])
    other.write_bytes(other.read_bytes().replace(b"uchar", b"char"))
    with pytest.raises(MapFileError, match="colours of type int8"):
        read_cloud_ply(other)
