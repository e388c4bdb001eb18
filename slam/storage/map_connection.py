"""Connections to ``map.db``: one for writing, one that trusts nothing, and SQLite errors in one line."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.datasets.sqlite_reading import foreign_database
from slam.errors import MapFileError
from slam.storage.map_tables import APPLICATION_ID, SCHEMA_VERSION, TABLES, Table, tables_of

_HEADER = b"SQLite format 3\0"
# Files of SQLite beside a map that is being written, or was when its process died.
_BESIDE = ("-wal", "-journal")


def writer(path: Path) -> sqlite3.Connection:
    """Open a connection that excludes writers of other processes."""
    # An unreferenced temporary map is closed by the thread of the garbage collector.
    connection = sqlite3.connect(path, timeout=0.0, isolation_level=None, check_same_thread=False)
    connection.execute("PRAGMA locking_mode = EXCLUSIVE")
    # In WAL mode, a crash of the process loses no committed data; one of the machine, the latest.
    connection.execute("PRAGMA synchronous = NORMAL")
    return connection


def reader(path: Path) -> sqlite3.Connection:
    """Open a connection that writes nothing, not even beside the file, and trusts nothing in it.

    Raises
    ------
    MapFileError
        If it is no SQLite file.
    """
    with path.open("rb") as stream:
        if stream.read(len(_HEADER)) != _HEADER:
            raise MapFileError(f"{path} is no map: not an SQLite file; give what 'scanweave map' has made")
    connection = foreign_database(path, immutable=True, views=False, any_thread=True)
    connection.execute("PRAGMA cell_size_check = ON")
    connection.execute("PRAGMA query_only = ON")
    # No length can exceed that of the file.
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(path.stat().st_size, 10_000))
    return connection


def begin(connection: sqlite3.Connection) -> None:
    """Create the tables of a new map; the transaction stays open."""
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("BEGIN")
    for table in TABLES:
        connection.execute(table.sql)


def check_kind(path: Path, connection: sqlite3.Connection) -> tuple[Table, ...]:
    """Return the tables of a map; no map, a newer one, or other tables are a `MapFileError`."""
    run = connection.execute
    if run("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise MapFileError(f"{path} is an SQLite file, but no map of Scanweave")
    version = run("PRAGMA user_version").fetchone()[0]
    if version > SCHEMA_VERSION:
        raise MapFileError(
            f"{path} has schema {version}, this Scanweave reads up to {SCHEMA_VERSION}; install a newer one"
        )
    tables = run("SELECT type, sql FROM sqlite_schema ORDER BY rowid").fetchall()
    known = tables_of(version)
    if version < 1 or tables != [("table", table.sql) for table in known]:
        raise MapFileError(f"{path} is damaged: its tables are not those of schema {version}")
    return known


def refuse_in_use(path: Path) -> None:
    """Raise an error if another process writes a map; anything else may be replaced."""
    if not path.is_file():
        return
    connection = sqlite3.connect(path, timeout=0.0, isolation_level=None)
    try:
        connection.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError:
        raise
    except sqlite3.DatabaseError:  # no database at all
        pass
    finally:
        connection.close()


def beside(path: Path) -> list[Path]:
    """Return the files of SQLite beside one that is being written."""
    return [path.with_name(path.name + ending) for ending in _BESIDE]


@contextmanager
def reported(path: Path, done: str) -> Iterator[None]:
    """Convert errors of SQLite and the disk to one line."""
    try:
        yield
    except (sqlite3.Error, OSError, UnicodeError) as error:
        reason = "another run is writing it" if "locked" in str(error) else getattr(error, "strerror", error)
        outside = isinstance(error, sqlite3.OperationalError | OSError)
        remedy = "check the folder and its free space" if outside else "copy it again, or map its log anew"
        raise MapFileError(f"{path} cannot be {done}: {reason}; {remedy}") from error
