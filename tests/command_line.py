"""The command in this process, and a log that it has mapped: fixtures of the tests of the commands."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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


def run(*arguments: object) -> int:
    """Exit code of the command, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TERMINAL_WIDTH", "200")
        patch.setattr(sys, "argv", ["scanweave", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
    code = stop.value.code or 0
    assert isinstance(code, int)
    return code


def outcome_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> Outcome:
    """What the command prints, and its exit code."""
    capsys.readouterr()
    code = run(*arguments)
    captured = capsys.readouterr()
    return Outcome(code, captured.out, captured.err)


@pytest.fixture
def scanweave(capsys: pytest.CaptureFixture[str]) -> Scanweave:
    """The command, in this process."""
    return partial(outcome_of, capsys)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    return write_synthetic_log(tmp_path_factory.mktemp("log"), duration_s=12.0)


@pytest.fixture(scope="module")
def mapped(log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with default settings."""
    out = tmp_path_factory.mktemp("mapped") / "made" / "where missing"
    assert run("map", log.log_path, "-o", out) == 0
    return out


def assert_one_line_error(outcome: Outcome, *parts: str) -> None:
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("scanweave: ")
    assert [part for part in parts if part not in outcome.err] == []
