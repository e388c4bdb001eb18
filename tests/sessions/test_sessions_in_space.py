"""Sessions of a 3D lidar and of a camera in space: joined right, rolled back, or refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import OTHER, WAY, drive, seen, write_log
from command_line import outcome_of, run
from room_world import LESS, furnished, render, turning_walk, write_tum_folder

from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import absolute_error
from slam.measurements import FloatArray
from slam.outputs.finished_map import load_map
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.tum import read_tum

COARSE = ("--set", "cloud_odometry.voxel_m=0.25", "--set", "dense_map.enabled=false")
FIRST, LATER = drive(WAY), drive(OTHER)[:30]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives through two rooms, the first part of one of them, and the rooms smaller and mirrored."""
    folder = tmp_path_factory.mktemp("logs")
    write_log(folder / "first", seen(FIRST, 0), FIRST)
    write_log(folder / "later", seen(LATER, 100), LATER)
    write_log(folder / "part", seen(FIRST[:18], 0), FIRST[:18])
    small = np.array([0.8, -0.8, 1.0], np.float32)
    mirrored = [replace(cloud, points_lidar=cloud.points_lidar * small) for cloud in seen(LATER[:18], 200)]
    write_log(folder / "mirrored", mirrored)
    return folder


@pytest.fixture(scope="module")
def mapped(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mapped") / "map"
    assert run("map", logs / "first", "-o", folder, *COARSE) == 0
    return folder


@pytest.fixture(scope="module")
def joined(logs: Path, mapped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("joined") / "map"
    shutil.copytree(mapped, folder)
    assert run("map", logs / "later", "--into", folder) == 0
    return folder


def offsets_m(folder: Path, poses: Sequence[Sequence[gtsam.Pose3]]) -> FloatArray:
    """How far each session's poses are off; the map's frame is where the first drive began."""
    away = []
    for n, truth in enumerate(poses, start=1):
        found = read_tum(folder / f"trajectory-{n}.tum").positions_m
        expected = [poses[0][0].between(pose).translation() for pose in truth]
        away.append(np.linalg.norm(found - np.array(expected), axis=1))
    return np.concatenate(away)


def test_both_lie_in_one_frame(joined: Path) -> None:
    away = offsets_m(joined, [FIRST, LATER])
    assert len(away) == len(FIRST) + len(LATER)
    assert np.sqrt(np.mean(away**2)) < 0.03 and away.max() < 0.1


def test_nothing_is_lost(mapped: Path, joined: Path) -> None:
    before, after = load_map(mapped), load_map(joined)
    after.check()
    first, second = after.sessions
    assert first.keyframes == len(before.keyframe_poses) and second.poses == len(LATER)
    clouds = before.contents.clouds, after.contents.clouds
    assert clouds[0] is not None and clouds[1] is not None
    assert len(clouds[1]) == first.keyframes + second.keyframes
    for key in range(first.keyframes):
        np.testing.assert_array_equal(clouds[0].points(key), clouds[1].points(key))
    assert after.contents.ground_m == before.contents.ground_m
    assert after.grid is not None and after.covariances is not None
    assert np.linalg.eigvalsh(after.covariances)[1:].min() > 0.0
    bridges = [f.edge for f in after.factors if f.edge.source < first.keyframes <= f.edge.target]
    assert len(bridges) >= 3 and all(edge.kind.value == "loop" for edge in bridges)
    before.close()
    after.close()


def test_the_other_commands_take_it(
    logs: Path, joined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert json.loads(outcome_of(capsys, "info", joined, "--json").out)["sessions"] == 2
    assert outcome_of(capsys, "check", joined).code == 0
    found = load_map(joined)
    assert found.digest[:12] in (joined / "report.html").read_text()
    found.close()
    assert outcome_of(capsys, "export", joined, "--format", "nav2", "-o", tmp_path / "nav2").code == 0
    assert outcome_of(capsys, "export", joined, "--format", "ply", "-o", tmp_path / "cloud.ply").code == 0
    outcome = outcome_of(capsys, "localize", joined, logs / "part", "-o", tmp_path / "localized", *COARSE)
    assert outcome.code == 0 and "tracking" in outcome.out


def test_what_does_not_belong_leaves_the_map_as_it_was(
    logs: Path, mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(mapped, tmp_path / "map"))
    before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    error = outcome_of(capsys, "map", logs / "mirrored", "--into", folder).error()
    assert "does not connect" in error and "the map was not changed" in error
    assert "is already in" in outcome_of(capsys, "map", logs / "first", "--into", folder).error()
    assert (
        "keyframes are in the map already"
        in outcome_of(capsys, "map", logs / "part", "--into", folder).error()
    )
    flat = write_synthetic_log(tmp_path / "flat", seed=1, duration_s=10.0).log_path
    assert "a robot on a floor" in outcome_of(capsys, "map", flat, "--into", folder).error()
    assert {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before
    assert not (folder / "joining").exists()


def test_a_session_is_taken_back(
    mapped: Path, joined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(joined, tmp_path / "map"))
    assert "1 to 1 can stay, not 2" in outcome_of(capsys, "edit", folder, "--sessions", 2).error()
    assert outcome_of(capsys, "edit", folder, "--sessions", 1).code == 0
    with load_map(folder) as found, load_map(mapped) as before:
        found.check()
        assert list(found.sessions) == list(before.sessions) and found.identity == before.identity
        assert [loop.accepted for loop in found.loops] == [loop.accepted for loop in before.loops]
        assert found.grid is not None and before.grid is not None
        np.testing.assert_array_equal(found.grid.steps, before.grid.steps)
        np.testing.assert_allclose(found.keyframe_poses, before.keyframe_poses, atol=1e-5)
        np.testing.assert_allclose(found.trajectory.positions_m, before.trajectory.positions_m, atol=1e-4)
        assert found.covariances is not None and before.covariances is not None
        np.testing.assert_allclose(found.covariances, before.covariances, rtol=0.1, atol=1e-6)
    assert (folder / "map.pgm").read_bytes() == (mapped / "map.pgm").read_bytes()
    assert not list(folder.glob("trajectory-*")) and not (folder / "report-2.html").exists()


WALKS = [turning_walk(60), turning_walk(72, 1.0, 0.55)[30:]]


def filmed(folder: Path, poses: Sequence[gtsam.Pose3], seed: int = 0) -> Path:
    """A log of a camera that is carried through a furnished room, each seed another one."""
    frames = [
        render(furnished(seed), pose, LESS, stamp_s=n / 15.0, noise=(0.001, 0.0012), seed=n, smooth=False)
        for n, pose in enumerate(poses)
    ]
    return write_tum_folder(folder, frames, list(poses))


def test_a_camera_in_space_joins_its_own_room_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "map"
    first, later = (filmed(tmp_path / name, poses) for name, poses in zip("ab", WALKS, strict=True))
    assert run("map", first, "-o", folder, *COARSE) == 0
    before = (folder / "map.db").read_bytes()
    other = filmed(tmp_path / "other", WALKS[1][:20], seed=5)
    error = outcome_of(capsys, "map", other, "--into", folder).error()
    assert "none of its places was recognised" in error and (folder / "map.db").read_bytes() == before

    assert outcome_of(capsys, "map", later, "--into", folder).code == 0
    with load_map(folder) as found:
        found.check()
        ends = [(f.edge.source, f.edge.target) for f in found.factors]
        middle = found.sessions[0].keyframes
        assert sum(source < middle <= target for source, target in ends) >= 3
    found_m = np.concatenate([read_tum(folder / f"trajectory-{n}.tum").positions_m for n in (1, 2)])
    true_m = np.array([pose.translation() for walk in WALKS for pose in walk])
    stamps_s = np.arange(float(len(true_m)))
    parts = (
        Trajectory(stamps_s, rows, np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1)))
        for rows in (found_m, true_m)
    )
    assert absolute_error(*parts).translation_m.rmse < 0.01
    outcome = outcome_of(capsys, "localize", folder, later, "-o", tmp_path / "localized")
    assert outcome.code == 0 and "tracking" in outcome.out
