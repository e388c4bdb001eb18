"""Opens untrusted SQLite databases: read-only, and with limited resources for their views."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from slam.datasets.budget import LARGEST_BYTES

SQLITE_MAGIC = b"SQLite format 3\0"
_STEPS_AT_ONCE = 1 << 12
# Steps of SQLite's virtual machine (some ten million per second). Row of a bag: 20, of a join: some 100.
_FREE_STEPS, _STEPS_A_BYTE = 1 << 24, 16
# Functions that views of a data set may use; none of them creates or decompresses large values.
_FUNCTIONS = frozenset({"coalesce", "ifnull", "nullif", "length", "substr", "like", "max", "min", "count"})


def foreign_database(
    path: Path, *, immutable: bool = False, views: bool = True, any_thread: bool = False
) -> sqlite3.Connection:
    """Open a database read-only.

    Parameters
    ----------
    immutable
        Nothing is written, not even a lock; a journal is ignored.
    views
        Whether a query may read through a view; else it is an error, like other functions than those above,
        recursion, and endless work. Errors are those of `sqlite3`.
    any_thread
        Whether other threads may use it, one at a time.
    """
    how = "mode=ro&immutable=1" if immutable else "mode=ro"
    name = f"{path.resolve().as_uri()}?{how}"
    database = sqlite3.connect(name, uri=True, isolation_level=None, check_same_thread=not any_thread)
    database.execute("PRAGMA trusted_schema = OFF")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_BYTES)
    bound_steps(database, path)

    def allowed(action: int, name: str | None, function: str | None, _: str | None, view: str | None) -> int:
        unknown = action == sqlite3.SQLITE_FUNCTION and function not in _FUNCTIONS
        if unknown or action == sqlite3.SQLITE_RECURSIVE or (view and not views):
            return sqlite3.SQLITE_DENY
        return sqlite3.SQLITE_OK

    database.set_authorizer(allowed)
    return database


def bound_steps(database: sqlite3.Connection, path: Path) -> None:
    """Let endless queries of a file end with an error."""
    steps_left = (_FREE_STEPS + _STEPS_A_BYTE * path.stat().st_size) // _STEPS_AT_ONCE

    def is_too_long() -> bool:
        nonlocal steps_left
        steps_left -= 1
        return steps_left < 0

    database.set_progress_handler(is_too_long, _STEPS_AT_ONCE)


def free_steps(database: sqlite3.Connection) -> None:
    """Remove the limit of queries, because no table of the file is endless."""
    database.set_progress_handler(None, 0)


def tables_of(database: sqlite3.Connection) -> set[str]:
    """The names of ordinary tables, without views, virtual tables, and tables with generated columns."""
    rows = database.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0").fetchall()
    return {
        name
        for (name,) in rows
        if isinstance(name, str)
        and all(row[6] < 2 for row in database.execute(f'PRAGMA table_xinfo("{name.replace(chr(34), "")}")'))
    }
