"""Robot@Home2: the same recordings as an SQLite database with separate image files.

Ambrosio-Cestero et al. 2023, "Robot@Home2, a robotic dataset of home environments"; tables and columns after
its toolbox.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.datasets.account import Account
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import FramePair
from slam.datasets.log_file import read_head
from slam.datasets.recording import Contents, Numbered, Recording
from slam.datasets.robot_at_home_rig import LASER, camera, laser_scan, unix_stamp_s
from slam.datasets.sqlite_reading import SQLITE_MAGIC, foreign_database
from slam.datasets.stamped_files import StampedFile
from slam.errors import DatasetError
from slam.foreign import plain

NO_FILES = "observation without image files in the database"

_IMAGES = Path("files") / "rgbd"
# The view omits duplicates in the tables; a database without the view has only the raw tables.
_OBSERVATIONS = ("rh2_sensor_observations", "rh_raw")
_SCANS = ("rh_lsrscan_scans", "rh_raw_scans")


@dataclass(frozen=True, slots=True)
class _Selection:
    """The part of a database that is one recording; empty names select everything."""

    database: Path
    session: str = ""
    room: str = ""


def looks_like_robot_at_home2(path: Path, head: bytes) -> bool:
    """Whether a path is such a database, or a folder with one."""
    return _selection(path) is not None


def open_robot_at_home2(path: Path, strict: bool) -> Recording:
    """One session of a database, or one room of it: ``DATABASE/SESSION/ROOM``, as if these were folders.

    Raises
    ------
    DatasetError
        The database contains several sessions, and the path names none of them.
    """
    chosen = _selection(path)
    if chosen is None:
        raise DatasetError(f"{path} is no Robot@Home2 database; give rh.db or its folder")
    with _connected(chosen.database) as database:
        sessions = [
            str(name) for (name,) in database.execute("select name from rh_home_sessions order by name")
        ]
        if chosen.session not in sessions and (chosen.session or len(sessions) > 1):
            wrong = f"has no session '{chosen.session}'" if chosen.session else "holds several sessions"
            example = chosen.database.parent / (sessions[0] if sessions else "SESSION")
            raise DatasetError(
                f"{chosen.database} {wrong}; there are {', '.join(sessions) or 'none'}: give {example}"
            )
    return Recording(path, lambda account: _load(chosen, account), lambda _: None, strict=strict)


def _selection(path: Path) -> _Selection | None:
    """The database that a path leads to or into, with the names after it; None if there is none."""
    names: list[str] = []
    while not path.exists() and len(names) < 2 and path.name:
        names.insert(0, path.name)
        path = path.parent
    for database in [path] if path.is_file() else sorted(path.glob("*.db")):
        try:
            if not database.is_file() or read_head(database, len(SQLITE_MAGIC)) != SQLITE_MAGIC:
                continue
            with _connected(database) as opened:
                if {"rh_raw", "rh_home_sessions"} <= _tables(opened):
                    return _Selection(database, *names)
        except DatasetError:
            if database == path and not names:
                raise  # otherwise the user did not name it
    return None


@contextmanager
def _connected(path: Path) -> Iterator[sqlite3.Connection]:
    """A database opened for reading."""
    try:
        with closing(foreign_database(path)) as database:
            yield database
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise DatasetError(f"{path} cannot be read: {error}; download the database again") from error


def _tables(database: sqlite3.Connection) -> set[str]:
    """Names of tables and views."""
    return {str(name) for (name,) in database.execute("select name from sqlite_master")}


def _load(chosen: _Selection, account: Account) -> Contents:
    """Lists of images by camera; scans are read one at a time later."""
    pairs: dict[str, list[FramePair]] = defaultdict(list)
    with _connected(chosen.database) as database:
        for row in _observations(database, chosen):
            if row["sensor"] != LASER:
                with account.refusing(str(row["sensor"]), int(row["id"])):
                    pairs[plain(row["sensor"])].append(_pair(chosen.database.parent, row))
    return Contents([camera(name, pairs[name]) for name in sorted(pairs)], _scans(chosen, account))


def _observations(database: sqlite3.Connection, chosen: _Selection) -> Iterator[dict[str, Any]]:
    """Observations of the selection in time order, with their file names."""
    tables = _tables(database)
    source = next(name for name in _OBSERVATIONS if name in tables)
    renamed = "rh2_old2new_rgbd_files" in tables
    files = (
        "f.new_path, f.new_file_1, f.new_file_2, f.new_file_3"
        if renamed
        else "o.files_path, o.sensor_file_1, o.sensor_file_2, o.sensor_file_3"
    )
    query = (
        f"select o.id, coalesce(s.name, o.name), o.time_stamp, o.laser_aperture, o.laser_max_range, {files} "
        f"from {source} o left join rh_sensors s on s.id = o.sensor_id "
        f"{'left join rh2_old2new_rgbd_files f on f.id = o.id ' if renamed else ''}"
        "left join rh_home_sessions h on h.id = o.home_session_id left join rh_rooms r on r.id = o.room_id "
        "where (:session = '' or h.name = :session) "
        "and (:room = '' or r.name = :room or r.name like '%\\_' || :room escape '\\') "
        "order by o.time_stamp, o.id"
    )
    names = ("id", "sensor", "ticks", "aperture_rad", "max_m", "folder", "file_1", "file_2", "file_3")
    for row in database.execute(query, {"session": chosen.session, "room": chosen.room}):
        yield dict(zip(names, row, strict=True))


def _pair(folder: Path, row: dict[str, Any]) -> FramePair:
    """The two images of an observation."""
    images = folder / _IMAGES if (folder / _IMAGES).is_dir() else folder
    names = [str(row[key]) for key in ("file_1", "file_2", "file_3") if row[key]]
    by_kind = {kind: [name for name in names if kind in name] for kind in ("intensity", "depth")}
    if not all(by_kind.values()):
        raise RecordFault(NO_FILES, f"files {names}")
    stamp_s = unix_stamp_s(row["ticks"])
    color, depth = (
        StampedFile(stamp_s, images / str(row["folder"] or ".") / by_kind[kind][0], int(row["id"]))
        for kind in ("intensity", "depth")
    )
    return FramePair(stamp_s, color, depth)


def _scans(chosen: _Selection, account: Account) -> Iterator[Numbered]:
    """Scans of the selection in time order."""
    with _connected(chosen.database) as database:
        tables = [name for name in _SCANS if name in _tables(database)]
        for row in _observations(database, chosen):
            if row["sensor"] != LASER:
                continue
            number = int(row["id"])
            account.report.line_count += 1
            with account.refusing(LASER, number):
                shots = _shots(database, tables, number)
                maxima = (_number(row["aperture_rad"]), _number(row["max_m"]))
                scan = laser_scan(unix_stamp_s(row["ticks"]), shots[:, 0], shots[:, 1], *maxima, account)
                account.report.accept(LASER)
                yield number, scan


def _shots(
    database: sqlite3.Connection, tables: list[str], number: int
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(N, 2) range and validity of the beams of an observation, from the table that contains it."""
    for table in tables:
        query = f"select scan, valid_scan from {table} where sensor_observation_id = ? order by shot_id"
        if rows := database.execute(query, (number,)).fetchall():
            return np.array([[_number(value) for value in row] for row in rows])
    return np.empty((0, 2))


def _number(value: Any) -> float:
    """A number of a column with any contents, NaN if it is no number."""
    return float(value) if isinstance(value, int | float) else float("nan")
