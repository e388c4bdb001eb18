"""Edits in a `map.db` that somebody has forged: refused in one line, before anything is believed."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import gtsam
import numpy as np
import pytest

import slam
from slam.errors import MapFileError
from slam.outputs.finished_map import load_map
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_file import MapFile
from slam.storage.map_tables import EDITS
from slam.storage.packing import pack, pack_small

ENTRY = ["", [], [], [], [], [], None, []]
ONE, HERE = np.zeros(1, np.int64), np.zeros((1, 2))


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("edited")
    house = slam.map_log(write_synthetic_log(folder / "log", duration_s=10.0).log_path)
    house.edited({"turn": {"degrees": 10}}, out=folder / "map").close()
    return folder / "map" / "map.db"


def forged(edited: Path, path: Path, row: int, source: str, number: int, content: bytes) -> Path:
    """A copy with another row of edits, its checksum and its seal in order."""
    path.write_bytes(edited.read_bytes())
    values = (source, number, content)
    with sqlite3.connect(path) as connection:
        connection.execute("DELETE FROM meta WHERE key = 'seal'")
        connection.execute("DELETE FROM edits WHERE number = ?", (row,))
        connection.execute(
            "INSERT INTO edits VALUES (?, ?, ?, ?, ?)", (row, EDITS.checksum(row, values), *values)
        )
    connection.close()
    file = MapFile.resume(path)
    assert file is not None
    file.seal()
    return path


def changed(place: int, value: object) -> bytes:
    """An entry, one of its fields another."""
    return pack_small([value if number == place else one for number, one in enumerate(ENTRY)])


@pytest.mark.parametrize(
    "content",
    [
        b"",
        pack_small(7),
        pack_small([]),
        changed(0, b"bytes"),
        changed(1, [[5, 5]]),
        changed(1, [[-1, 5]]),
        changed(2, [[0, 10**9]]),
        changed(3, [1]),
        changed(4, [["scan", 0, b""]]),
        changed(4, [["frame", -1, b""]]),
        changed(5, [["erase", "", 0.0, np.array([10**6]), HERE]]),
        changed(5, [["erase", "", 0.0, ONE, np.full((1, 2), np.nan)]]),
        changed(5, [["erase", "", 0.0, ONE, np.zeros((3, 2))]]),
        changed(5, [["erase", "", float("nan"), ONE, HERE]]),
        changed(6, gtsam.Pose3()),
        changed(7, [1.5]),
    ],
)
def test_a_forged_entry_is_refused_by_its_row(edited: Path, tmp_path: Path, content: bytes) -> None:
    path = forged(edited, tmp_path / "map.db", 0, "edits", 0, content)
    with pytest.raises(MapFileError, match="table edits, row 0: ") as caught:
        load_map(path)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("source", "number", "content"),
    [
        ("keyframes", 0, b"\x00"),
        ("keyframes", 0, pack([1, 2])),
        ("keyframes", 0, pack([0.0, 0, b"", None, None])),
        ("frames", 0, pack([0])),
        ("nothing", 0, b""),
        ("keyframes", -(10**9), b""),
        ("factors", 0, pack(["lidar match", 0, 99999, 1, 1, None, b"", b""])),
    ],
)
def test_a_forged_row_of_before_is_found_by_check(
    edited: Path, tmp_path: Path, source: str, number: int, content: bytes
) -> None:
    path = forged(edited, tmp_path / "map.db", 1, source, number, content)
    saved = load_map(path)
    with pytest.raises(MapFileError) as caught:
        saved.check()
    assert len(str(caught.value).splitlines()) == 1
