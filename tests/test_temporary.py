"""Temporary files: gone with their owner, and where that was killed, with the next run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam.errors import MapFileError
from slam.storage.files import replacing, write_bytes
from slam.temporary import TemporaryFolder

_LEAVES = """
import os, sys
from pathlib import Path
from slam.storage.files import replacing
from slam.temporary import TemporaryFolder
folder = TemporaryFolder(Path(sys.argv[1]))
with replacing(Path(sys.argv[1]) / "map.pgm") as temporary:
    temporary.write_bytes(b"half of it")
    print("there", flush=True)
    sys.stdin.read()
"""


def aged(folder: Path) -> list[Path]:
    """What is in a folder, an hour old."""
    found = sorted(folder.iterdir())
    for path in found:
        os.utime(path, (1e9, 1e9))
    return found


def test_what_a_killed_run_left_goes_with_the_next_and_not_before(tmp_path: Path) -> None:
    run = subprocess.Popen(
        [sys.executable, "-c", _LEAVES, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert run.stdout is not None and run.stdin is not None
    assert run.stdout.readline() == b"there\n"
    assert len(aged(tmp_path)) == 2
    write_bytes(tmp_path / "map.pgm", b"whole")  # while it lives, nothing of it is touched
    assert len(aged(tmp_path)) == 3
    TemporaryFolder(tmp_path).remove()
    assert len(aged(tmp_path)) == 3
    run.kill()
    run.wait()
    run.stdin.close()
    run.stdout.close()
    write_bytes(tmp_path / "other.pgm", b"whole")  # another file's remains are not its business
    assert len(aged(tmp_path)) == 4
    write_bytes(tmp_path / "map.pgm", b"whole again")
    mine = TemporaryFolder(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "map.pgm", tmp_path / "other.pgm", mine.path])
    mine.remove()


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(MapFileError), replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise OSError("full")
    assert not list(tmp_path.iterdir())


def test_strange_files_of_such_names_are_left_alone(tmp_path: Path) -> None:
    for number, make in enumerate((os.mkfifo, Path.mkdir)):
        make(tmp_path / f".a.{number:016x}.tmp.txt")
    (tmp_path / ".a.00000000000000ff.tmp.txt").symlink_to(tmp_path)
    (tmp_path / f"scanweave-held-{'x' * 8}").symlink_to(tmp_path)
    aged_names = {path.name for path in tmp_path.iterdir()}
    write_bytes(tmp_path / "a.txt", b"whole")
    TemporaryFolder(tmp_path).remove()
    assert {path.name for path in tmp_path.iterdir()} == {*aged_names, "a.txt"}
