"""What a run tells where its output is a file: a line now and then, and nothing when it is to be quiet."""

from __future__ import annotations

import pytest

import slam.cli.progress as shown
from slam.app.progress import Progress


def test_a_file_is_told_a_line_now_and_then(
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
