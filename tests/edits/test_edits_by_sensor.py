"""Maps of a 3D lidar, of a robot with a camera, of a camera alone: made anew, turned, erased, undone."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import SMALL, look, way_round
from command_line import Scanweave, scanweave
from edit_maps import changed_outside, content, occupied
from flat_worlds import box, sweep
from room_world import LESS, T_BODY_CAMERA, furnished, render, turning_walk

import slam
from slam.config import load_config
from slam.edits.remaking import _unrepaired, settled
from slam.errors import ScanweaveError
from slam.mapping.layered_map import DEPTH, OCCUPANCY
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.mapping.polygons import inside
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, LaserScan, RgbdFrame, WheelOdometry, pose2_from_row
from slam.outputs.finished_map import Map
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_contents import parts_of
from slam.storage.map_edits import AppliedEdits
from slam.trajectory.carried import late_covariances
from slam.vision.learned_camera import LearnedCamera

__all__ = ["scanweave"]  # a fixture

WALLS = np.concatenate([box(-2.5, -2.0, 2.5, 2.0), box(1.6, 0.4, 2.5, 1.5), box(-2.5, -2.0, -1.7, -1.1)])
MOUNT = gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([0.1, 0.0, 1.1])) * T_BODY_CAMERA
PLAIN = ["dense_map.enabled=false", "sensors.doctor=false"]


@pytest.fixture(scope="module")
def clouds() -> Map:
    poses = way_round(36)[:7]
    measured = [look(pose, 0.1 * number, seed=number) for number, pose in enumerate(poses)]
    return slam.build_map(measured, load_config(None, [*SMALL, *PLAIN, "grid.resolution_m=0.1"]))


@pytest.fixture(scope="module")
def robot() -> Map:
    """Wheels, a lidar and a camera in one room."""
    pose, measured = np.array([0.3, -0.7, 0.2]), list[RgbdFrame | WheelOdometry | LaserScan]()
    for n in range(9):
        stamp_s = 100.0 + 0.1 * n
        on_floor = gtsam.Pose3(gtsam.Rot3.Rz(pose[2]), np.array([pose[0], pose[1], 0.0]))
        look_ = on_floor * MOUNT
        frame = render(furnished(), look_, LESS, stamp_s - 0.01, seed=n, smooth=False, T_base_camera=MOUNT)
        scan = sweep(WALLS, pose, beams=181, fov_rad=math.pi, sigma_m=0.01, stamp_s=stamp_s)
        measured += [frame, WheelOdometry(stamp_s, pose2_from_row(pose)), scan]
        pose = compose(pose, np.array([0.03, 0.0, 0.22]))
    return slam.build_map(measured, load_config(None, PLAIN))


@pytest.fixture(scope="module")
def camera() -> Map:
    """In the hand, seven frames."""
    walk = turning_walk(60)[:7]
    frames = [render(furnished(), pose, LESS, stamp_s=n / 15.0) for n, pose in enumerate(walk)]
    return slam.build_map(
        frames, load_config(None, [*PLAIN, "keyframes.angle_rad=0.05", "rgbd.registration=given"])
    )


@pytest.mark.parametrize("kind", ["clouds", "robot", "camera"])
def test_every_kind_of_map_is_made_anew_turned_and_undone(kind: str, request: pytest.FixtureRequest) -> None:
    saved: Map = request.getfixturevalue(kind)
    assert content(saved.remap()) == content(saved)
    turned = saved.edited({"turn": {"degrees": 90.0}})
    x, y, z = saved.trajectory.positions_m.T
    assert turned.trajectory.positions_m == pytest.approx(np.column_stack([-y, x, z]), abs=1e-6)
    assert content(turned.undone()) == content(saved)
    turned.check()


def test_a_map_that_is_turned_keeps_the_error_of_a_clock_in_its_covariances(robot: Map) -> None:
    """As if a camera alone had led; beside it what the same map reports of a lidar."""
    learned = {"camera": LearnedCamera(clock_offset_s=0.02, clock_sigma_s=0.05)}
    alone = replace(robot.contents, measured_scans=(), cameras=learned)
    turns, config = [AppliedEdits("", turned=gtsam.Pose2(0.0, 0.0, 1.0))], load_config(None, PLAIN)
    led, by_lidar = (settled(one, turns, config, config, robot.sessions) for one in (alone, robot.contents))
    assert led.covariances is not None and by_lidar.covariances is not None
    (readings, poses, sigma_s) = parts_of(alone, robot.sessions)[0]
    assert (readings, poses, sigma_s) == (len(alone.node_poses), len(led.trajectory), 0.05)
    first = int(np.flatnonzero(led.trajectory.stamps_s == led.stamps_s[0])[0])
    late = late_covariances(led.trajectory, first, [(poses, sigma_s)], 3)
    assert led.covariances - by_lidar.covariances == pytest.approx(late, abs=1e-12)
    assert np.abs(late).max() > 1e-9


def test_a_map_of_clouds_that_is_turned_keeps_the_error_of_their_stamps(clouds: Map) -> None:
    turns, config = [AppliedEdits("", turned=gtsam.Pose2(0.0, 0.0, 1.0))], load_config(None, PLAIN)
    late = replace(clouds.contents, clock_sigma_s=0.05)
    with_it, without = (
        settled(one, turns, config, config, clouds.sessions) for one in (late, clouds.contents)
    )
    assert with_it.covariances is not None and without.covariances is not None
    grown = with_it.covariances - without.covariances
    assert grown.shape[1:] == (6, 6) and np.abs(grown).max() > 1e-9


def test_what_is_erased_of_clouds_stays_away_at_other_heights_too(clouds: Map) -> None:
    polygon = square(clouds.contents.grids[OCCUPANCY])
    erased = clouds.edited({"erase": [{"polygon": polygon.tolist()}]})
    assert occupied(clouds, polygon) > 3 and occupied(erased, polygon) == 0
    assert changed_outside(clouds, erased, polygon) == 0
    assert clouds.contents.clouds is not None and erased.contents.clouds is not None
    assert sum(map(len, erased.contents.clouds)) < sum(map(len, clouds.contents.clouds))
    for settings in (["grid.resolution_m=0.05"], ["layers.robot_height_m=1.5"]):
        anew = erased.remap(settings)
        # A flat scan cut at other heights takes a point for as far as its bearing's middle.
        assert occupied(anew, polygon.mean(axis=0) + 0.9 * (polygon - polygon.mean(axis=0))) == 0
    assert content(erased.undone()) == content(clouds)


def test_what_is_erased_of_images_is_gone_from_the_depth_layer_and_only_there(robot: Map) -> None:
    before = robot.contents.grids[DEPTH]
    polygon = square(before)
    erased = robot.edited({"erase": [{"polygon": polygon.tolist()}]})
    after = erased.contents.grids[DEPTH]
    assert occupied(erased, polygon) == 0
    assert changed_outside(robot, erased, polygon) == 0
    assert before.T_map_grid.equals(after.T_map_grid, 0.0) and before.steps.shape == after.steps.shape
    cells = np.argwhere(before.steps != after.steps)[:, ::-1]
    corner = before.T_map_grid.translation()
    near = np.zeros(len(cells), np.bool_)
    for x in np.linspace(0.0, 1.0, 9):
        for y in np.linspace(0.0, 1.0, 9):
            near |= inside(corner + (cells + [x, y]) * before.resolution_m, polygon)  # noqa: RUF005
    assert len(cells) and near.all()
    seen, left = robot.contents.frames, erased.contents.frames
    assert seen is not None and left is not None
    depths = [(frame.depth_m, other.depth_m) for frame, other in zip(seen, left, strict=True)]
    assert any(np.count_nonzero(then) < np.count_nonzero(first) for first, then in depths)
    assert all((then >= 0.0).all() for _, then in depths)
    assert content(erased.undone()) == content(robot)


def test_repairs_can_be_left_out_but_not_be_made_again(robot: Map) -> None:
    assert content(robot.remap(["fusion.enabled=false"]).undone()) == content(robot)
    with pytest.raises(ScanweaveError, match=r"fusion\.least_pairs = 5 takes the log"):
        robot.remap(["fusion.least_pairs=5"])


def test_a_map_without_walls_is_not_turned_to_them(camera: Map) -> None:
    with pytest.raises(ScanweaveError, match="no scan of the map shows a wall"):
        camera.edited({"turn": {"to_walls": True}})


@pytest.mark.parametrize("kind", ["clouds", "camera"])
def test_a_loop_is_added_by_clouds_and_by_images(kind: str, request: pytest.FixtureRequest) -> None:
    saved: Map = request.getfixturevalue(kind)
    pair = [{"reading": int(saved.contents.readings[row])} for row in (0, 1)]
    added = saved.edited({"loops": {"add": [{"pair": pair}]}})
    assert len(added.loops) == len(saved.loops) + 1 and added.loops[-1].accepted
    assert added.factors[-1].edge.loop == len(saved.loops)
    moved = added.trajectory.positions_m - saved.trajectory.positions_m
    assert np.abs(moved).max() < 0.05
    # The other way round, with a guess: the same place.
    near = between(saved.keyframe_poses[1], saved.keyframe_poses[0])
    again = saved.edited({"loops": {"add": [{"pair": pair[::-1], "guess": near.tolist()}]}})
    one, other = (found.loops[-1].motion for found in (added, again))
    assert one is not None and other is not None
    off = one.T_reference_base.localCoordinates(other.T_reference_base)  # type: ignore[arg-type]
    assert np.abs(off).max() < 0.05
    assert content(added.undone()) == content(saved)


def test_the_commands(scanweave: Scanweave, tmp_path: Path) -> None:
    log = write_synthetic_log(tmp_path / "log", duration_s=12.0).log_path
    slam.map_log(log, out=tmp_path / "map").close()
    before = (tmp_path / "map" / "map.db").read_bytes()
    stated = (tmp_path / "map" / "report.html").read_bytes()
    (tmp_path / "edits.yaml").write_text("turn: {to_walls: true}\nplaces: [{name: dock, position: [0, 0]}]\n")
    done = scanweave("edit", tmp_path / "map", tmp_path / "edits.yaml")
    assert done.code == 0 and "edits: 1" in done.out, done
    # The page shows the map as it is now; that of the run is kept as its session's.
    assert (tmp_path / "map" / "report-1.html").read_bytes() == stated
    page, edited = (tmp_path / "map" / "report.html").read_text(), slam.load_map(tmp_path / "map")
    assert edited.digest[:12] in page
    edited.close()
    listed = scanweave("edit", tmp_path / "map", "--list")
    assert "to_walls: true" in listed.out and "dock" in listed.out
    done = scanweave("remap", tmp_path / "map", "-s", "grid.resolution_m=0.1", "-o", tmp_path / "coarse")
    assert done.code == 0 and (tmp_path / "coarse" / "map.yaml").is_file()
    assert scanweave("edit", tmp_path / "map", "--undo").code == 0
    assert (tmp_path / "map" / "map.db").read_bytes() == before
    again = scanweave("edit", tmp_path / "map", "--undo")
    assert again.code == 1 and again.err.strip().endswith("has no edits to undo")
    assert scanweave("edit", tmp_path / "map").code == 2


def square(grid: OccupancyGrid) -> FloatArray:
    """A square about an occupied cell."""
    row, col = np.argwhere(grid.states() == 100)[len(np.argwhere(grid.states() == 100)) // 2]
    middle = grid.T_map_grid.translation() + grid.resolution_m * (np.array([col, row]) + 0.5)
    return np.asarray(middle + 0.55 * np.array([[-1, -1.1], [1, -1], [1.1, 1], [-1, 1]]))


def test_surfaces_are_written_again_only_where_they_would_be_others(camera: Map, tmp_path: Path) -> None:
    saved = camera.remap(["dense_map.enabled=true", "dense_map.voxel_m=0.1"], out=tmp_path)
    cloud = tmp_path / "cloud.ply"
    content_, written = cloud.read_bytes(), cloud.stat().st_mtime_ns
    named = saved.edited({"places": [{"name": "dock", "position": [0, 0]}]}, out=tmp_path)
    assert cloud.stat().st_mtime_ns == written
    named.edited({"turn": {"degrees": 90}}, out=tmp_path)
    assert cloud.read_bytes() != content_


def test_what_moved_stays_out_of_scans_whose_repairs_are_left_out() -> None:
    measured = LaserScan(0.0, np.array([1.0, np.nan, 3.0, 4.0], np.float32), 0.0, 0.1, 20.0)
    mended = replace(measured, ranges_m=np.array([-1.1, 2.0, 3.0, 4.1], np.float32))
    left = _unrepaired(measured, mended)
    assert left is not None
    assert np.array_equal(left.ranges_m, np.array([-1.0, np.nan, 3.0, 4.0], np.float32), equal_nan=True)
    assert _unrepaired(measured, replace(mended, ranges_m=np.abs(mended.ranges_m))) is measured
