"""A camera beside a 3D lidar: its pictures lie along the lidar's way, and carry it on where it is lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import PILLARS, SMALL, cast, look, way_round
from room_world import T_BODY_CAMERA
from test_resume import Log, attempt

from slam.config import load_config
from slam.graph.edge import EdgeKind
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.measurements import CameraIntrinsics, Measurement, RgbdFrame
from slam.outputs.exports import Exports
from slam.outputs.finished_map import load_map

LENS = CameraIntrinsics(130.0, 130.0, 79.5, 59.5, 160, 120)
MOUNT = gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([0.2, 0.05, 0.6])) * T_BODY_CAMERA
SETTINGS = (*SMALL, "rgbd.registration=given", "dense_map.voxel_m=0.08", "layers.robot_height_m=1.0")
COUNT = 12


def picture(T_map_base: gtsam.Pose3, stamp_s: float) -> RgbdFrame:
    """The room of the 3D lidar, its surfaces in squares of 8 cm of random grey."""
    u, v = np.meshgrid(np.arange(LENS.width), np.arange(LENS.height))
    rays = np.column_stack(
        [((u - LENS.cx) / LENS.fx).ravel(), ((v - LENS.cy) / LENS.fy).ravel(), np.ones(u.size)]
    )
    camera = T_map_base.compose(MOUNT)
    turned = rays @ camera.rotation().matrix().T
    depth = cast(camera.translation(), turned)
    cells = np.floor((camera.translation() + turned * depth[:, None] + 1e-6) / 0.08).astype(np.int64)
    mixed = (cells @ np.array([73856093, 19349663, 83492791])) % 9973
    grey = (mixed * 7919 % 200 + 30).astype(np.uint8).reshape(u.shape)
    depth_m = np.where(depth < 6.0, depth, 0.0).astype(np.float32).reshape(u.shape)
    return RgbdFrame(stamp_s, np.repeat(grey[..., None], 3, axis=2), depth_m, LENS, MOUNT, "front")


def drive(count: int = COUNT, blind: Sequence[int] = ()) -> list[Measurement]:
    """About the room's middle; at some moments the lidar sees but leaves that whirl about it."""
    log: list[Measurement] = []
    rng = np.random.default_rng(5)
    for n, pose in enumerate(way_round(48)[:count]):
        cloud = look(pose, 100.0 + 0.1 * n, seed=n)
        if n in blind:
            cloud = replace(cloud, points_lidar=rng.uniform(-0.6, 0.6, (3000, 3)).astype(np.float32))
        log += [picture(pose, cloud.stamp_s), cloud]
    return log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return Log(drive(), tmp_path_factory.mktemp("cameras"))


@pytest.fixture(scope="module")
def mapped(log: Log) -> MapResult:
    return build_map(log, load_config(None, SETTINGS))  # type: ignore[arg-type]


def test_pictures_are_where_they_were_taken(mapped: MapResult) -> None:
    assert mapped.map.frames is not None and mapped.map.clouds is not None and not mapped.warnings
    truth, start = way_round(48), way_round(48)[0]
    frames, poses = list(mapped.map.frames), mapped.map.frame_poses()
    assert len(frames) == len(poses) == len(mapped.map.keyframe_poses) >= 6
    for frame, pose in zip(frames, poses, strict=True):
        true = truth[round((frame.stamp_s - 100.0) / 0.1)].compose(MOUNT)
        assert np.abs(gtsam.Pose3.Logmap(true.between(start.compose(pose)))).max() < 0.03
    assert set(mapped.cameras) == {"front"}


def test_layers_of_lidar_and_depth(mapped: MapResult) -> None:
    layers = mapped.map.layers(load_config(None, SETTINGS))
    assert layers is not None and layers.lidar is not None and layers.depth is not None
    start, states = way_round(48)[0], layers.states("depth")
    # The pillar in the camera's way, and the floor before it.
    for place, expected in ((PILLARS[0][:2, 0] + [0.2, 0.0], 100), (np.array([1.7, 2.4]), 0)):
        at = start.inverse().transformFrom(np.array([*place, 0.0]))
        column, row = ((at[:2] - layers.T_map_grid.translation()) / layers.resolution_m).astype(int)
        around = states[row - 2 : row + 3, column - 2 : column + 3]
        assert (around == expected).any(), (place, around)


def test_without_the_camera_the_way_is_the_same(log: Log, mapped: MapResult) -> None:
    alone = build_map(log, load_config(None, [*SETTINGS, "sensors.rgbd=false"]))  # type: ignore[arg-type]
    assert alone.map.frames is None and not alone.cameras
    # Every second one, but the first and second both.
    assert len(alone.map.keyframe_poses) == len(mapped.map.keyframe_poses) // 2 + 1
    np.testing.assert_allclose(alone.map.trajectory.positions_m, mapped.map.trajectory.positions_m, atol=1e-9)
    layers = alone.map.layers(load_config(None, SETTINGS))
    assert layers is not None and layers.lidar is alone.map.grid and layers.depth is None


def test_the_camera_shows_the_step_where_the_lidar_is_lost() -> None:
    """Blind for so long that the tracker gives up; wheels are silent, and nobody else knows the way."""
    measurements = drive(32, blind=range(6, 18))
    config = load_config(None, [*SETTINGS, "fusion.enabled=false", "dense_map.enabled=false"])
    result = build_map(Log(measurements, Path()), config)  # type: ignore[arg-type]
    kinds = [factor.edge.kind for factor in result.map.factors]
    assert EdgeKind.RGBD in kinds and EdgeKind.ASSUMED not in kinds
    end = way_round(48)[0].between(way_round(48)[31])
    assert np.linalg.norm(result.map.trajectory.positions_m[-1] - end.translation()) < 0.1


def test_one_without_a_place_is_reported(log: Log) -> None:
    lost = [replace(one, T_base_camera=None) if isinstance(one, RgbdFrame) else one for one in log][:8]
    result = build_map(Log(lost, Path()), load_config(None, SETTINGS))  # type: ignore[arg-type]
    assert result.map.frames is None
    assert any("front: not used" in warning for warning in result.warnings)


def test_saved_resumed_and_exported(log: Log, mapped: MapResult, tmp_path: Path) -> None:
    config = load_config(None, SETTINGS)
    (tmp_path / "log").write_text("the same")
    whole, broken = tmp_path / "whole.db", tmp_path / "broken.db"
    attempt(log, config, whole)
    for stop_at in (4, 9):
        assert attempt(log, config, broken, stop_at) is None
    attempt(log, config, broken)
    assert broken.read_bytes() == whole.read_bytes()
    saved = load_map(whole)
    saved.check()
    kept, poses = saved.contents, mapped.map.frame_poses()
    assert kept.frames is not None and kept.clouds is not None
    assert len(kept.frames) == len(kept.clouds) == len(poses)
    for found, pose in zip(kept.frame_poses(), poses, strict=True):
        np.testing.assert_allclose(found.matrix(), pose.matrix(), atol=1e-9)
    written = Exports(mapped.map, config).write_surfaces(tmp_path)
    names = {path.name for path in written}
    assert names - {"mesh.ply"} == {"cloud.ply", "lidar.ply"}
    assert {path.name for path in saved.export("ply", tmp_path / "again")} == names
    for name in ("lidar.ply",):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()
    saved.close()
