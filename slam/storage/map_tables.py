"""List of the tables of ``map.db``, the checksum of a row, and connections to the file.

One connection is for writing, one trusts nothing; SQLite errors are reported in one line.
"""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from slam.datasets.sqlite_reading import foreign_database
from slam.errors import MapFileError

Value: TypeAlias = int | float | str | bytes | None

_TYPES: Final = {"INTEGER": int, "REAL": float, "TEXT": str, "BLOB": bytes}

# Raised when a table changes; a reader refuses what is newer than itself.
SCHEMA_VERSION: Final = 7
APPLICATION_ID: Final = 0x5CA9EA7E

_HEADER = b"SQLite format 3\0"
# Files of SQLite beside a map that is being written, or was when its process died.
_BESIDE = ("-wal", "-journal")


@dataclass(frozen=True, slots=True)
class Table:
    """A table whose rows are numbered 0, 1, 2, ... without a gap.

    Attributes
    ----------
    columns
        Name and type, after the number and the checksum.
    optional
        Names of columns that may be empty.
    """

    name: str
    columns: tuple[tuple[str, ...], ...]
    optional: frozenset[str] = frozenset()

    @classmethod
    def of(cls, name: str, columns: str, *optional: str) -> Table:
        """A table by its columns as SQL names them: ``key TEXT, value TEXT``."""
        return cls(name, tuple(tuple(column.split()) for column in columns.split(", ")), frozenset(optional))

    @property
    def sql(self) -> str:
        """The statement that makes it; SQLite keeps it as it is written here."""
        columns = "".join(f", {name} {kind}" for name, kind in self.columns)
        return f"CREATE TABLE {self.name} (number INTEGER PRIMARY KEY, checksum BLOB NOT NULL{columns})"

    @property
    def replace_sql(self) -> str:
        """The statement that writes a row."""
        return f"REPLACE INTO {self.name} VALUES (?, ?{', ?' * len(self.columns)})"

    def misfit(self, values: tuple[Value, ...]) -> str | None:
        """What is wrong with the types of a row's values; SQLite itself takes any in any column."""
        for (name, kind), value in zip(self.columns, values, strict=True):
            if type(value) is not _TYPES[kind] and not (value is None and name in self.optional):
                return f"its {name} is no {kind}"
        return None

    def checksum(self, number: int, values: tuple[Value, ...]) -> bytes:
        """Eight bytes over a row's table, number and values with their types."""
        digest = hashlib.blake2b(self.name.encode(), digest_size=8)
        for value in (number, *values):
            digest.update(_tagged(value))
        return digest.digest()


# One row a key: what was mapped, with what, and when it is finished the seal.
META: Final = Table.of("meta", "key TEXT, value TEXT")
# Keyframes are the nodes of the graph. ``reading`` is the number of their scan or frame in the log.
KEYFRAMES: Final = Table.of(
    "keyframes", "stamp_s REAL, reading INTEGER, pose BLOB, scan BLOB, repaired BLOB", "scan", "repaired"
)
# Camera keyframes, each taken at a node of the graph.
FRAMES: Final = Table.of(
    "frames", "node INTEGER, stamp_s REAL, sensor TEXT, steps_per_m REAL, camera BLOB, features BLOB"
)
# Their images are separate: the poses of the frames can be read without them.
IMAGES: Final = Table.of("images", "color BLOB, depth BLOB")
FACTORS: Final = Table.of(
    "factors",
    "kind TEXT, source INTEGER, target INTEGER, trusted INTEGER, kept INTEGER, loop INTEGER, motion BLOB, "
    "covariance BLOB",
    "loop",
)
LOOPS: Final = Table.of(
    "loops", "place INTEGER, keyframe INTEGER, accepted INTEGER, score REAL, reason TEXT, candidate BLOB"
)
# A stretch of the trajectory a row.
TRAJECTORY: Final = Table.of("trajectory", "poses INTEGER, stretch BLOB")
GRIDS: Final = Table.of(
    "grids", "name TEXT, rows INTEGER, cols INTEGER, resolution_m REAL, corner BLOB, cells BLOB"
)
# Answers of matchers and verifiers while a log is mapped; gone when the map is finished.
CHECKPOINT: Final = Table.of("journal", "first INTEGER, answers BLOB")
# The cloud of each node, where a 3D lidar made the map.
CLOUDS: Final = Table.of("clouds", "stamp_s REAL, lidar BLOB, points BLOB")
# What the run learned of each camera, by its name: where it sits, its colour camera, its clock.
CAMERAS: Final = Table.of("cameras", "sensor TEXT, learned BLOB")
# The covariances of a stretch of the trajectory a row: upper triangles.
COVARIANCES: Final = Table.of("covariances", "poses INTEGER, triangles BLOB")
# Of an edited map: the edits in the order in which they were applied, and the rows of the other tables that
# they have changed, as they were. ``source`` is the name of such a table, or of this one.
EDITS: Final = Table.of("edits", "source TEXT, row INTEGER, content BLOB")
TABLES: Final = (
    META,
    KEYFRAMES,
    FRAMES,
    IMAGES,
    FACTORS,
    LOOPS,
    TRAJECTORY,
    GRIDS,
    CHECKPOINT,
    CLOUDS,
    CAMERAS,
    COVARIANCES,
    EDITS,
)


def tables_of(version: int) -> tuple[Table, ...]:
    """Return the tables of a schema: the first had no clouds, the second no camera data, the third no
    covariances, the fourth no edits; the fifth packed clouds by zlib, the sixth without intensities.
    """
    return TABLES[: TABLES.index(CHECKPOINT) + version]


def _tagged(value: Value) -> bytes:
    """Return a value with its type and length, so that different rows have different bytes."""
    if value is None:
        return b"N"
    if isinstance(value, bytes):
        return b"b" + struct.pack("<q", len(value)) + value
    if isinstance(value, str):
        content = value.encode()
        return b"s" + struct.pack("<q", len(content)) + content
    if isinstance(value, float):
        return b"d" + struct.pack("<d", value)
    return b"i" + struct.pack("<q", value)


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
