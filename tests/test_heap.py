"""Memory is let go of at the end of a stage, and nothing is lost."""

from __future__ import annotations

import ctypes
import mmap
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from slam import heap
from slam.spool import ArraySpool


def _of_files_kb() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssFile:"))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere memory stays as it is")
def test_the_code_of_libraries_leaves_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before, world = _of_files_kb(), np.linalg.inv(np.diag([2.0, 4.0]))
    heap.end_stage()
    assert _of_files_kb() > before / 2  # others may run here
    monkeypatch.setattr(heap, "own_process", True)
    heap.end_stage()
    assert _of_files_kb() < before / 2
    assert (np.linalg.inv(np.diag([2.0, 4.0])) == world).all()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere memory stays as it is")
def test_what_was_changed_in_memory_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heap, "own_process", True)
    path = tmp_path / "file"
    path.write_bytes(bytes(4 * mmap.PAGESIZE))
    with path.open("r+b") as file:
        copied = mmap.mmap(file.fileno(), 0, flags=mmap.MAP_PRIVATE)
    copied[10:13] = b"new"
    at = ctypes.addressof(ctypes.c_char.from_buffer(copied))
    protect = ctypes.CDLL(None).mprotect
    protect(ctypes.c_void_p(at), ctypes.c_size_t(len(copied)), mmap.PROT_READ)  # as the linker does
    heap.end_stage()
    assert copied[10:13] == b"new"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere memory stays as it is")
def test_arrays_in_files_leave_memory_and_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = ArraySpool().keep(np.arange(1 << 20))
    monkeypatch.setattr(heap, "own_process", True)
    heap.end_stage()
    there = rf"^{kept.ctypes.data:x}-.*\n(?:\w+: .*\n)*?Rss: +0 kB"
    assert re.search(there, Path("/proc/self/smaps").read_text(), re.M)
    assert (kept == np.arange(1 << 20)).all()
