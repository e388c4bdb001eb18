"""Malicious maps with valid checksums for `tools/hostile_files.py`."""

from __future__ import annotations

import json
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from slam.measurements import LaserScan
from slam.storage.map_file import MapFile
from slam.storage.map_tables import TABLES
from slam.storage.packing import pack, pack_small, unpack_small

NAN, INF = float("nan"), float("inf")
Writer = Callable[[Path], Path]


def forge(path: Path, table: str, number: int, **values: object) -> Path:
    """Change a row of a map, and correct its checksum and the seal: a forgery, not an accident."""
    spec = next(known for known in TABLES if known.name == table)
    with sqlite3.connect(path) as database:
        for name, value in values.items():
            database.execute(f"UPDATE {table} SET {name} = ? WHERE number = ?", (value, number))
        row = database.execute(f"SELECT * FROM {table} WHERE number = ?", (number,)).fetchone()
        checksum = spec.checksum(number, row[2:])
        database.execute(f"UPDATE {table} SET checksum = ? WHERE number = ?", (checksum, number))
        database.execute("DELETE FROM meta WHERE key = 'seal'")
        database.execute(
            "UPDATE meta SET number = (SELECT count(*) FROM meta AS o WHERE o.number < meta.number)"
        )
    database.close()
    file = MapFile.resume(path)
    assert file is not None
    file.seal()
    return path


@cache
def sound_map() -> bytes:
    """A small map with scans, a grid, a graph and a trajectory."""
    import slam
    from slam.simulation.synthetic_log import write_synthetic_log

    with tempfile.TemporaryDirectory() as folder:
        log = write_synthetic_log(Path(folder) / "log", duration_s=12.0).log_path
        slam.map_log(log, out=Path(folder) / "map").close()
        return (Path(folder) / "map" / "map.db").read_bytes()


def hostile_maps(steering: str) -> dict[str, Writer]:
    """The writers of all malicious maps, by name."""
    nested, square = "[" * 100_000, 11_000
    zeros = pack_small(np.zeros((square, square), np.int16))
    values: dict[str, tuple[str, int, dict[str, Any]]] = {
        "a pose that is none": ("keyframes", 1, {"pose": b"2" + struct.pack("<4d", NAN, 0.0, 1.0, 0.0)}),
        "a stamp of words": ("keyframes", 1, {"stamp_s": "noon"}),
        "a reading below none": ("keyframes", 0, {"reading": -7}),
        "no covariance": ("factors", 1, {"covariance": pack(np.zeros((3, 3)))}),
        "a covariance that is none": ("factors", 1, {"covariance": pack(np.full((3, 3), NAN))}),
        "an edge to nowhere": ("factors", 1, {"target": 2**60}),
        "a kind that steers": ("factors", 1, {"kind": "a" + steering}),
        "a corner beyond": ("grids", 0, {"corner": b"2" + struct.pack("<4d", INF, 0.0, 1.0, 0.0)}),
        "cells of nothing": ("grids", 0, {"resolution_m": 1e-300}),
        "cells without end": ("grids", 0, {"resolution_m": INF}),
        "a quarter of a gigabyte of cells": ("grids", 0, {"rows": square, "cols": square, "cells": zeros}),
        "cells that tell too little": (
            "grids",
            0,
            {"cells": struct.pack("<q", 10) + zlib.compress(bytes(10**8))},
        ),
        "a name of a grid that steers": ("grids", 0, {"name": "a" + steering}),
        "a trajectory of objects": ("trajectory", 0, {"stretch": pack_small([[]] * 1000)}),
        "settings nested deep": ("meta", 0, {"value": nested}),
        "settings of a list": ("meta", 0, {"value": "[1, 2]"}),
        "settings that are none": ("meta", 0, {"value": '{"scan": {"range_max_m": NaN}}'}),
        "a log that steers": ("meta", 2, {"value": "a" + steering}),
        "versions of a list": ("meta", 4, {"value": "[1, 2]"}),
        "versions that steer": ("meta", 4, {"value": json.dumps({"numpy" + steering: "1" + steering})}),
        "another key": ("meta", 3, {"key": "x" * 1000}),
    }
    found = {f"map, {name}": _forged(*one) for name, one in values.items()}
    for name, changes in _SCANS.items():
        found[f"map, {name}"] = _with_scan(changes)
    found["map, pages in a loop"] = _looped
    found["map, a view for a table"] = _with_script(
        "DROP TABLE journal; CREATE VIEW journal AS WITH RECURSIVE n(x) AS "
        "(SELECT 1 UNION ALL SELECT x + 1 FROM n) "
        "SELECT x AS number, x AS checksum, x AS first, x AS answers FROM n"
    )
    found["map, a trigger more"] = _with_script("CREATE TRIGGER t AFTER INSERT ON meta BEGIN SELECT 1; END")
    return found


_SCANS: dict[str, dict[str, Any]] = {
    "a scan without a mounting": {"T_base_laser": None},
    "a scan without a step": {"step_rad": NAN},
    "a scan of ten million beams": {"ranges_m": np.ones(10**7, np.float32)},
    "a scan of words": {"ranges_m": "far"},
    "a scan that steers": {"sensor": "laser\x1b[31m\u202e\n"},
}


def _written(folder: Path) -> Path:
    (folder / "map.db").write_bytes(sound_map())
    return folder / "map.db"


def _forged(table: str, number: int, values: dict[str, Any]) -> Writer:
    return lambda folder: forge(_written(folder), table, number, **values)


def _with_scan(changes: dict[str, Any]) -> Writer:
    def write(folder: Path) -> Path:
        path = _written(folder)
        with sqlite3.connect(path) as database:
            (scan,) = database.execute("SELECT scan FROM keyframes WHERE number = 1").fetchone()
        database.close()
        lie: LaserScan = replace(unpack_small(scan), **changes)
        return forge(path, "keyframes", 1, scan=pack_small(lie))

    return write


def _with_script(script: str) -> Writer:
    def write(folder: Path) -> Path:
        path = _written(folder)
        with sqlite3.connect(path) as database:
            database.executescript(script)
        database.close()
        return path

    return write


def _looped(folder: Path) -> Path:
    """Every inner page of a tree refers to its own last page, so that tables appear endless."""
    content = _written(folder).read_bytes()
    (folder / "map.db").write_bytes(looped(content))
    return folder / "map.db"


def looped(content: bytes) -> bytes:
    """A database with trees in which every path leads to the same page."""
    pages = [bytearray(content[at : at + 4096]) for at in range(0, len(content), 4096)]
    for page in pages[1:]:
        if page[0] == 5:
            (cells,) = struct.unpack_from(">H", page, 3)
            for k in range(cells):
                (at,) = struct.unpack_from(">H", page, 12 + 2 * k)
                page[at : at + 4] = page[8:12]
    return b"".join(map(bytes, pages))
