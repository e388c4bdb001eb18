"""What a run shows where its output is a file: a line now and then, and nothing when it is to be quiet."""

from __future__ import annotations

import sys
import threading

import pytest

import slam.cli.progress as shown
from slam.app.progress import Progress


def test_a_file_is_reported_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock_s = iter([0.0, 10.0, 31.0, 40.0, 62.0])
    monkeypatch.setattr(shown.time, "monotonic", lambda: next(clock_s))
    with shown.progress_bar(first="begins") as show:
        for readings, share in ((100, 0.1), (1200, 0.25), (1500, 0.3), (2000, None)):
            show(Progress("mapping", readings, share))
    assert capsys.readouterr().err.splitlines() == [
        "begins",
        "mapping: 1,200 scans and frames, 25% of the log",
        "mapping: 2,000 scans and frames",
    ]


def test_a_bar_is_drawn_without_a_thread(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    before = threading.active_count()
    with shown.progress_bar() as show:
        show(Progress("mapping", 100, 0.1))
        show(Progress("optimising", 1234, None))
        assert threading.active_count() == before
    stated = capsys.readouterr().err
    assert "mapping" in stated
    assert "1,234 scans and frames" in stated
