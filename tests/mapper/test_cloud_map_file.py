"""A 3D lidar's map.db, as a user meets it: resumed, checked, reported, exported; and what it cannot do."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import ROOM, SMALL, look, way_round, write_log
from command_line import Scanweave, assert_one_line_error, run
from command_line import scanweave as scanweave

from slam.mapper.checkpoint import Checkpoint
from slam.matching.local_cloud import moved
from slam.outputs.finished_map import load_map

COUNT = 9
SETTINGS = [
    part
    for setting in (*SMALL, "cloud_loops.least_path_voxels=4", "grid.resolution_m=0.2")
    for part in ("--set", setting)
]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """There and back."""
    poses = way_round(36)[: COUNT // 2 + 1]
    poses += poses[::-1][1:]
    clouds = [look(pose, 0.1 * number, seed=number) for number, pose in enumerate(poses)]
    return write_log(tmp_path_factory.mktemp("there and back") / "log", clouds, poses)


@pytest.fixture(scope="module")
def mapped(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its map."""
    out = tmp_path_factory.mktemp("clouds mapped")
    assert run("map", log, "-o", out, *SETTINGS) == 0
    return out


def test_it_is_whole_and_shows_what_it_holds(scanweave: Scanweave, mapped: Path) -> None:
    outcome = scanweave("check", mapped)
    assert outcome.code == 0 and "keyframes" in outcome.out and "clouds" in outcome.out, outcome
    found = json.loads(scanweave("info", mapped, "--json").out)
    assert (found["motion"], found["poses"]) == ("spatial", COUNT)
    assert found["clouds"] == found["keyframes"] >= 3
    assert found["grids"]["occupancy"]["occupied_m2"] > 1.0


@pytest.mark.parametrize(
    ("format_", "names"),
    [
        ("nav2", ("map.yaml", "map.pgm")),
        ("tum", ("trajectory.tum", "trajectory_covariance.csv")),
        ("g2o", ("graph.g2o",)),
        ("ply", ("cloud.ply",)),
    ],
)
def test_what_is_exported_is_what_the_run_has_written(
    scanweave: Scanweave, mapped: Path, tmp_path: Path, format_: str, names: tuple[str, ...]
) -> None:
    outcome = scanweave("export", mapped, "-f", format_, "-o", tmp_path)
    assert outcome.code == 0, outcome.err
    assert {path.name for path in tmp_path.iterdir()} == set(names)
    for name in names:
        assert (tmp_path / name).read_bytes() == (mapped / name).read_bytes(), name


def test_interrupted_and_resumed(
    scanweave: Scanweave, log: Path, mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After some clouds are in the map, in the last commit or not: the same bytes in the end."""
    cached, asked, stop_at = Checkpoint.cached, 0, 0

    def interrupted(
        checkpoint: Checkpoint, question: str, key: float, compute: Callable[[], object]
    ) -> object:
        nonlocal asked
        asked += 1
        if asked == stop_at:
            raise KeyboardInterrupt
        return cached(checkpoint, question, key, compute)

    out = tmp_path / "out"
    for moment in (5, 9):
        asked, stop_at = 0, moment
        with monkeypatch.context() as patch:
            patch.setattr(Checkpoint, "cached", interrupted)
            outcome = scanweave("map", log, "-o", out, "--resume", *SETTINGS)
        assert outcome.code == 130, outcome.err
    assert json.loads(scanweave("info", out, "--json").out)["clouds"] >= 2
    assert scanweave("map", log, "-o", out, "--resume", *SETTINGS).code == 0
    for name in ("map.db", "trajectory.tum", "graph.g2o", "map.pgm", "cloud.ply"):
        assert (out / name).read_bytes() == (mapped / name).read_bytes(), name


def test_a_log_that_is_in_the_map_is_not_joined_again(scanweave: Scanweave, log: Path, mapped: Path) -> None:
    before = (mapped / "map.db").read_bytes()
    assert_one_line_error(scanweave("map", log, "--into", mapped), "is already in")
    assert (mapped / "map.db").read_bytes() == before


def test_the_clouds_are_where_they_were_seen(log: Path, mapped: Path) -> None:
    """Every kept point lies on the room's walls, floor, ceiling or pillars."""
    saved, start = load_map(mapped), way_round(36)[0]
    for points, pose in zip(saved.contents.clouds or (), saved.contents.node_poses, strict=True):
        assert isinstance(pose, gtsam.Pose3)
        placed = moved(points, start.compose(pose))
        off = np.abs(placed[:, :, None] - ROOM[None]).min(axis=(1, 2))
        assert np.median(off) < 0.03
    saved.close()
