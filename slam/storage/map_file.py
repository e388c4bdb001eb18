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
from slam.errors import MapFileError, UnfinishedMapError
from slam.foreign import from_json, plain
from slam.storage.map_connection import begin, beside, check_kind, reader, refuse_in_use, reported, writer
from slam.storage.map_tables import CHECKPOINT, META, TABLES, Table, Value
from slam.temporary import TemporaryFolder

T = TypeVar("T")

MAP_NAME = "map.db"
# A crash loses at most this and what one scan takes.
COMMIT_EVERY_S = 1.5
SEAL = "seal"
# Where SQLite's header counts commits, changes of the tables, and commits again.
_COUNTS = (24, 40, 92)
_SETTLED = b"\0\0\0\1"
# And where it says whether the file is being written.
_WRITE_VERSION, _NO_WAL = 18, b"\1"


def map_path(path: Path) -> Path:
    """The map's file where a folder or the file itself is named."""
    return path / MAP_NAME if path.is_dir() else path


def settle_counts(path: Path) -> None:
    """Set what the header of a closed map counts: the clock has decided it, and where a run was killed."""
    with path.open("r+b") as stream:
        for place in _COUNTS:
            stream.seek(place)
            if stream.read(4) != _SETTLED:
                stream.seek(place)
                stream.write(_SETTLED)


def is_tidy(path: Path) -> bool:
    """Whether a finished map was tidied up to the end, but for its counts."""
    with path.open("rb") as stream:
        stream.seek(_WRITE_VERSION)
        return stream.read(1) == _NO_WAL


def _forget(connection: sqlite3.Connection, folder: TemporaryFolder) -> None:
    """Leave nothing of a temporary map."""
    connection.close()
    folder.remove()


class MapFile:
    """An open map; every fault of the file is a `MapFileError` of one line that names table and row.

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
        """A new, empty map in the place of whatever is there, unless another process writes that."""
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
        """An empty map in a temporary folder that goes with it: for what nobody saves."""
        folder = TemporaryFolder()
        file = cls.create(folder.path / MAP_NAME)
        weakref.finalize(file, _forget, file.connection, folder)
        return file

    @classmethod
    def resume(cls, path: Path) -> MapFile | None:
        """A map that was begun, to go on with it; None if nothing is there yet.

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
        """A finished map, to read it; nothing is written, not even beside it.

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
        """Whether the map was sealed."""
        return SEAL in self.meta()

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self.path.stat().st_size

    def meta(self) -> dict[str, str]:
        """What was mapped, and with what."""
        return {str(key): str(value) for key, value in self.rows(META)}

    def add_meta(self, key: str, value: str) -> None:
        """Take down one fact of the map."""
        self.append(META, key, value)

    def count(self, table: Table) -> int:
        """Rows of a table; none where the map is older than the table."""
        return self._counts.get(table.name, 0)

    def append(self, table: Table, *values: Value) -> int:
        """Write the next row; its number."""
        number = self._counts[table.name]
        self.replace(table, number, *values)
        self._counts[table.name] = number + 1
        return number

    def replace(self, table: Table, number: int, *values: Value) -> None:
        """Write a row anew."""
        with reported(self.path, "written"):
            self.connection.execute(table.replace_sql, (number, table.checksum(number, values), *values))

    def row(self, table: Table, number: int, *, again: bool = False) -> tuple[Value, ...]:
        """The values of a row; of one that is read again the checksum was found right.

        Raises
        ------
        MapFileError
            If it is missing or damaged.
        """
        with self.blaming(table, number):
            found = self.connection.execute(f"SELECT * FROM {table.name} WHERE number = ?", (number,))
            return self._checked(table, number, found.fetchone(), again=again)

    def rows(self, table: Table) -> Iterator[tuple[Value, ...]]:
        """The values of all rows in their order, one in memory at a time; `MapFileError` as in `row`."""
        if table.name not in self._counts:
            return  # the map is older than the table
        number = -1
        with self.blaming(table, 0):
            found = iter(self.connection.execute(f"SELECT * FROM {table.name} ORDER BY number"))
        for number in range(self._counts[table.name]):
            with self.blaming(table, number):
                values = self._checked(table, number, next(found, None))
            yield values
        with self.blaming(table, number + 1):
            if next(found, None) is not None:
                raise MapFileError(f"row {number + 1} should not be there")

    def parsed(self, table: Table, parse: Callable[[tuple[Any, ...]], T]) -> Iterator[T]:
        """Every row of a table, understood; a row that does not fit is blamed by its number."""
        for number, row in enumerate(self.rows(table)):
            with self.blaming(table, number):
                found = parse(row)
            yield found

    def tally(self, table: Table, *columns: str) -> Counter[tuple[Value, ...]]:
        """How many rows have the same values in some columns; what else is in them is not looked at."""
        if table.name not in self._counts:
            return Counter()
        names = ", ".join(columns)
        with self.blaming(table, 0):
            found = self.connection.execute(
                f"SELECT {names}, count(*) FROM {table.name} GROUP BY {names} ORDER BY {names}"
            )
            return Counter({values: count for *values, count in found for values in [tuple(values)]})

    def clear(self, table: Table) -> None:
        """Remove all rows of a table."""
        with reported(self.path, "written"):
            self.connection.execute(f"DELETE FROM {table.name}")
        self._counts[table.name] = 0

    def before_commit(self, flush: Callable[[], None]) -> None:
        """Have something called before each commit, to write what it has gathered."""
        self._before_commit.append(flush)

    def commit_if_due(self) -> None:
        """Make everything so far safe from a crash of the process, if that was a while ago."""
        if time.monotonic() - self._committed_at > COMMIT_EVERY_S:
            self.commit()

    def commit(self) -> None:
        """Make everything so far safe from a crash of the process."""
        for flush in self._before_commit:
            flush()
        with reported(self.path, "written"):
            self.connection.execute("COMMIT")
            self.connection.execute("BEGIN")
        self._committed_at = time.monotonic()

    def seal(self) -> str:
        """Say that the map is finished, with count and digest of every table, and leave one closed file.

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
        """Give back the room of what was removed, and leave nothing beside the file; it is closed then."""
        with reported(self.path, "finished"):
            run = self.connection.execute
            run("COMMIT")
            run("VACUUM")
            run("PRAGMA journal_mode = DELETE")  # last: by it `is_tidy` knows that all is done
            self.close()
            settle_counts(self.path)

    def close(self) -> None:
        """Close the file; what is not committed is lost."""
        self.connection.close()

    def discard(self) -> None:
        """Close the file and remove it."""
        self.close()
        for left in (self.path, *beside(self.path)):
            left.unlink(missing_ok=True)

    def content_digest(self) -> str:
        """One digest of everything in a finished map, by the seal that was checked when it was opened."""
        return _digest(json.dumps(from_json(self.meta()[SEAL])))

    def check_pages(self) -> None:
        """Have SQLite check its own structure.

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
        """Rows of every table as they are found."""
        for table in self.tables:
            with self.blaming(table, 0):
                found = self.connection.execute(f"SELECT count(*), max(number) FROM {table.name}").fetchone()
                if found[0] != (-1 if found[1] is None else found[1]) + 1:
                    raise MapFileError(f"its {found[0]} rows are not numbered without a gap")
            self._counts[table.name] = found[0]

    def _check_seal(self) -> None:
        """Refuse a map that is not finished, or has lost rows since."""
        self._count_rows()
        seal = self.meta().get(SEAL)
        if seal is None:
            raise UnfinishedMapError(_unfinished(self.path))
        with self.blaming(META, self.count(META) - 1):
            known = list(zip(self.tables, self._digests(), from_json(seal), strict=True))
        for table, found, sealed in known:
            if found != sealed:
                raise MapFileError(
                    f"{self.path} is damaged: table {table.name} has {found[0]} rows of digest {found[1]}, "
                    f"sealed were {sealed[0]} of {sealed[1]}; make the map anew"
                )

    def _digests(self) -> list[list[int | str]]:
        """Count and digest of every table, the seal itself left out."""
        digests: list[list[int | str]] = []
        for table in self.tables:
            digest, count = hashlib.blake2b(digest_size=16), 0
            seal = " WHERE key != 'seal'" if table is META else ""
            with self.blaming(table, 0):
                for number, checksum in self.connection.execute(
                    f"SELECT number, checksum FROM {table.name}{seal} ORDER BY number"
                ):
                    digest.update(f"{number}:{checksum!r};".encode())
                    count += 1
            digests.append([count, digest.hexdigest()])
        return digests

    def _checked(
        self, table: Table, number: int, found: tuple[Value, ...] | None, *, again: bool = False
    ) -> tuple[Value, ...]:
        """The values of a row as it was read, if they are those that were written."""
        if found is None or found[0] != number:
            raise MapFileError("it is missing")
        if not again and found[1] != table.checksum(number, found[2:]):
            raise MapFileError("its checksum is wrong")
        if misfit := table.misfit(found[2:]):
            raise MapFileError(misfit)
        return found[2:]

    @contextmanager
    def blaming(self, table: Table, number: int) -> Iterator[None]:
        """Blame a row for what fails in the block, with a `MapFileError`."""
        try:
            yield
        except (sqlite3.Error, ValueError, OverflowError, TypeError, MapFileError) as error:
            raise MapFileError(
                f"{self.path} is damaged: table {table.name}, row {number}: {plain(error)}; make the map anew"
            ) from error


def _digest(seal: str) -> str:
    """One digest of everything in a map with this seal."""
    return hashlib.blake2b(seal.encode(), digest_size=16).hexdigest()


def _unfinished(path: Path) -> str:
    """What to tell of a map that is not finished."""
    return (
        f"{path} is not finished: its run was interrupted or still goes on; "
        f"'scanweave map LOG -o {path.parent} --resume' goes on with it"
    )
