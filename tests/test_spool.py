"""What is asked for seldom waits on disk, as it was."""

from __future__ import annotations

import mmap
import os
import tempfile
from unittest.mock import Mock

import numpy as np
import pytest

from slam.errors import ScanweaveError
from slam.spool import ArraySpool, Spool


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


def test_a_full_disk_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    spool = Spool()

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(ScanweaveError, match="No space left on device; set TMPDIR"):
        spool.append(b"one")
    assert len(spool) == 0


def test_arrays_are_as_they_were_and_outlive_the_spool() -> None:
    rng, spool = np.random.default_rng(0), ArraySpool()
    shapes = (0, 2), (7,), (3, 5), (200_000, 2), (300_000,), (1, 1)
    given = [rng.integers(0, 99, shape).astype(kind) for shape in shapes for kind in ("i1", "f4", "f8")]
    kept = [spool.keep(one) for one in given]
    assert all(isinstance(_owner(one), mmap.mmap) for one in kept)
    kept[3][2] = given[3][2] = 100  # what is written is there when its page comes back
    spool.keep(np.zeros(1 << 20))
    del spool
    for one, other in zip(kept, given, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def _owner(array: np.ndarray) -> object:
    """What an array's memory is of."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    assert array.base is not None
    return memoryview(array.base).obj


def test_arrays_that_find_no_room_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(ScanweaveError, match="No space left on device; set TMPDIR"):
        ArraySpool().keep(np.zeros(3))
