"""The SQLite container of rosbag2 (``.db3``), read in the order of writing, also if truncated."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.bags.records import CUT, DAMAGED, Channel, ros2_name
from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import OnShare
from slam.datasets.sqlite_reading import foreign_database, tables_of
from slam.errors import DatasetError
from slam.foreign import plain

# Messages larger than this are skipped without being loaded, because such a size is damaged.
_MESSAGES = f"""
SELECT topic_id, timestamp, CASE WHEN length(data) <= {LARGEST_BYTES} THEN data END FROM messages ORDER BY id
"""
_LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl"}


class SqliteContainer:
    """A ``.db3`` file of any schema version; it contains definitions from version 4 on."""

    def announced(self, path: Path) -> list[Channel] | None:
        """The table of topics; None if it cannot be read."""
        try:
            with closing(_opened(path)) as database:
                return list(_channels(database).values()) or None
        except sqlite3.Error:
            return None

    def records(
        self, path: Path, account: Account, budget: Budget, on_share: OnShare
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """All messages in the order of their numbers, up to a damaged page."""
        with closing(_opened(path)) as database:
            try:
                channels = _channels(database)
            except sqlite3.Error as error:
                raise DatasetError(f"{path} is no rosbag2 database: {error}; copy it again") from error
            with account.refusing(path.name, None, CUT, sqlite3.Error):
                count = max(_last_number(database), 1)
                for row, (number, stamp_ns, content) in enumerate(database.execute(_MESSAGES)):
                    on_share(min(row / count, 1.0))
                    budget.take(len(content) if isinstance(content, bytes) else 0)
                    if number in channels and isinstance(stamp_ns, int) and isinstance(content, bytes):
                        yield channels[number], stamp_ns, content
                    else:
                        fault = RecordFault(DAMAGED, f"row of topic {number}")
                        account.refuse(fault, path.name, account.report.line_count)


def _last_number(database: sqlite3.Connection) -> int:
    """The number of the last message; 0 if its page is damaged."""
    try:
        (last,) = database.execute("SELECT max(id) FROM messages").fetchone()
    except sqlite3.Error:
        return 0
    return last if isinstance(last, int) else 0


def is_rosbag2(path: Path) -> bool:
    """Whether an SQLite file has the tables of a rosbag2."""
    try:
        with closing(_opened(path)) as database:
            return {"messages", "topics"} <= tables_of(database)
    except sqlite3.Error:
        return False


def _opened(path: Path) -> sqlite3.Connection:
    """The database, opened read-only."""
    # Without the journal of a killed recorder, nothing is written, not even a lock.
    journal = path.with_name(f"{path.name}-wal").is_file()
    database = foreign_database(path, immutable=not journal, views=False)
    # Otherwise SQLite returns nothing from a file that is shorter than its header says.
    database.execute("PRAGMA writable_schema=ON")
    return database


def _channels(database: sqlite3.Connection) -> dict[int, Channel]:
    """Topics by their number, with their definitions if the bag has them."""
    definitions: dict[str, tuple[str, str]] = {}
    try:
        for kind, language, text in database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        ):
            definitions[str(kind)] = str(text), _LANGUAGES.get(str(language), str(language))
    except sqlite3.Error:  # older schema or truncated: use the definitions of the common releases
        pass
    channels = {}
    for number, topic, kind, wire in database.execute(
        "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
    ):
        text, language = definitions.get(str(kind), ("", "msg"))
        channels[int(number)] = Channel(plain(topic), plain(ros2_name(str(kind))), str(wire), text, language)
    return channels
