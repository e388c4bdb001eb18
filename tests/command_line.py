"""The command in this process, and a log that it has mapped: fixtures of the tests of the commands."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from slam.cli import main
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log

RESULTS = {
    "trajectory.tum",
    "trajectory_covariance.csv",
    "graph.g2o",
    "map.yaml",
    "map.pgm",
    "map.db",
    "report.html",
}


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str

    def error(self) -> str:
        """Its one-line error."""
        assert_one_line_error(self)
        return self.err


Scanweave = Callable[..., Outcome]


@pytest.fixture
def scanweave(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Scanweave:
    """The command, in this process."""
    monkeypatch.setenv("TERMINAL_WIDTH", "200")

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["scanweave", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            code: object = 0
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        assert isinstance(code, int)
        return Outcome(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    return write_synthetic_log(tmp_path_factory.mktemp("log"), duration_s=12.0)


@pytest.fixture(scope="module")
def mapped(log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with default settings."""
    out = tmp_path_factory.mktemp("mapped") / "made" / "where missing"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["scanweave", "map", str(log.log_path), "-o", str(out)])
        with pytest.raises(SystemExit) as stop:
            main()
    assert not stop.value.code
    return out


def assert_one_line_error(outcome: Outcome, *parts: str) -> None:
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("scanweave: ")
    assert [part for part in parts if part not in outcome.err] == []
