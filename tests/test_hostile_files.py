"""A part of the bank of hostile files: each ends with one line, within its time and memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

REPO = Path(__file__).parents[1]


def test_hostile_files_end_soon_and_small_with_a_plain_line(tmp_path: Path) -> None:
    # Not the black image a thousand times: it is a log like others, and takes half as long as all of these.
    images = ["image is", "image of", "image links", "image names", "images is"]
    parts = ["idl,", "msg, a", "db3, m", "records of no bytes", *images]
    ran = subprocess.run(
        [sys.executable, "-m", "tools.hostile_files", str(tmp_path / "bank"), "--run", "--only", *parts],
        cwd=REPO,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout[-2000:] + ran.stderr[-2000:]
    assert " 0 wrong" in ran.stdout
