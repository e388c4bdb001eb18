"""A robot with wheels, a lidar and a camera in one room: each may fail, and the others carry on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import gtsam
import numpy as np
import pytest
from flat_worlds import box, sweep
from room_world import SMALL, T_BODY_CAMERA, blind, furnished, render
from typer.testing import CliRunner

from slam.app.mapping import Measured
from slam.cli.commands import app
from slam.config import load_config
from slam.errors import ScanweaveError
from slam.evaluation.map_info import map_info
from slam.graph.edge import EdgeKind
from slam.mapper import map_result
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.mapping.layer_builder import LayerSettings
from slam.mapping.occupancy_grid import OCCUPIED
from slam.matching.planar import between, compose
from slam.measurements import (
    FloatArray,
    LaserScan,
    Measurement,
    RgbdFrame,
    WheelOdometry,
    pose2_from_row,
    row_from_pose2,
)
from slam.outputs.exports import Exports
from slam.outputs.finished_map import load_map
from slam.storage.map_contents import write_contents
from slam.storage.map_file import MapFile
from slam.storage.map_identity import MapIdentity
from slam.storage.nav2 import read_nav2_map
from slam.storage.nav2_layers import write_layers

# The room at the height of the lidar.
WALLS = np.concatenate([box(-2.5, -2.0, 2.5, 2.0), box(1.6, 0.4, 2.5, 1.5), box(-2.5, -2.0, -1.7, -1.1)])
MOUNT = gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([0.1, 0.0, 1.1])) * T_BODY_CAMERA
COUNT = 50
STEP = np.array([0.03, 0.0, 0.05])
SLIP = np.array([0.045, 0.0, 0.02])
GAP = range(15, 35)

Edit = Callable[[int, Measurement], Measurement | None]


def truth() -> FloatArray:
    poses = [np.array([0.3, -0.7, 0.2])]
    for _ in range(COUNT - 1):
        poses.append(compose(poses[-1], STEP))
    return np.array(poses)


@pytest.fixture(scope="module")
def drive() -> list[tuple[int, Measurement]]:
    """Wheels that slip in the middle; a scan and 10 ms before it a frame, ten times a second."""
    rng = np.random.default_rng(0)
    found: list[tuple[int, Measurement]] = []
    wheels = np.array([5.0, 1.0, -2.0])
    for n, pose in enumerate(truth()):
        stamp_s = 100.0 + 0.1 * n
        on_floor = gtsam.Pose3(gtsam.Rot3.Rz(pose[2]), np.array([pose[0], pose[1], 0.0]))
        frame = render(
            furnished(), on_floor * MOUNT, SMALL, stamp_s - 0.01, noise=(0.001, 0.0012), seed=n, smooth=False,
            T_base_camera=MOUNT,
        )  # fmt: skip
        wheels = compose(wheels, SLIP if n in GAP else STEP)
        found += [
            (n, frame),
            (n, WheelOdometry(stamp_s, pose2_from_row(wheels))),
            (n, sweep(WALLS, pose, beams=181, fov_rad=math.pi, sigma_m=0.01, seed=rng, stamp_s=stamp_s)),
        ]
    return found


def run(drive: list[tuple[int, Measurement]], edit: Edit, *overrides: str) -> MapResult:
    measurements = [edit(n, measurement) for n, measurement in drive]
    kept = Measured([measurement for measurement in measurements if measurement is not None])
    return build_map(kept, load_config(None, ["dense_map.enabled=false", *overrides]))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def whole_run(drive: list[tuple[int, Measurement]]) -> MapResult:
    return run(drive, whole)


@pytest.fixture(scope="module")
def without_lidar(drive: list[tuple[int, Measurement]]) -> MapResult:
    return run(drive, whole, "sensors.lidar=false")


def worst(result: MapResult) -> float:
    """Greatest distance of a reading's pose from its truth, both seen from the first."""
    poses, true = result.map.trajectory.to_planar(), truth()
    at = np.rint((result.map.trajectory.stamps_s - 100.0) / 0.1).astype(int)
    return max(
        math.hypot(*(between(poses[0], pose) - between(true[at[0]], true[n]))[:2])
        for n, pose in zip(at, poses, strict=True)
    )


def kinds(result: MapResult) -> set[EdgeKind]:
    return {factor.edge.kind for factor in result.map.factors} - {EdgeKind.LOOP}


def no_lidar(n: int, measurement: Measurement) -> Measurement | None:
    """The lidar is silent in the gap."""
    return None if n in GAP and isinstance(measurement, LaserScan) else measurement


def dead_camera(n: int, measurement: Measurement) -> Measurement | None:
    """The camera is black in the gap."""
    return blind(measurement) if n in GAP and isinstance(measurement, RgbdFrame) else measurement


def whole(n: int, measurement: Measurement) -> Measurement | None:
    return measurement


def test_all_sensors_hold_one_graph(whole_run: MapResult) -> None:
    assert worst(whole_run) < 0.02
    assert kinds(whole_run) >= {EdgeKind.LIDAR, EdgeKind.RGBD, EdgeKind.WHEEL}
    assert whole_run.map.grid is not None


def test_the_camera_bridges_a_silent_lidar(drive: list[tuple[int, Measurement]]) -> None:
    """Two seconds, while the wheels slip half as far again: without the camera that is seen."""
    bridged = run(drive, no_lidar)
    assert worst(bridged) < 0.05
    assert worst(run(drive, no_lidar, "sensors.rgbd=false")) > 2.0 * worst(bridged)
    assert any(scan is None for scan in bridged.map.keyframe_scans)
    assert any(scan is not None for scan in bridged.map.keyframe_scans)


def test_the_lidar_bridges_a_dead_camera(drive: list[tuple[int, Measurement]]) -> None:
    result = run(drive, dead_camera)
    assert worst(result) < 0.03
    assert any("Frames that matched nothing: " in note for note in result.warnings)


def test_the_camera_alone_on_wheels(without_lidar: MapResult) -> None:
    assert worst(without_lidar) < 0.06
    assert EdgeKind.LIDAR not in kinds(without_lidar)
    assert without_lidar.map.trajectory.positions_m[:, 2].max() == 0.0


def test_a_camera_that_begins_after_the_lidar_shows_its_first_step(
    drive: list[tuple[int, Measurement]],
) -> None:
    """Its first frame comes 90 ms after the scan that begins the map: it is carried back."""
    result = run(drive, lambda n, one: None if n == 0 and isinstance(one, RgbdFrame) else one)
    (step,) = (
        factor.edge
        for factor in result.map.factors
        if factor.edge.kind is EdgeKind.RGBD and factor.edge.source == 0
    )
    at = round((result.map.stamps_s[1] - 100.0) / 0.1)
    off = between(between(truth()[0], truth()[at]), row_from_pose2(step.T_source_target))
    sigmas = np.sqrt(step.covariance.diagonal())
    assert (np.abs(off) < [0.01, 0.01, 0.01]).all() and (np.abs(off) < 3.0 * sigmas).all()
    assert sigmas.max() < 0.03


def test_a_vehicle_may_be_taken_for_a_camera(drive: list[tuple[int, Measurement]]) -> None:
    """In space only the frames get poses, of the base, and these stay on its floor."""
    result = run(drive, whole, "sensors.motion=spatial")
    assert len(result.map.trajectory) == COUNT
    assert worst(result) < 0.05
    assert np.abs(result.map.trajectory.positions_m[:, 2]).max() < 0.05


def test_the_lidar_is_matched_from_the_first_keyframe(whole_run: MapResult) -> None:
    """A frame that comes just before the first scan does not begin the map without it."""
    assert whole_run.map.keyframe_scans[0] is not None
    assert (0, EdgeKind.LIDAR) in {(one.edge.source, one.edge.kind) for one in whole_run.map.factors}


def test_the_layers_show_what_each_sensor_saw(
    whole_run: MapResult, without_lidar: MapResult, tmp_path: Path
) -> None:
    config = load_config(None, ["dense_map.enabled=false"])
    both = whole_run.map.layers(config)
    assert both is not None
    written = {path.stem for path in write_layers(tmp_path, both)}
    assert written == {"lidar", "depth", "fused", "decision", "fused_probability"}
    assert whole_run.map.grids == {"occupancy": both.lidar, "depth layer": both.depth}
    alone = without_lidar.map.layers(config)
    assert alone is not None and alone.lidar is None and alone.depth is not None
    assert alone.names == ("depth", "fused", "decision")


def test_one_answer_to_which_map(whole_run: MapResult, tmp_path: Path) -> None:
    """What a robot loads, what is exported of the saved map, and the decision are one; the lidar's stays."""
    config = load_config(None, ["dense_map.enabled=false", "layers.robot_height_m=1.0"])
    result = whole_run
    exports = Exports(result.map, config)
    layers = exports.layers
    assert layers is not None
    exports.write_files(tmp_path)
    loaded = read_nav2_map(tmp_path / "map.yaml")
    decision = read_nav2_map(tmp_path / "layers" / "decision.yaml")
    np.testing.assert_array_equal(loaded.values, layers.states("decision"))
    np.testing.assert_array_equal(loaded.values, decision.values)
    # Not the lidar's, which looks over what is low.
    more = (loaded.values == OCCUPIED) & (layers.states("lidar") != OCCUPIED)
    assert np.count_nonzero(more) > 3
    file = MapFile.create(tmp_path / "map.db")
    for key, value in MapIdentity(config, "log", "0", {}).to_meta().items():
        file.add_meta(key, value)
    write_contents(file, result.map)
    file.seal()
    saved = load_map(tmp_path)
    for path in saved.export("nav2", tmp_path / "exported"):
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name
    assert saved.grid is not None and result.map.grid is not None
    np.testing.assert_array_equal(saved.grid.steps, result.map.grid.steps)
    saved.close()
    reported = map_info(tmp_path)["grids"]
    assert set(reported) == {"occupancy", "depth layer", "decision"}
    occupied_m2 = np.count_nonzero(loaded.values == OCCUPIED) * layers.resolution_m**2
    assert reported["decision"]["occupied_m2"] == pytest.approx(occupied_m2, abs=0.05)
    ends = ["--from", "0,0", "--to", "0.2,0", "--radius", "0.05", "--out", str(tmp_path / "way.png")]
    planned = CliRunner().invoke(app, ["plan", str(tmp_path), *ends])
    assert planned.exit_code == 0 and "from obstacles" in planned.output, planned.output


def test_a_setting_of_the_grid_reaches_every_map(
    drive: list[tuple[int, Measurement]], tmp_path: Path
) -> None:
    """The lidar's beams in front of a wall that is not there: some give no return."""

    def in_the_open(n: int, one: Measurement) -> Measurement | None:
        if isinstance(one, LaserScan):
            return replace(one, ranges_m=np.where(np.arange(181) % 5 == 0, np.inf, one.ranges_m).astype("f4"))
        return one if n % 5 == 0 or not isinstance(one, RgbdFrame) else None

    pictures: dict[str, dict[str, bytes]] = {}
    for setting in (
        "",
        "hit_probability=0.9",
        "miss_probability=0.3",
        "clear_range_m=0.5",
        "resolution_m=0.1",
    ):
        overrides = [f"grid.{setting}"] if setting else []
        folder = tmp_path / (setting or "as it is")
        folder.mkdir()
        config = load_config(None, ["dense_map.enabled=false", *overrides])
        result = run(drive[:60], in_the_open, *overrides)
        Exports(result.map, config).write_files(folder)
        paths = [folder / "map.pgm", *sorted((folder / "layers").glob("*.pgm"))]
        pictures[setting] = {path.stem: path.read_bytes() for path in paths}
    as_it_is = pictures.pop("")
    for setting, changed in pictures.items():
        same = {name for name, picture in as_it_is.items() if changed[name] == picture}
        assert same <= {"depth"}, f"the depth layer alone asks no beam, but {setting} changed no more"


def test_without_a_depth_layer_the_map_is_the_lidars(
    drive: list[tuple[int, Measurement]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for settings in (["sensors.rgbd=false"], ["layers.enabled=false"]):
        alone = run(drive[:60], whole, *settings).map.layers(load_config(None, settings))
        assert alone is not None and alone.depth is None and alone.names == ()
        np.testing.assert_array_equal(alone.states("decision"), alone.states("lidar"))

    def no_room(settings: LayerSettings) -> NoReturn:
        raise ScanweaveError("no room")

    monkeypatch.setattr(map_result, "LayerBuilder", no_room)
    seen = run(drive[:60], whole)
    alone = seen.map.layers(load_config())
    assert alone is not None and alone.depth is None
    assert [line for line in seen.warnings if "the map is from the lidar only: no room" in line]


def test_the_map_shows_what_every_camera_saw(drive: list[tuple[int, Measurement]]) -> None:
    """The first camera's frame of each keyframe, then the others', but for one that is lost."""
    doubled: list[tuple[int, Measurement]] = []
    for n, measurement in drive[:90]:
        doubled.append((n, measurement))
        if isinstance(measurement, RgbdFrame):
            other = replace(measurement, sensor="other")
            doubled.append((n, blind(other) if n >= 20 else other))
    made = run(doubled, whole).map
    assert made.frames is not None
    frames = list(made.frames)
    seen = [(round(10.0 * (frame.stamp_s - 100.0)), frame.sensor) for frame in frames]
    assert all((n, "other") in seen for n, name in seen if name != "other" and n < 20)
    assert all(n < 20 for n, name in seen if name == "other")
    first = dict(reversed(seen))
    assert "other" not in first.values()
    places = {key: pose.translation() for key, pose in zip(seen, made.frame_poses(), strict=True)}
    pairs = [(places[n, "other"], places[n, first[n]]) for n, name in seen if name == "other"]
    assert len(pairs) >= 4
    for one, another in pairs:
        np.testing.assert_allclose(one, another, atol=0.01)
