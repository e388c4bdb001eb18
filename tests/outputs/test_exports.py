"""What is exported of maps, read back as its consumers do: axes, pixels, colours and poses are right."""

import json
import struct
from pathlib import Path

import gtsam
import numpy as np
import pytest

import slam
from slam.datasets.ply_points import read_ply_points
from slam.errors import ScanweaveError
from slam.storage.tum import read_tum
from tests.room_world import LESS, furnished, render, turning_walk, write_tum_folder

COUNT = 16
# Name, (3, 4) world to camera, (3, 3) of pixels that begin at their corners.
Views = list[tuple[str, np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> slam.Map:
    """The map of a short walk."""
    walk = turning_walk(COUNT, turns=0.25)
    frames = [render(furnished(), pose, LESS, stamp_s=n / 15.0) for n, pose in enumerate(walk)]
    log = write_tum_folder(tmp_path_factory.mktemp("room") / "log", frames, walk)
    settings = ["dense_map.enabled=false", "dense_map.voxel_m=0.03", "keyframes.distance_m=0.1"]
    return slam.map_log(log, slam.load_config(None, settings), out=tmp_path_factory.mktemp("map") / "map")


def colmap_views(folder: Path) -> tuple[Views, np.ndarray]:
    """As COLMAP's read_write_model.py takes the binary files; and the points."""
    content = (folder / "cameras.bin").read_bytes()
    lenses, at = {}, 8
    for _ in range(*struct.unpack_from("<Q", content)):
        number, model, _, _, fx, fy, cx, cy = struct.unpack_from("<iiQQ4d", content, at)
        assert model == 1
        lenses[number] = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        at += struct.calcsize("<iiQQ4d")
    assert at == len(content)
    content, views, at = (folder / "images.bin").read_bytes(), [], 8
    for _ in range(*struct.unpack_from("<Q", content)):
        _, w, x, y, z, *shift, camera = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        views.append((content[at + 64 : end].decode(), np.column_stack([turn, shift]), lenses[camera]))
        assert struct.unpack_from("<Q", content, end + 1) == (0,)
        at = end + 9
    assert at == len(content)
    content = (folder / "points3D.bin").read_bytes()
    fields = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    record = np.dtype(fields)
    return views, np.frombuffer(content, record, offset=8)["xyz"]


def nerfstudio_views(folder: Path) -> Views:
    """As nerfstudio takes them: OpenGL's axes."""
    stated = json.loads((folder / "transforms.json").read_text())
    views = []
    for frame in stated["frames"]:
        lens = {**stated, **frame}
        assert all((folder / frame[name]).is_file() for name in ("file_path", "depth_file_path"))
        to_world = np.array(frame["transform_matrix"])
        to_world[:3, 1:3] *= -1.0
        matrix = [[lens["fl_x"], 0.0, lens["cx"]], [0.0, lens["fl_y"], lens["cy"]], [0.0, 0.0, 1.0]]
        views.append((Path(frame["file_path"]).name, np.linalg.inv(to_world)[:3], np.array(matrix)))
    return views


def seen(points: np.ndarray, view: tuple[str, np.ndarray, np.ndarray]) -> np.ndarray:
    """(3, N) columns and rows from the corner of the image, and depth."""
    placed = view[1][:, :3] @ points.T + view[1][:, 3:]
    return np.vstack([(view[2] @ placed)[:2] / placed[2], placed[2]])


def in_front_of_depth(points: np.ndarray, views: Views, folder: Path) -> tuple[float, float]:
    """Shares of the points that lie on what the depth images show, and in front of it."""
    import cv2

    on, before = [], []
    for view in views:
        depth = cv2.imread(str(folder / "depth" / view[0].replace(".jpg", ".png")), cv2.IMREAD_UNCHANGED)
        column, row, z = seen(points, view)
        inside = (z > 0.3) & (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
        read = depth[row[inside].astype(int), column[inside].astype(int)] / 1000.0
        on.append(np.abs(z[inside] - read)[read > 0.0] < 0.05)
        before.append((z[inside] - read)[read > 0.0] < -0.1)
    return float(np.concatenate(on).mean()), float(np.concatenate(before).mean())


def test_colmap_and_nerfstudio_see_what_the_images_show(room: slam.Map, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    room.export("colmap", tmp_path / "colmap")
    room.export("nerfstudio", tmp_path / "nerf")
    views, points = colmap_views(tmp_path / "colmap" / "sparse" / "0")
    others = nerfstudio_views(tmp_path / "nerf")
    assert [view[0] for view in views] == [view[0] for view in others]
    for one, other in zip(views, others, strict=True):
        np.testing.assert_allclose(one[1], other[1], atol=1e-9)
        np.testing.assert_allclose(one[2], other[2])
    for found, folder in ((views, "colmap"), (others, "nerf")):
        on, before = in_front_of_depth(points, found, tmp_path / folder)
        assert on > 0.6 and before < 0.02
    cloud = read_ply_points(tmp_path / "nerf" / "points.ply")
    np.testing.assert_allclose(np.column_stack([cloud[axis] for axis in "xyz"]), points, atol=1e-6)


def test_interrupted_images_leave_no_folder(
    room: slam.Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slam.outputs.exports.write_transforms", interrupted)
    with pytest.raises(KeyboardInterrupt):
        room.export("nerfstudio", tmp_path / "nerf")
    assert not list(tmp_path.iterdir())


def test_points_of_the_map_project_to_their_pixels(room: slam.Map, tmp_path: Path) -> None:
    """Features that two keyframes have matched, placed by the one and projected into the other."""
    import cv2

    room.export("colmap", tmp_path)
    views, _ = colmap_views(tmp_path / "sparse" / "0")
    frames = room.contents.frames
    assert frames is not None and len(views) == len(frames) > 2
    lens = frames.head(0).intrinsics  # whose pixels begin at their middle
    np.testing.assert_allclose(
        views[0][2], [[lens.fx, 0, lens.cx + 0.5], [0, lens.fy, lens.cy + 0.5], [0, 0, 1]]
    )
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    off_px = []
    for n in range(len(views) - 1):
        one, other = frames.features(n), frames.features(n + 1)
        pairs = [p for p in matcher.match(one.descriptors, other.descriptors) if p.distance < 30]
        first, second = (np.array([getattr(p, end) for p in pairs]) for end in ("queryIdx", "trainIdx"))
        usable = one.depth_m[first] > 0.0
        pixels, depth = one.pixels[first[usable]] + 0.5, one.depth_m[first[usable]]
        rays = np.linalg.inv(views[n][2]) @ np.column_stack([pixels, np.ones(len(pixels))]).T
        placed = views[n][1][:, :3].T @ (rays * depth - views[n][1][:, 3:])
        off = seen(placed.T, views[n + 1])[:2].T - (other.pixels[second[usable]] + 0.5)
        off_px.append(np.hypot(*off.T))
    assert np.median(np.concatenate(off_px)) < 1.0


def test_the_surface_stands_upright_as_glb(room: slam.Map, tmp_path: Path) -> None:
    room.export("glb", tmp_path)
    content = (tmp_path / "mesh.glb").read_bytes()
    magic, version, size = struct.unpack_from("<4sII", content)
    assert (magic, version, size) == (b"glTF", 2, len(content))
    length, kind = struct.unpack_from("<I4s", content, 12)
    head, body = json.loads(content[20 : 20 + length]), content[28 + length :]
    assert kind == b"JSON" and head["buffers"][0]["byteLength"] == len(body)
    accessor, view = head["accessors"][0], head["bufferViews"][0]
    vertices = np.frombuffer(body, "<f4", 3 * accessor["count"]).reshape(-1, 3)
    assert view["byteOffset"] == 0 and accessor["min"] == pytest.approx(vertices.min(axis=0))
    x, y, z, w = head["nodes"][0]["rotation"]
    up = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(up, [0.0, 1.0, 0.0], atol=1e-12)


def test_e57_holds_the_surface(room: slam.Map, tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    room.export("e57", tmp_path / "room.e57")
    room.export("nerfstudio", tmp_path / "nerf")
    read = pye57.E57(str(tmp_path / "room.e57")).read_scan(0, colors=True, ignore_missing_fields=True)
    cloud = read_ply_points(tmp_path / "nerf" / "points.ply")
    for axis in "XYZ":
        np.testing.assert_allclose(read[f"cartesian{axis}"], cloud[axis.lower()], atol=1e-5)
    np.testing.assert_array_equal(read["colorRed"], cloud["red"])


def test_poses_as_kitti(room: slam.Map, tmp_path: Path) -> None:
    room.export("kitti", tmp_path)
    rows = np.loadtxt(tmp_path / "poses.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows[0], np.eye(4)[:3], atol=1e-12)
    steps = np.linalg.norm(np.diff(rows[:, :, 3], axis=0), axis=1)
    moved = np.linalg.norm(np.diff(room.trajectory.positions_m, axis=0), axis=1)
    np.testing.assert_allclose(steps, moved, atol=1e-8)
    assert len(np.loadtxt(tmp_path / "times.txt")) == len(rows)

    (tmp_path / "times.txt").write_text("of a data set\n")
    room.export("kitti", tmp_path / "mine.txt")
    assert (tmp_path / "times.txt").read_text() == "of a data set\n"
    assert len(np.loadtxt(tmp_path / "mine_times.txt")) == len(rows)


def test_a_robots_results_as_a_bag_and_its_lidars_way(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from rosbags.highlevel import AnyReader

    from slam.simulation.synthetic_log import write_synthetic_log

    log = write_synthetic_log(tmp_path / "log", duration_s=10.0).log_path
    house = slam.map_log(log, out=tmp_path / "map")
    assert house.grid is not None
    with pytest.raises(ScanweaveError, match="no image"):
        house.export("colmap", tmp_path / "none")
    (lidar,) = house.export("sensors", tmp_path / "sensors")
    scan = house.keyframe_scans[0]
    assert scan is not None
    mounted = [
        pose.compose(gtsam.Pose3(scan.T_base_laser)).translation() for pose in house.trajectory.poses()
    ]
    np.testing.assert_allclose(read_tum(lidar).positions_m, mounted, atol=1e-12)
    (bag,) = house.export("mcap", tmp_path / "bag")
    with bag.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    stated = summary.statistics.channel_message_counts
    counts = {one.topic: stated.get(number, 0) for number, one in summary.channels.items()}
    readings = len(house.trajectory)
    assert counts == {
        "/map": 1,
        "/path": 1,
        "/pose": readings,
        "/tf": readings,
        "/tf_static": 1,
        "/points": 0,
    }
    with AnyReader([bag.parent]) as reader:
        said = {one.topic: reader.deserialize(raw, one.msgtype) for one, _, raw in reader.messages()}
    drawn = said["/map"].data.reshape(said["/map"].info.height, said["/map"].info.width)
    assert house.layers is not None
    np.testing.assert_array_equal(drawn, house.layers.states("decision"))
    last, position = said["/path"].poses[-1].pose.position, house.trajectory.positions_m[-1]
    np.testing.assert_allclose([last.x, last.y], position[:2])
    assert [one.child_frame_id for one in said["/tf_static"].transforms] == [scan.sensor]
    house.close()
