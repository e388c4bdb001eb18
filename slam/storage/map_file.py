"""``map.db``: one SQLite file of numbered rows with checksums, written during mapping, then sealed."""

from __future__ import annotations

import hashlib
import json
import sqlite3
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from slam.datasets.sqlite_reading import bound_steps, free_steps
from slam.errors import MapFileError, ScanweaveError, UnfinishedMapError
from slam.foreign import from_json, plain
from slam.storage.map_tables import (
    CHECKPOINT,
    META,
    TABLES,
    Table,
    Value,
    begin,
    beside,
    check_kind,
    reader,
    refuse_in_use,
    reported,
    writer,
)
from slam.temporary import TemporaryFolder

T = TypeVar("T")

MAP_NAME = "map.db"
# A crash loses at most this time and that of one scan.
COMMIT_EVERY_S = 1.5
SEAL = "seal"
# Offsets in SQLite's header: count of commits, of table changes, and of commits again.
_COUNTS = (24, 40, 92)
_SETTLED = b"\0\0\0\1"
# Offset of the flag that the file is being written.
_WRITE_VERSION, _NO_WAL = 18, b"\1"


def map_path(path: Path) -> Path:
    """Return the path of the map file, given a folder or the file itself."""
    return path / MAP_NAME if path.is_dir() else path


def settle_counts(path: Path) -> None:
    """Set the counts in the header of a closed map, which depend on time and interruptions."""
    with path.open("r+b") as stream:
        for place in _COUNTS:
            stream.seek(place)
            if stream.read(4) != _SETTLED:
                stream.seek(place)
                stream.write(_SETTLED)


def is_tidy(path: Path) -> bool:
    """Return whether a finished map was compacted completely, except its counts."""
    with path.open("rb") as stream:
        stream.seek(_WRITE_VERSION)
        return stream.read(1) == _NO_WAL


def _forget(connection: sqlite3.Connection, folder: TemporaryFolder) -> None:
    """Remove a temporary map."""
    connection.close()
    folder.remove()


class MapFile:
    """An open map file; every fault is a `MapFileError` of one line that names table and row.

    Made by `create`, `resume` or `read`; ``connection`` is that to the database, ``tables`` are those of its
    schema.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self.connection = connection
        self.tables: tuple[Table, ...] = TABLES
        self._counts: dict[str, int] = {}
        self._committed_at = time.monotonic()
        self._before_commit: list[Callable[[], None]] = []

    @classmethod
    def create(cls, path: Path) -> MapFile:
        """Create an empty map, replacing an existing one, unless another process writes that."""
        with reported(path, "made"):
            refuse_in_use(path)
            for stale in (path, *beside(path)):
                stale.unlink(missing_ok=True)
            file = cls(path, writer(path))
            begin(file.connection)
            file._counts = dict.fromkeys((table.name for table in TABLES), 0)
        return file

    @classmethod
    def temporary(cls) -> MapFile:
        """Create an empty map in a temporary folder that is removed with it, for unsaved results."""
        folder = TemporaryFolder()
        file = cls.create(folder.path / MAP_NAME)
        weakref.finalize(file, _forget, file.connection, folder)
        return file

    @classmethod
    def resume(cls, path: Path) -> MapFile | None:
        """Open an unfinished map to continue it; None if there is none yet.

        Raises
        ------
        MapFileError
            If it is no map, is damaged, or another process writes it.
        """
        if not path.exists() or not path.stat().st_size:
            return None
        with reported(path, "opened"):
            file = cls(path, writer(path))
            try:
                if not file.connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]:
                    file.connection.close()
                    return None  # it died before its first commit
                file.tables = check_kind(path, file.connection)
                file.connection.execute("PRAGMA journal_mode = WAL")
                file.connection.execute("BEGIN")
                bound_steps(file.connection, path)
                file._count_rows()
                free_steps(file.connection)
            except BaseException:
                file.connection.close()
                raise
        return file

    @classmethod
    def read(cls, path: Path) -> MapFile:
        """Open a finished map for reading; nothing is written, not even beside it.

        Raises
        ------
        MapFileError
            If it is no map, is not finished, or rows are missing.
        """
        path = map_path(path)
        if not path.is_file():
            raise MapFileError(
                f"no map at {path}; give a folder that 'scanweave map' has made, or its map.db"
            )
        with reported(path, "read"):
            if any(left.exists() for left in beside(path)):
                raise UnfinishedMapError(_unfinished(path))
            connection = reader(path)
            file = cls(path, connection)
            try:
                file.tables = check_kind(path, connection)
                file._check_seal()
                free_steps(connection)
            except BaseException:
                connection.close()
                raise
        return file

    @property
    def finished(self) -> bool:
        """Return whether the map was sealed."""
        return SEAL in self.meta()

    @property
    def size(self) -> int:
        """Return the bytes of the file."""
        return self.path.stat().st_size

    def meta(self) -> dict[str, str]:
        """Return the facts of the map: log, settings, versions."""
        return {str(key): str(value) for key, value in self.rows(META)}

    def add_meta(self, key: str, value: str) -> None:
        """Store one fact of the map."""
        self.append(META, key, value)

    def count(self, table: Table) -> int:
        """Return the number of rows of a table; 0 if the map is older than the table."""
        return self._counts.get(table.name, 0)

    def append(self, table: Table, *values: Value) -> int:
        """Write the next row; return its number."""
        number = self._counts[table.name]
        self.replace(table, number, *values)
        self._counts[table.name] = number + 1
        return number

    def replace(self, table: Table, number: int, *values: Value) -> None:
        """Overwrite a row."""
        with reported(self.path, "written"):
            self.connection.execute(table.replace_sql, (number, table.checksum(number, values), *values))

    def row(self, table: Table, number: int, *, again: bool = False) -> tuple[Value, ...]:
        """Return the values of a row; the checksum is verified at the first read.

        Raises
        ------
        MapFileError
            If it is missing or damaged.
        """
        with self.naming_row(table, number):
            cursor = self.connection.execute(f"SELECT * FROM {table.name} WHERE number = ?", (number,))
            return self._checked(table, number, cursor.fetchone(), again=again)

    def rows(self, table: Table) -> Iterator[tuple[Value, ...]]:
        """Yield the values of all rows in order, one in memory at a time; `MapFileError` as in `row`."""
        if table.name not in self._counts:
            return  # the map is older than the table
        number = -1
        with self.naming_row(table, 0):
            rows = iter(self.connection.execute(f"SELECT * FROM {table.name} ORDER BY number"))
        for number in range(self._counts[table.name]):
            with self.naming_row(table, number):
                values = self._checked(table, number, next(rows, None))
            yield values
        with self.naming_row(table, number + 1):
            if next(rows, None) is not None:
                raise MapFileError(f"row {number + 1} should not be there")

    def parsed(self, table: Table, parse: Callable[[tuple[Any, ...]], T]) -> Iterator[T]:
        """Yield every parsed row of a table; an invalid row is reported by its number."""
        for number, row in enumerate(self.rows(table)):
            with self.naming_row(table, number):
                value = parse(row)
            yield value

    def tally(self, table: Table, *columns: str) -> Counter[tuple[Value, ...]]:
        """Count rows by the values of some columns; other columns are not read."""
        if table.name not in self._counts:
            return Counter()
        names = ", ".join(columns)
        with self.naming_row(table, 0):
            rows = self.connection.execute(
                f"SELECT {names}, count(*) FROM {table.name} GROUP BY {names} ORDER BY {names}"
            )
            return Counter({values: count for *values, count in rows for values in [tuple(values)]})

    def clear(self, table: Table) -> None:
        """Remove all rows of a table."""
        with reported(self.path, "written"):
            self.connection.execute(f"DELETE FROM {table.name}")
        self._counts[table.name] = 0

    def before_commit(self, flush: Callable[[], None]) -> None:
        """Register a function to call before each commit, which writes its pending data."""
        self._before_commit.append(flush)

    def commit_if_due(self) -> None:
        """Commit everything so far if the last commit was some time ago."""
        if time.monotonic() - self._committed_at > COMMIT_EVERY_S:
            self.commit()

    def commit(self) -> None:
        """Commit everything so far, safe from a crash of the process."""
        for flush in self._before_commit:
            flush()
        with reported(self.path, "written"):
            self.connection.execute("COMMIT")
            self.connection.execute("BEGIN")
        self._committed_at = time.monotonic()

    def seal(self) -> str:
        """Mark the map as finished, with count and digest of every table, and close it as a single file.

        Returns
        -------
        Its `content_digest`.
        """
        self._before_commit.clear()
        self.clear(CHECKPOINT)
        text = json.dumps(self._digests())
        self.add_meta(SEAL, text)
        self.commit()
        self.compact()
        return _digest(text)

    def compact(self) -> None:
        """Free the space of removed rows, and close the file without files beside it."""
        with reported(self.path, "finished"):
            run = self.connection.execute
            run("COMMIT")
            run("VACUUM")
            run("PRAGMA journal_mode = DELETE")  # last: it shows `is_tidy` that all is done
            self.close()
            settle_counts(self.path)

    def close(self) -> None:
        """Close the file; uncommitted data are lost."""
        self.connection.close()

    def discard(self) -> None:
        """Close the file and remove it."""
        self.close()
        for left in (self.path, *beside(self.path)):
            left.unlink(missing_ok=True)

    def content_digest(self) -> str:
        """Return one digest of a finished map, from the seal that was verified at opening."""
        return _digest(json.dumps(from_json(self.meta()[SEAL])))

    def check_pages(self) -> None:
        """Check the structure of the file by SQLite.

        Raises
        ------
        MapFileError
            With the first fault.
        """
        with reported(self.path, "checked"):
            (verdict,) = self.connection.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise MapFileError(f"{self.path} is damaged: {verdict}")

    def _count_rows(self) -> None:
        """Count the rows of every table."""
        for table in self.tables:
            with self.naming_row(table, 0):
                counts = self.connection.execute(f"SELECT count(*), max(number) FROM {table.name}").fetchone()
                if counts[0] != (-1 if counts[1] is None else counts[1]) + 1:
                    raise MapFileError(f"its {counts[0]} rows are not numbered without a gap")
            self._counts[table.name] = counts[0]

    def _check_seal(self) -> None:
        """Raise an error for a map that is not finished, or has lost rows."""
        self._count_rows()
        seal = self.meta().get(SEAL)
        if seal is None:
            raise UnfinishedMapError(_unfinished(self.path))
        with self.naming_row(META, self.count(META) - 1):
            known = list(zip(self.tables, self._digests(), from_json(seal), strict=True))
        for table, actual, sealed in known:
            if actual != sealed:
                raise MapFileError(
                    f"{self.path} is damaged: table {table.name} has {actual[0]} rows of digest {actual[1]}, "
                    f"sealed were {sealed[0]} of {sealed[1]}; make the map anew"
                )

    def _digests(self) -> list[list[int | str]]:
        """Return count and digest of every table, without the seal itself."""
        digests: list[list[int | str]] = []
        for table in self.tables:
            digest, count = hashlib.blake2b(digest_size=16), 0
            seal = " WHERE key != 'seal'" if table is META else ""
            with self.naming_row(table, 0):
                for number, checksum in self.connection.execute(
                    f"SELECT number, checksum FROM {table.name}{seal} ORDER BY number"
                ):
                    digest.update(f"{number}:{checksum!r};".encode())
                    count += 1
            digests.append([count, digest.hexdigest()])
        return digests

    def _checked(
        self, table: Table, number: int, row: tuple[Value, ...] | None, *, again: bool = False
    ) -> tuple[Value, ...]:
        """Return the values of a row if its checksum is correct."""
        if row is None or row[0] != number:
            raise MapFileError("it is missing")
        if not again and row[1] != table.checksum(number, row[2:]):
            raise MapFileError("its checksum is wrong")
        if misfit := table.misfit(row[2:]):
            raise MapFileError(misfit)
        return row[2:]

    @contextmanager
    def naming_row(self, table: Table, number: int) -> Iterator[None]:
        """Raise a `MapFileError` that names a row if the block fails."""
        try:
            yield
        except (sqlite3.Error, ValueError, OverflowError, TypeError, ScanweaveError) as error:
            raise MapFileError(
                f"{self.path} is damaged: table {table.name}, row {number}: {plain(error)}; make the map anew"
            ) from error


def _digest(seal: str) -> str:
    """Return one digest of a map with this seal."""
    return hashlib.blake2b(seal.encode(), digest_size=16).hexdigest()


def _unfinished(path: Path) -> str:
    """Return the message about a map that is not finished."""
    return (
        f"{path} is not finished: its run was interrupted or still goes on; "
        f"'scanweave map LOG -o {path.parent} --resume' goes on with it"
    )
