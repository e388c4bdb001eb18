"""What is asked for seldom waits on disk, as it was."""

from __future__ import annotations

import os

import pytest

from slam.errors import ScanweaveError
from slam.spool import Spool


def test_pieces_come_back_as_they_were() -> None:
    spool, pieces = Spool(), [b"one", b"", bytes(range(256)) * 1000]
    for number, piece in enumerate(pieces):
        spool.append(piece)
        assert len(spool) == number + 1 and spool[0] == b"one"
    assert [spool[number] for number in (2, 1, 0)] == pieces[::-1]
    with pytest.raises(IndexError):
        _ = spool[3]


def test_a_piece_that_is_written_in_parts_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, content, at: write(file, content[:7], at))
    spool = Spool()
    spool.append(bytes(range(100)))
    assert spool[0] == bytes(range(100))


def test_a_full_disk_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    spool = Spool()

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(ScanweaveError, match="No space left on device; set TMPDIR"):
        spool.append(b"one")
    assert len(spool) == 0
