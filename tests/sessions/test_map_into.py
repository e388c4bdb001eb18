"""scanweave map LOG --into MAP: what is joined is right, what is not leaves the map as it was."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from command_line import outcome_of, run
from session_runs import Sessions, sessions_in

from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import absolute_error
from slam.mapper.checkpoint import Checkpoint
from slam.outputs.finished_map import load_map
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.tum import read_tum
from slam.storage.whole_folder import only_one_in

APART_S = 1e5
COARSE = ("--set", "keyframes.distance_m=1.5", "--set", "keyframes.angle_rad=3")


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Sessions:
    return sessions_in(tmp_path_factory.mktemp("sessions"))


@pytest.fixture(scope="module")
def mapped(sessions: Sessions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mapped") / "map"
    assert run("map", sessions.first.log_path, "-o", folder) == 0
    return folder


@pytest.fixture(scope="module")
def joined(sessions: Sessions, mapped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("joined") / "map"
    shutil.copytree(mapped, folder)
    assert run("map", sessions.later_log, "--into", folder) == 0
    return folder


@pytest.fixture
def map_(mapped: Path, tmp_path: Path) -> Path:
    """A map of one's own."""
    return Path(shutil.copytree(mapped, tmp_path / "map"))


def contents_of(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def error_m(sessions: Sessions, parts: list[Trajectory], truths: list[Trajectory]) -> float:
    """Of several trajectories together, after one rigid alignment."""
    whole, truth = (
        Trajectory(
            np.concatenate([one.stamps_s + n * APART_S for n, one in enumerate(group)]),
            np.concatenate([one.positions_m for one in group]),
            np.concatenate([one.quaternions_xyzw for one in group]),
        )
        for group in (parts, truths)
    )
    return absolute_error(whole, truth).translation_m.rmse


class TestJoined:
    def test_both_lie_in_one_frame(self, sessions: Sessions, joined: Path) -> None:
        parts = [read_tum(joined / f"trajectory-{n}.tum") for n in (1, 2)]
        truths = [sessions.first.truth, sessions.later.truth]
        assert error_m(sessions, parts, truths) < 0.03
        assert absolute_error(parts[0], truths[0]).translation_m.rmse < 0.02

    def test_nothing_is_lost(self, sessions: Sessions, mapped: Path, joined: Path) -> None:
        before, after = load_map(mapped), load_map(joined)
        after.check()
        first, second = after.sessions
        assert (first.keyframes, first.poses) == (len(before.keyframe_poses), len(before.trajectory))
        assert second.log_name == "later.log" and second.poses == len(read_tum(joined / "trajectory-2.tum"))
        assert len(after.keyframe_poses) == first.keyframes + second.keyframes
        for one, other in zip(before.keyframe_scans, after.keyframe_scans, strict=False):
            assert one is not None and other is not None
            np.testing.assert_array_equal(one.ranges_m, other.ranges_m)
        bridges = [f.edge for f in after.factors if f.edge.source < first.keyframes <= f.edge.target]
        assert len(bridges) >= 3 and all(edge.kind.value == "loop" for edge in bridges)
        for edge in (factor.edge for factor in after.factors if factor.edge.kind.value == "loop"):
            assert edge.loop is not None
            loop = after.loops[edge.loop]
            assert (edge.source, edge.target) == (loop.place, loop.keyframe)
        assert not (joined / "joining").exists()
        before.close()
        after.close()

    def test_the_other_commands_take_it(
        self, sessions: Sessions, joined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        info = json.loads(outcome_of(capsys, "info", joined, "--json").out)
        assert info["sessions"] == 2 and 40.0 < info["duration_s"] < 60.0
        assert outcome_of(capsys, "check", joined).code == 0
        assert outcome_of(capsys, "export", joined, "--format", "nav2", "-o", tmp_path / "nav2").code == 0
        localized = outcome_of(capsys, "localize", joined, sessions.prefix, "-o", tmp_path / "localized")
        assert localized.code == 0 and "tracking" in localized.out

    def test_a_third_session(
        self, sessions: Sessions, joined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        third = write_synthetic_log(tmp_path / "third", seed=3, duration_s=18.0)
        out = tmp_path / "three"
        outcome = outcome_of(capsys, "map", third.log_path, "--into", joined, "--out", out)
        assert outcome.code == 0, outcome.err
        two, three = load_map(joined), load_map(out)
        assert list(three.sessions[:2]) == list(two.sessions) and len(three.sessions) == 3
        # The clocks of all three overlap: what is one's must not be carried along with another's keyframes.
        parts = [read_tum(out / f"trajectory-{n}.tum") for n in (1, 2, 3)]
        truths = [sessions.first.truth, sessions.later.truth, third.truth]
        assert error_m(sessions, parts, truths) < 0.03
        two.close()
        three.close()


def test_localising_adds_the_log_only_where_it_is_asked_to(
    sessions: Sessions, map_: Path, joined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents_of(map_)
    arguments = ("localize", map_, sessions.later_log, "-o", tmp_path / "localized")
    assert outcome_of(capsys, *arguments).code == 0
    assert contents_of(map_) == before
    assert outcome_of(capsys, *arguments, "--update").code == 0
    assert (map_ / "trajectory-2.tum").read_bytes() == (joined / "trajectory-2.tum").read_bytes()


class TestRefused:
    def test_another_building(
        self, sessions: Sessions, map_: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        before = contents_of(map_)
        error = outcome_of(capsys, "map", sessions.mirrored, "--into", map_).error()
        assert "does not connect" in error and "the map was not changed" in error
        assert contents_of(map_) == before

    def test_what_is_in_the_map_already(
        self, sessions: Sessions, map_: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        before = contents_of(map_)
        assert "already" in outcome_of(capsys, "map", sessions.first.log_path, "--into", map_).error()
        error = outcome_of(capsys, "map", sessions.prefix, "--into", map_).error()
        assert "keyframes are in the map already" in error
        assert contents_of(map_) == before

    def test_a_damaged_map(self, sessions: Sessions, map_: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with sqlite3.connect(map_ / "map.db") as file:
            file.execute("UPDATE factors SET source = 0 WHERE number = 3")
        file.close()
        before = contents_of(map_)
        assert "table factors, row 3" in outcome_of(capsys, "map", sessions.later_log, "--into", map_).error()
        assert contents_of(map_) == before

    def test_no_map_and_no_log(
        self, sessions: Sessions, map_: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert "no map at" in outcome_of(capsys, "map", sessions.later_log, "--into", tmp_path / "x").error()
        assert "does not exist" in outcome_of(capsys, "map", tmp_path / "y", "--into", map_).error()
        other = map_.rename(tmp_path / "house") / "map.db"
        named = other.rename(other.with_name("house.db"))
        assert "--out" in outcome_of(capsys, "map", sessions.later_log, "--into", named).error()

    def test_a_log_that_breaks_off(
        self, sessions: Sessions, map_: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        empty = tmp_path / "empty.log"
        empty.write_text("# nothing\nPARAM robot_frontlaser_offset 0.1 1000.0 synthetic 0.0\n")
        before = contents_of(map_)
        outcome_of(capsys, "map", empty, "--into", map_, "--out", tmp_path / "out").error()
        assert contents_of(map_) == before and not (tmp_path / "out").exists()

    def test_two_at_once(self, sessions: Sessions, map_: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with only_one_in(map_):
            error = outcome_of(capsys, "map", sessions.later_log, "--into", map_).error()
        assert "another run" in error

    def test_wrong_usage(self, sessions: Sessions) -> None:
        assert run("map", sessions.later_log) == 2


@pytest.mark.parametrize(("why", "code"), [(KeyboardInterrupt(), 130), (OSError(28, "disk full"), 1)])
def test_an_interrupted_session_goes_on_to_the_same_map(
    why: BaseException,
    code: int,
    sessions: Sessions,
    map_: Path,
    joined: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(checkpoint: Checkpoint, content: bytes) -> None:
        if checkpoint._count > 30:
            raise why
        keep(checkpoint, content)

    keep = Checkpoint.keep
    before = contents_of(map_)
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoint, "keep", interrupted)
        outcome = outcome_of(capsys, "map", sessions.later_log, "--into", map_)
    assert outcome.code == code and "--resume continues it" in outcome.err
    assert {name: whole for name, whole in contents_of(map_).items() if "joining" not in name} == before

    outcome = outcome_of(capsys, "map", sessions.later_log, "--into", map_, "--resume")
    assert outcome.code == 0 and "going on with" in outcome.err
    assert (map_ / "map.db").read_bytes() == (joined / "map.db").read_bytes()


def test_a_session_without_its_page_is_joined(
    sessions: Sessions, map_: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a full disk leaves it: finished, but for the page; and the disk is full once more after that."""
    for function in ("slam.app.joining.write_joined", "slam.app.joining.write_saved_page"):
        with monkeypatch.context() as patch:
            patch.setattr(function, fails)
            outcome = outcome_of(capsys, "map", sessions.later_log, "--into", map_, "--resume")
        assert outcome.code == 1 and "--resume continues it" in outcome.err
        (map_ / "joining" / "session" / "report.html").unlink(missing_ok=True)
    assert outcome_of(capsys, "map", sessions.later_log, "--into", map_, "--resume").code == 0
    assert (map_ / "report-2.html").is_file()
    assert not (map_ / "joining").exists()


def fails(*_: object) -> None:
    raise OSError(28, "disk full")


def test_a_move_that_was_killed_is_done_again(
    sessions: Sessions,
    map_: Path,
    joined: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = (map_ / "map.db").read_bytes()
    rename = Path.replace

    def stopped(self: Path, target: Path) -> Path:
        if self.name == "map.db" and self.parent.name == "map" and "joining" in self.parts:
            raise KeyboardInterrupt
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stopped)
        assert outcome_of(capsys, "map", sessions.later_log, "--into", map_).code == 130
    assert (map_ / "map.db").read_bytes() == before
    assert outcome_of(capsys, "map", sessions.later_log, "--into", map_, "--resume").code == 0
    for name, whole in contents_of(joined).items():
        if not name.startswith("report"):
            assert (map_ / name).read_bytes() == whole, name


def test_maps_merge_in_whatever_order_they_connect(
    sessions: Sessions, mapped: Path, joined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = {"later": sessions.later_log, "mirrored": sessions.mirrored}
    for name, log in logs.items():
        assert run("map", log, "-o", tmp_path / name) == 0
    maps, out = [mapped, tmp_path / "mirrored", tmp_path / "later"], tmp_path / "out"
    outcome = outcome_of(capsys, "merge", *maps, "-o", out)
    assert outcome.code == 0 and "2 of 3 maps in one, 2 sessions" in outcome.out
    assert f"warning: {maps[1] / 'map.db'} does not connect" in outcome.err
    with load_map(out) as found, load_map(joined) as other:
        assert [one.log_name for one in found.sessions] == ["scans.log", "later.log"]
        assert found.digest == other.digest
    assert "is a map; --force" in outcome_of(capsys, "merge", *maps, "-o", out).error()
    error = outcome_of(capsys, "merge", mapped, joined, "-o", tmp_path / "none").error()
    assert "its log scans.log is already in the others" in error and not (tmp_path / "none").exists()


def test_the_page_of_a_joined_map_is_of_both_and_each_session_keeps_its_own(
    joined: Path, mapped: Path
) -> None:
    assert (joined / "report-1.html").read_bytes() == (mapped / "report.html").read_bytes()
    assert (joined / "report-2.html").is_file()
    found = load_map(joined)
    assert found.digest[:12] in (joined / "report.html").read_text()
    travel_m = sum(
        float(np.linalg.norm(np.diff(part, axis=0), axis=1).sum())
        for part in np.split(found.trajectory.positions_m, [found.sessions[0].poses])
    )
    assert f"{travel_m:,.1f} m" in (joined / "report.html").read_text()  # not the jump between the two
    found.close()


def test_a_calibration_alone_leaves_the_settings_of_the_map(sessions: Sessions, tmp_path: Path) -> None:
    folder, file = tmp_path / "map", tmp_path / "calibration.yaml"
    file.write_text("wheels: {odometry: {scale: 1.001}}\n")
    assert run("map", sessions.first.log_path, "-o", folder, *COARSE) == 0
    assert run("map", sessions.later_log, "--into", folder, "--calibration", file) == 0
    found = load_map(folder)
    first, later = (session.keyframes for session in found.sessions)
    found.close()
    assert later < 1.5 * first
