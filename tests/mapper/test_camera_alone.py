"""A hand-held camera end to end: a rendered round through a room, its mishaps, and real frames."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from room_world import LESS, Room, blind, furnished, render, turning_walk, write_tum_folder

from slam.comparison.dense_odometry import POINTS_IGNORED
from slam.comparison.methods import ODOMETRIES
from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.errors import DatasetError
from slam.evaluation.trajectory_error import absolute_error
from slam.graph.edge import EdgeKind
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.measurements import RgbdFrame
from slam.odometry import STANDARD
from slam.outputs.exports import Exports
from slam.storage.ply import read_cloud_ply

REDKITCHEN = Path(__file__).parents[3] / "shared" / "data" / "rgbd" / "redkitchen"
RATE_HZ = 15.0
COUNT = 60
NOISE = (0.001, 0.0012)


def walk() -> list[gtsam.Pose3]:
    return turning_walk(COUNT)


def images(room: Room) -> list[RgbdFrame]:
    return [
        render(room, pose, LESS, stamp_s=n / RATE_HZ, noise=NOISE, seed=n, smooth=False)
        for n, pose in enumerate(walk())
    ]


@pytest.fixture(scope="module")
def frames() -> list[RgbdFrame]:
    return images(furnished())


@pytest.fixture(scope="module")
def log(frames: list[RgbdFrame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tum_folder(tmp_path_factory.mktemp("room") / "log", frames, walk())


def run(path: Path, *overrides: str) -> MapResult:
    return build_map(open_dataset(path), load_config(None, ["dense_map.enabled=false", *overrides]))


def ate_m(result: MapResult, path: Path) -> float:
    truth = open_dataset(path).groundtruth()
    assert truth is not None
    return absolute_error(result.map.trajectory, truth).translation_m.rmse


@pytest.fixture(scope="module")
def mapped(log: Path) -> MapResult:
    return run(log)


def test_a_round_through_the_room(mapped: MapResult, log: Path) -> None:
    assert ate_m(mapped, log) < 0.01
    np.testing.assert_allclose(mapped.map.trajectory.stamps_s, np.arange(COUNT) / RATE_HZ, atol=1e-5)
    assert np.isfinite(mapped.map.trajectory.positions_m).all()
    np.testing.assert_allclose(np.linalg.norm(mapped.map.trajectory.quaternions_xyzw, axis=1), 1.0, atol=1e-9)


def test_the_map_begins_as_the_camera_looks(mapped: MapResult) -> None:
    """x along the first view, z up: the first walk goes about, at one height."""
    np.testing.assert_allclose(mapped.map.trajectory.positions_m[0], np.zeros(3), atol=1e-6)
    heights = mapped.map.trajectory.positions_m[:, 2]
    truth = np.array([pose.z() for pose in walk()])
    np.testing.assert_allclose(heights, truth - truth[0], atol=0.01)


def test_loops_close_at_the_return(mapped: MapResult) -> None:
    assert all(bool(loop.reason) != loop.accepted for loop in mapped.map.loops)
    numbers = mapped.map.readings
    accepted = [loop for loop in mapped.map.loops if loop.accepted]
    assert any(numbers[loop.keyframe] - numbers[loop.place] > 40 for loop in accepted)
    kinds = {factor.edge.kind for factor in mapped.map.factors}
    assert kinds == {EdgeKind.RGBD, EdgeKind.LOOP}


def test_keyframes_lie_on_the_trajectory(mapped: MapResult) -> None:
    assert mapped.map.frames is not None
    assert len(mapped.map.frame_poses()) == len(mapped.map.readings) == len(mapped.map.keyframe_poses)
    at = mapped.map.trajectory.positions_m[mapped.map.readings]
    np.testing.assert_allclose(at[:, :2], mapped.map.keyframe_poses[:, :2], atol=1e-9)
    stamps = [frame.stamp_s for frame in mapped.map.frames]
    np.testing.assert_allclose(stamps, mapped.map.trajectory.stamps_s[mapped.map.readings])
    assert mapped.map.grid is None


def test_the_same_log_and_seed_give_the_same_bytes(mapped: MapResult, log: Path, tmp_path: Path) -> None:
    folders = [tmp_path / "one", tmp_path / "two"]
    for folder, result in zip(folders, (mapped, run(log)), strict=True):
        folder.mkdir()
        exports = Exports(result.map, Config())
        exports.write_files(folder)
        exports.write_surfaces(folder)
    names, others = ({path.name for path in folder.iterdir()} for folder in folders)
    assert names == others >= {"trajectory.tum", "graph.g2o", "cloud.ply"}
    for name in names:
        one, two = ((folder / name).read_bytes() for folder in folders)
        assert one == two, name


def test_the_surface_needs_no_open3d(
    mapped: MapResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    written = Exports(mapped.map, Config()).write_surfaces(tmp_path)
    assert written == [tmp_path / "mesh.ply", tmp_path / "cloud.ply"]
    assert len(read_cloud_ply(written[1]).points_map) > 5000


@pytest.mark.parametrize("method", ["features", pytest.param("dense", marks=pytest.mark.open3d)])
def test_the_other_methods(method: str, frames: list[RgbdFrame], tmp_path: Path) -> None:
    """The first third of the round; they drift more."""
    path = write_tum_folder(tmp_path / "log", frames[:20], walk()[:20])
    settings = ["loops.enabled=false"]
    if method == "features":
        settings.append(f"rgbd_odometry.correlated_points={POINTS_IGNORED}")
    odometries = ODOMETRIES.get(method, STANDARD)
    result = build_map(open_dataset(path), load_config(None, settings), odometries=odometries)
    assert ate_m(result, path) < 0.05
    assert result.map.loops == []


@pytest.mark.parametrize("name", ["no loops", "a moved room"])
def test_variants(name: str, log: Path, tmp_path: Path) -> None:
    if name == "no loops":
        assert ate_m(run(log, "loops.enabled=false"), log) < 0.03
        return
    # The same room and walk elsewhere: the map does not know where the world begins.
    elsewhere = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, -0.3, 2.0), np.array([70.0, -40.0, 9.0]))
    room = furnished()
    moved = Room(room.inside, room.outside, frame=elsewhere)
    poses = [elsewhere * pose for pose in walk()][:20]
    seen = [render(moved, pose, LESS, stamp_s=n / RATE_HZ, smooth=False) for n, pose in enumerate(poses)]
    path = write_tum_folder(tmp_path / "log", seen, poses)
    assert ate_m(run(path), path) < 0.01


def edited(frames: list[RgbdFrame], path: Path, edit: Callable[[int, RgbdFrame], RgbdFrame | None]) -> Path:
    """The log with each frame replaced, or left out."""
    found = [(edit(n, frame), pose) for n, (frame, pose) in enumerate(zip(frames, walk(), strict=False))]
    kept = [(frame, pose) for frame, pose in found if frame is not None]
    return write_tum_folder(path, [frame for frame, _ in kept], [pose for _, pose in kept])


class TestMishaps:
    @pytest.mark.parametrize(("first", "count"), [(30, 2), (20, 14), (0, 4)])
    def test_a_dead_camera(self, first: int, count: int, frames: list[RgbdFrame], tmp_path: Path) -> None:
        """Black frames without depth for a moment, for long, and at the beginning: every frame has a pose.

        After a moment those that were seen lie where they were, across the gap too.
        """
        frames = frames[: COUNT if count == 2 else first + count + 8]
        path = edited(
            frames, tmp_path / "log", lambda n, frame: blind(frame) if first <= n < first + count else frame
        )
        result = run(path)
        assert len(result.map.trajectory) == len(frames)
        assert np.isfinite(result.map.trajectory.positions_m).all()
        unmatched = np.flatnonzero(np.isnan(result.scans.inlier_shares))
        assert set(range(max(first, 1), first + count)) <= set(unmatched.tolist())
        assumed = [
            edge for edge in (factor.edge for factor in result.map.factors) if edge.kind is EdgeKind.ASSUMED
        ]
        assert bool(assumed) == (count > 10 or first == 0)
        true_m = np.array([pose.translation() - walk()[0].translation() for pose in walk()[: len(frames)]])
        off_m = np.linalg.norm(result.map.trajectory.positions_m - true_m, axis=1)
        assert count != 2 or np.delete(off_m, np.arange(first, first + count)).max() < 0.02

    @pytest.mark.parametrize("missing", [2, 5])
    def test_a_gap_in_time(self, missing: int, frames: list[RgbdFrame], tmp_path: Path) -> None:
        """Bridged where enough is still in sight; else what comes after is sound in itself."""
        gap = range(20, 20 + missing)
        path = edited(frames[:40], tmp_path / "log", lambda n, frame: None if n in gap else frame)
        result = run(path)
        estimate, truth = result.map.trajectory, open_dataset(path).groundtruth()
        assert truth is not None
        assert len(estimate) == 40 - missing
        steps = [np.linalg.norm(np.diff(t.positions_m, axis=0), axis=1) for t in (estimate, truth)]
        sound = np.abs(steps[0] - steps[1]) < 0.01
        assert sound[:19].all()
        assert sound.all() or (missing == 5 and sound[-5:].all())

    def test_only_dead_frames(self, frames: list[RgbdFrame], tmp_path: Path) -> None:
        """Nothing to map from, and still an answer: it stays where it was."""
        path = edited(frames, tmp_path / "log", lambda n, frame: blind(frame) if n < 15 else None)
        result = run(path)
        assert np.abs(result.map.trajectory.positions_m).max() < 1e-6

    def test_one_frame(self, frames: list[RgbdFrame], tmp_path: Path) -> None:
        path = edited(frames, tmp_path / "log", lambda n, frame: frame if n == 0 else None)
        result = run(path)
        assert len(result.map.trajectory) == 1
        assert result.map.readings.tolist() == [0]

    def test_the_last_of_few_frames_is_as_sure_as_it_was_matched(
        self, frames: list[RgbdFrame], tmp_path: Path
    ) -> None:
        path = edited(frames, tmp_path / "log", lambda n, frame: frame if n < 2 else None)
        result = run(path)
        assert result.map.readings.tolist() == [0, 1]
        assert result.map.covariances is not None
        first, last = (np.trace(one[:3, :3]) for one in result.map.covariances)
        assert 2.0 * first < last < 0.01**2


def test_without_its_camera_there_is_nothing_to_map(log: Path) -> None:
    with pytest.raises(DatasetError, match="no scan or frame"):
        run(log, "sensors.rgbd=false")


@pytest.mark.skipif(not REDKITCHEN.is_dir(), reason=f"no real frames in {REDKITCHEN}")
def test_the_red_kitchen(tmp_path: Path) -> None:
    """Two seconds of a real Kinect."""
    folder = tmp_path / "redkitchen"
    folder.mkdir()
    for file in sorted(REDKITCHEN.iterdir()):
        number = file.name[6:12]
        if not number.isdigit() or int(number) < 60:
            (folder / file.name).symlink_to(file)
    result = run(folder, "rgbd.registration=given")
    assert len(result.map.trajectory) == 60
    assert not np.isnan(result.scans.inlier_shares[1:]).any()
    assert ate_m(result, folder) < 0.02
