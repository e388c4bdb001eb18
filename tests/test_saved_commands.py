"""scanweave info, check, export and map --resume, as a user meets them."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest
from command_line import Scanweave, run, scanweave
from room_world import LESS, furnished, render, turning_walk, write_tum_folder

from slam.mapper.checkpoint import Checkpoint
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log
from slam.storage.map_file import MapFile

__all__ = ["scanweave"]  # a fixture


def mapped(log: Path, out: Path, *settings: str) -> Path:
    assert run("map", log, "-o", out, *settings) == 0
    return out


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    return write_synthetic_log(tmp_path_factory.mktemp("log"), duration_s=12.0)


@pytest.fixture(scope="module")
def lidar_map(log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mapped(log.log_path, tmp_path_factory.mktemp("mapped"), "--set", "seed=3")


@pytest.fixture(scope="module")
def camera_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a camera in the hand, seven frames."""
    folder = tmp_path_factory.mktemp("room")
    walk = turning_walk(60)[:7]
    frames = [render(furnished(), pose, LESS, stamp_s=n / 15.0) for n, pose in enumerate(walk)]
    log = write_tum_folder(folder / "log", frames, walk)
    settings = ("dense_map.voxel_m=0.05", "keyframes.angle_rad=0.05", "rgbd.registration=given")
    return mapped(log, folder / "out", *[part for setting in settings for part in ("--set", setting)])


@pytest.fixture
def unfinished(log: SyntheticLog, lidar_map: Path, scanweave: Scanweave, tmp_path: Path) -> Path:
    """A folder in which a run was interrupted."""

    def interrupted(checkpoint: Checkpoint, content: bytes) -> None:
        if checkpoint._count > 30:
            raise KeyboardInterrupt
        keep(checkpoint, content)

    keep = Checkpoint.keep
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoint, "keep", interrupted)
        outcome = scanweave("map", log.log_path, "-o", tmp_path / "out", "--set", "seed=3")
    assert outcome.code == 130
    assert "map.db is kept; the same command with --resume" in outcome.err
    return tmp_path / "out"


class TestInfo:
    def test_for_people(self, scanweave: Scanweave, lidar_map: Path) -> None:
        outcome = scanweave("info", lidar_map)
        assert (outcome.code, outcome.err) == (0, "")
        for part in ("scans.log", "planar", "keyframes:", "seed 3", "gtsam", "occupancy"):
            assert part in outcome.out, part

    def test_for_programs(self, scanweave: Scanweave, lidar_map: Path, camera_map: Path) -> None:
        found = json.loads(scanweave("info", lidar_map / "map.db", "--json").out)
        assert found["settings"] == {"seed": 3} and found["finished"] is True
        assert found["sensors"] == {"FLASER": found["keyframes"]}
        assert found["factors"]["lidar match"] == found["keyframes"] - 1
        assert found["poses"] == 182 and 5.0 < found["path_length_m"] < 8.0
        assert found["grids"]["occupancy"]["resolution_m"] == 0.05
        found = json.loads(scanweave("info", camera_map, "--json").out)
        assert (found["motion"], found["sensors"]) == ("spatial", {"camera": found["keyframes"]})
        assert found["grids"] == {}

    def test_of_a_map_with_a_calibration(
        self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path
    ) -> None:
        known = tmp_path / "known.yaml"
        known.write_text("lidars: {FLASER: {range_scale: 1.01}}")
        folder = mapped(log.log_path, tmp_path / "out", "--calibration", str(known))
        found = json.loads(scanweave("info", folder, "--json").out)
        assert found["settings"] == {"sensors.calibration.lidars.FLASER.range_scale": 1.01}

    def test_of_an_unfinished_map(self, scanweave: Scanweave, unfinished: Path) -> None:
        found = json.loads(scanweave("info", unfinished, "--json").out)
        assert (found["finished"], found["log"], found["settings"]) == (False, "scans.log", {"seed": 3})
        assert "finished:" in scanweave("info", unfinished).out
        (unfinished / "map.db").write_bytes(b"")
        assert "not an SQLite file" in scanweave("info", unfinished).error()


class TestCheck:
    def test_a_whole_map(self, scanweave: Scanweave, lidar_map: Path, camera_map: Path) -> None:
        for folder in (lidar_map, camera_map):
            outcome = scanweave("check", folder)
            assert (outcome.code, outcome.err) == (0, "")
            assert f"{folder / 'map.db'} is whole" in outcome.out

    def test_a_damaged_image(self, scanweave: Scanweave, camera_map: Path, tmp_path: Path) -> None:
        content = bytearray((camera_map / "map.db").read_bytes())
        at = content.rindex(b"IHDR")
        content[at + 300] ^= 4
        (tmp_path / "map.db").write_bytes(content)
        error = scanweave("check", tmp_path).error()
        assert "table images, row" in error and "checksum is wrong" in error

    @pytest.mark.parametrize("command", [["info"], ["check"], ["export", "--format", "tum", "-o", "x"]])
    def test_what_is_no_map(
        self, scanweave: Scanweave, tmp_path: Path, unfinished: Path, log: SyntheticLog, command: list[str]
    ) -> None:
        assert "no map at" in scanweave(*command, tmp_path / "nowhere").error()
        assert "no map at" in scanweave(*command, tmp_path).error()
        assert "not an SQLite file" in scanweave(*command, log.log_path).error()
        if command != ["info"]:
            error = scanweave(*command, unfinished).error()
            assert "is not finished" in error and "--resume" in error


class TestExport:
    @pytest.mark.parametrize(
        ("format_", "names"),
        [
            ("nav2", ["map.yaml", "map.pgm"]),
            ("tum", ["trajectory.tum", "trajectory_covariance.csv"]),
            ("g2o", ["graph.g2o"]),
        ],
    )
    def test_the_bytes_of_the_run(
        self, scanweave: Scanweave, lidar_map: Path, tmp_path: Path, format_: str, names: list[str]
    ) -> None:
        outcome = scanweave("export", lidar_map, "--format", format_, "-o", tmp_path / "out")
        assert outcome.code == 0 and str(tmp_path / "out" / names[0]) in outcome.out
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(names)
        for name in names:
            assert (tmp_path / "out" / name).read_bytes() == (lidar_map / name).read_bytes()

    def test_of_a_camera(self, scanweave: Scanweave, camera_map: Path, tmp_path: Path) -> None:
        for format_ in ("ply", "tum", "g2o"):
            assert scanweave("export", camera_map, "--format", format_, "-o", tmp_path).code == 0
        for name in ("trajectory.tum", "trajectory_covariance.csv", "graph.g2o", "mesh.ply", "cloud.ply"):
            assert (tmp_path / name).read_bytes() == (camera_map / name).read_bytes(), name
        pytest.importorskip("octomap")
        assert scanweave("export", camera_map, "--format", "bt", "-o", tmp_path / "house.bt").code == 0
        assert (tmp_path / "house.bt").read_bytes().startswith(b"# Octomap")

    def test_names_of_ones_own(self, scanweave: Scanweave, lidar_map: Path, tmp_path: Path) -> None:
        assert scanweave("export", lidar_map, "--format", "nav2", "-o", tmp_path / "house.yaml").code == 0
        assert "image: house.pgm" in (tmp_path / "house.yaml").read_text()
        assert scanweave("export", lidar_map, "--format", "g2o", "-o", tmp_path / "a.g2o").code == 0
        assert (tmp_path / "a.g2o").read_bytes() == (lidar_map / "graph.g2o").read_bytes()

    def test_what_is_not_there(
        self, scanweave: Scanweave, lidar_map: Path, camera_map: Path, tmp_path: Path
    ) -> None:
        none = tmp_path / "none"
        assert "holds no image" in scanweave("export", lidar_map, "--format", "ply", "-o", none).error()
        assert not none.exists()
        assert "holds no grid" in scanweave("export", camera_map, "--format", "nav2", "-o", tmp_path).error()
        assert scanweave("export", lidar_map, "--format", "png", "-o", tmp_path).code == 2
        (tmp_path / "file").write_text("mine")
        assert (
            "folder"
            in scanweave("export", lidar_map, "--format", "tum", "-o", tmp_path / "file" / "x").error()
        )


class TestResume:
    def test_it_goes_on(
        self, scanweave: Scanweave, log: SyntheticLog, lidar_map: Path, unfinished: Path
    ) -> None:
        outcome = scanweave("map", log.log_path, "-o", unfinished, "--set", "seed=3", "--resume")
        assert outcome.code == 0 and f"going on with {unfinished / 'map.db'}" in outcome.err
        for path in lidar_map.iterdir():
            if path.name != "report.html":  # which contains times
                assert (unfinished / path.name).read_bytes() == path.read_bytes(), path.name
        again = scanweave("map", log.log_path, "-o", unfinished, "--set", "seed=3", "--resume")
        assert again.code == 0 and "is already finished; there is nothing to resume" in again.out

    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            (["--set", "seed=4"], "begun with seed=3, not 4"),
            (["--set", "seed=3", "--no-loops"], "begun with loops.enabled=True, not False"),
        ],
    )
    def test_other_settings(
        self, scanweave: Scanweave, log: SyntheticLog, unfinished: Path, settings: list[str], said: str
    ) -> None:
        before = (unfinished / "map.db").read_bytes()
        error = scanweave("map", log.log_path, "-o", unfinished, "--resume", *settings).error()
        assert "cannot be resumed" in error and said in error
        assert scanweave("map", log.log_path, "-o", unfinished, "--set", "seed=3", "--resume").code == 0
        assert before != (unfinished / "map.db").read_bytes()

    def test_another_log(
        self, scanweave: Scanweave, log: SyntheticLog, unfinished: Path, lidar_map: Path, tmp_path: Path
    ) -> None:
        other = write_synthetic_log(tmp_path / "other", seed=1, duration_s=12.0).log_path
        for folder in (unfinished, lidar_map):  # nor is a finished one of another log
            error = scanweave("map", other, "-o", folder, "--set", "seed=3", "--resume").error()
            assert "begun with another log, scans.log" in error

    @pytest.mark.parametrize("name", ["code", "numpy"])
    def test_other_versions(
        self,
        scanweave: Scanweave,
        log: SyntheticLog,
        unfinished: Path,
        monkeypatch: pytest.MonkeyPatch,
        name: str,
    ) -> None:
        from slam.storage import map_identity

        known = map_identity._versions()
        if name == "code":
            monkeypatch.setattr(map_identity, "_code_digest", lambda: "edited")
        else:
            monkeypatch.setattr(map_identity, "_versions", lambda: known | {name: "9.9"})
        error = scanweave("map", log.log_path, "-o", unfinished, "--set", "seed=3", "--resume").error()
        assert "cannot be resumed" in error and f"begun with {name} " in error

    def test_nothing_to_resume(self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path) -> None:
        outcome = scanweave("map", log.log_path, "-o", tmp_path, "--resume")
        assert outcome.code == 0 and "nothing to resume" in outcome.err

    def test_without_it_an_unfinished_map_is_replaced(
        self, scanweave: Scanweave, log: SyntheticLog, unfinished: Path
    ) -> None:
        outcome = scanweave("map", log.log_path, "-o", unfinished)
        assert outcome.code == 0 and "replacing" in outcome.err
        assert scanweave("check", unfinished).code == 0
        assert "replacing" not in scanweave("map", log.log_path, "-o", unfinished).err

    def test_a_damaged_journal(self, scanweave: Scanweave, log: SyntheticLog, unfinished: Path) -> None:
        with sqlite3.connect(unfinished / "map.db") as connection:
            connection.execute("UPDATE journal SET first = 1")
        connection.close()
        outcome = scanweave("map", log.log_path, "-o", unfinished, "--set", "seed=3", "--resume")
        assert outcome.code == 1 and "table journal, row 0: its checksum" in outcome.err.splitlines()[-1]

    @pytest.mark.parametrize("died", ["before the tidying up", "before its end"])
    def test_killed_after_its_last_word(
        self, scanweave: Scanweave, log: SyntheticLog, lidar_map: Path, unfinished: Path, died: str
    ) -> None:
        command = ("map", log.log_path, "-o", unfinished, "--set", "seed=3", "--resume")
        with pytest.MonkeyPatch.context() as patch:
            if died == "before the tidying up":
                patch.setattr(MapFile, "compact", MapFile.close)
            else:
                patch.setattr("slam.storage.map_file.settle_counts", lambda path: None)
            assert scanweave(*command).code == 0
        whole = (lidar_map / "map.db").read_bytes()
        assert (unfinished / "map.db").read_bytes() != whole
        assert "is already finished" in scanweave(*command).out
        assert (unfinished / "map.db").read_bytes() == whole
        assert scanweave("check", unfinished).code == 0

    def test_a_finished_map_that_was_damaged(
        self, scanweave: Scanweave, log: SyntheticLog, lidar_map: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "map.db").write_bytes((lidar_map / "map.db").read_bytes())
        with sqlite3.connect(tmp_path / "map.db") as connection:
            connection.execute("DELETE FROM factors WHERE number = 28 - 1")
        connection.close()
        error = scanweave("map", log.log_path, "-o", tmp_path, "--set", "seed=3", "--resume").error()
        assert "table factors" in error

    def test_two_runs_at_once(self, scanweave: Scanweave, log: SyntheticLog, unfinished: Path) -> None:
        other = MapFile.resume(unfinished / "map.db")
        assert other is not None
        for resume in ([], ["--resume"]):
            error = scanweave("map", log.log_path, "-o", unfinished, "--set", "seed=3", *resume).error()
            assert "another run is writing it" in error
        other.close()


def test_a_map_inside_the_folder_of_its_log(scanweave: Scanweave, log: SyntheticLog, tmp_path: Path) -> None:
    """What earlier runs have left there is no part of the log."""
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "scans.log").write_bytes(log.log_path.read_bytes())
    assert scanweave("map", folder, "-o", folder / "one").code == 0
    assert scanweave("map", folder, "-o", folder).code == 0
    for out in (folder, folder / "one"):
        assert "already finished" in scanweave("map", folder, "-o", out, "--resume").out
    (folder / "scans.log").write_bytes(log.log_path.read_bytes()[:-200])
    assert "another log" in scanweave("map", folder, "-o", folder, "--resume").error()
