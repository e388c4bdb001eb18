"""Scans matched ahead in another process: the same map, whatever becomes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import slam
from slam import forked
from slam.app.mapping import run_log
from slam.mapper import lidar2d, lookahead, map_result, pipeline
from slam.mapper.lookahead import Ahead
from slam.simulation.synthetic_log import write_synthetic_log

SCANS = 126  # of the drive


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of 25 s."""
    return write_synthetic_log(tmp_path_factory.mktemp("log"), duration_s=25.0).log_path


class Counted:
    """How many scans the run found tracked, and how often another process was made."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, free: bool) -> None:
        self.found = self.made = 0
        observe, start = Ahead.observe, forked.Forked.__init__
        for module in (lookahead, forked):
            monkeypatch.setattr(module, "is_core_free", lambda: free)

        def count(ahead: Ahead, measurement: Any) -> Any:
            moment = observe(ahead, measurement)
            self.found += moment is not None
            return moment

        def make(copy: forked.Forked, work: Any) -> None:
            self.made += work.__qualname__.startswith("Lookahead")
            start(copy, work)

        monkeypatch.setattr(Ahead, "observe", count)
        monkeypatch.setattr(forked.Forked, "__init__", make)


@pytest.fixture(scope="module")
def alone(log: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What a run with one core writes."""
    with pytest.MonkeyPatch.context() as patch:
        Counted(patch, free=False)
        return mapped(log, tmp_path_factory.mktemp("alone"))


def mapped(log: Path, out: Path) -> bytes:
    """The way and the whole contents of a map, as bytes."""
    run = run_log(log, out=out)
    run.map.close()
    return (out / "trajectory.tum").read_bytes() + run.map.digest.encode() + (out / "map.pgm").read_bytes()


def test_the_same_map_with_a_second_core(
    log: Path, alone: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch, free=True)
    assert mapped(log, tmp_path / "two") == alone
    assert counted.made == 1
    assert counted.found == SCANS


@pytest.mark.parametrize("after", [0, 30, SCANS])
def test_the_same_map_where_the_other_process_dies(
    after: int, log: Path, alone: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch, free=True)
    receive = forked.Forked.receive
    left = iter(range(after))
    monkeypatch.setattr(
        forked.Forked, "receive", lambda copy: None if next(left, None) is None else receive(copy)
    )
    assert mapped(log, tmp_path / "died") == alone
    assert counted.found == after


def test_answers_to_something_else_are_not_taken(
    log: Path, alone: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch, free=True)
    receive, skip = forked.Forked.receive, iter([*[False] * 20, True])

    def out_of_step(copy: forked.Forked) -> bytes | None:
        if next(skip, False):
            receive(copy)
        return receive(copy)

    monkeypatch.setattr(forked.Forked, "receive", out_of_step)
    assert mapped(log, tmp_path / "out of step") == alone
    assert counted.found == 20


def test_where_the_doctor_mends_a_sensor_it_begins_again(
    log: Path, alone: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nearer(config: slam.Config, findings: Any) -> slam.Config:
        scan = config.scan.model_copy(update={"range_max_m": 4.0})
        return config.model_copy(update={"scan": scan})

    monkeypatch.setattr(pipeline, "settled", nearer)
    with monkeypatch.context() as patch:
        Counted(patch, free=False)
        as_alone = mapped(log, tmp_path / "one")
    assert as_alone != alone
    counted = Counted(monkeypatch, free=True)
    assert mapped(log, tmp_path / "two") == as_alone
    assert counted.made == 2
    assert counted.found == SCANS


def test_the_grids_are_drawn_by_another_core_while_places_are_searched(
    log: Path, alone: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Counted(monkeypatch, free=True)
    here, lidar_grids = list[int](), lidar2d.lidar_grids
    # What a copy of the process appends stays there.
    for module in (lidar2d, map_result):
        monkeypatch.setattr(module, "lidar_grids", lambda *given: here.append(1) or lidar_grids(*given))
    assert mapped(log, tmp_path / "two") == alone
    assert not here


@pytest.mark.parametrize("free", [False, True])
def test_grids_by_other_poses_than_the_last_are_not_taken(
    free: bool, log: Path, alone: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Counted(monkeypatch, free=free)
    monkeypatch.setattr(lidar2d, "row_of", lambda pose: [pose.x() + 1.0, pose.y(), 0.5])
    assert mapped(log, tmp_path / "moved") == alone
