"""The MCAP container (mcap.dev, version 0), read from its start, also if the file is truncated.

Existing readers cannot do this: rosbags needs the index at the end of a complete file; `mcap` decompresses a
chunk completely or not at all, so that a truncated or damaged record also loses the intact ones of its chunk,
and it takes a truncated record for a short one.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from slam.datasets.account import Account
from slam.datasets.bags.compression import unpacked_chunk
from slam.datasets.bags.foxglove import as_ros
from slam.datasets.bags.records import CUT, DAMAGED, UNKNOWN, Channel, CutError, exactly, ros2_name
from slam.datasets.budget import Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import OnShare
from slam.errors import DatasetError
from slam.foreign import plain

MAGIC = b"\x89MCAP0\r\n"

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_FOOTER_BYTES = 9 + 20 + len(MAGIC)
_LANGUAGES = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl"}


class McapContainer:
    """An ``.mcap`` file."""

    def announced(self, path: Path) -> list[Channel] | None:
        """The channels in the summary at the end; None if there is none."""
        with path.open("rb") as file:
            try:
                size = file.seek(0, io.SEEK_END)
                if size < _FOOTER_BYTES + len(MAGIC):
                    return None
                start = _summary_start(file)
                if not start:
                    return None
                file.seek(start)
                tables = _Tables()
                for kind, content, _ in _raw_records(file, Budget(size)):
                    if kind == _FOOTER:
                        return list(tables.channels.values()) or None
                    tables.learn(kind, content)
            except (CutError, RecordFault, OSError):
                return None
        return None

    def records(
        self, path: Path, account: Account, budget: Budget, on_share: OnShare
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """All messages in file order; skips damaged chunks, ends where the file is truncated."""
        tables, chunks = _Tables(), 0
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise DatasetError(f"{path} does not begin as an MCAP file; record or copy it again")
            with account.refusing(path.name, None, CUT, CutError):
                size = path.stat().st_size
                for kind, content, valid in _raw_records(file, budget):
                    on_share(file.tell() / size)
                    if kind in (_FOOTER, _DATA_END):
                        return
                    if kind == _CHUNK:
                        chunks += 1
                        where = f"{path.name}, chunk"
                        yield from _from_chunk(tables, content, account, budget, where, chunks, valid=valid)
                    elif valid:
                        if not 0 < kind <= _DATA_END:
                            account.report.note(UNKNOWN, account.report.line_count)
                        yield from _learned(tables, kind, content, account, path.name)
                # A marker follows the data; without it, the writer did not finish.
                raise CutError("no end mark")


class _Tables:
    """Schemas and channels read so far."""

    def __init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, Channel] = {}

    def learn(self, kind: int, content: bytes) -> tuple[Channel, int, bytes] | None:
        """Process a record; returns its message, if it is one."""
        try:
            if kind == _MESSAGE:
                number, _, log_ns = struct.unpack_from("<HIQ", content)
                if number not in self.channels:
                    raise RecordFault(DAMAGED, f"message on unknown channel {number}")
                return self.channels[number], log_ns, content[22:]
            if kind == _SCHEMA:
                stream = io.BytesIO(content)
                (number,) = struct.unpack("<H", exactly(stream, 2))
                name, encoding = _text(stream), _text(stream)
                text = _text(stream, "latin-1" if encoding == "protobuf" else "utf-8")
                self._schemas[number] = ros2_name(name), text, _LANGUAGES.get(encoding, encoding)
            elif kind == _CHANNEL:
                stream = io.BytesIO(content)
                number, schema = struct.unpack("<HH", exactly(stream, 4))
                topic, wire = _text(stream), _text(stream)
                name, text, language = self._schemas.get(schema, ("", "", "msg"))
                read_as = plain(as_ros(name, wire))
                self.channels[number] = Channel(plain(topic), read_as, wire, text, language, plain(name))
        except (struct.error, CutError, UnicodeDecodeError) as error:
            raise RecordFault(DAMAGED, str(error)) from error
        return None


def _summary_start(file: BinaryIO) -> int:
    """Start of the summary, 0 if the end of the file is not as it should be."""
    file.seek(-_FOOTER_BYTES, io.SEEK_END)
    tail = file.read(_FOOTER_BYTES)
    if not tail.endswith(MAGIC) or tail[0] != _FOOTER:
        return 0
    (start,) = struct.unpack_from("<Q", tail, 9)
    return int(start)


def _raw_records(stream: BinaryIO, budget: Budget) -> Iterator[tuple[int, bytes, bool]]:
    """Types and contents up to the end of the stream, and whether a record is complete (the last may not be).

    Raises
    ------
    CutError, RecordFault
        After the last record: it is incomplete, has an impossible size, or exceeds the budget.
    """
    while head := stream.read(9):
        budget.take(0)
        if len(head) < 9:
            raise CutError("within the head of a record")
        kind, size = struct.unpack("<BQ", head)
        try:
            yield kind, exactly(stream, size), True
        except CutError as cut:
            yield kind, cut.content, False
            raise


def _from_chunk(
    tables: _Tables, content: bytes, account: Account, budget: Budget, where: str, number: int, *, valid: bool
) -> Iterator[tuple[Channel, int, bytes]]:
    """The messages of a chunk, as far as it is intact."""
    # A truncated file is reported once, at its end.
    cut = suppress(RecordFault, CutError)
    with account.refusing(where, number, DAMAGED, CutError) if valid else cut:
        records = io.BytesIO(_unpacked(content, budget, valid=valid))
        for kind, inner, inner_whole in _raw_records(records, budget):
            if inner_whole:
                yield from _learned(tables, kind, inner, account, where)


def _learned(
    tables: _Tables, kind: int, content: bytes, account: Account, where: str
) -> Iterator[tuple[Channel, int, bytes]]:
    """The message of a record, if it is one; a damaged record is counted."""
    with account.refusing(where):
        message = tables.learn(kind, content)
        if message is not None:
            yield message


def _unpacked(content: bytes, budget: Budget, *, valid: bool) -> bytes:
    """The records of a chunk, verified by their checksum if there is one."""
    stream = io.BytesIO(content)
    try:
        _, _, size, checksum = struct.unpack("<QQQI", exactly(stream, 28))
        compression = _text(stream)
        (packed_size,) = struct.unpack("<Q", exactly(stream, 8))
        packed = exactly(stream, packed_size) if valid else stream.read()
    except (CutError, UnicodeDecodeError) as error:
        raise RecordFault(DAMAGED, f"head of a chunk: {error}") from error
    records = unpacked_chunk(packed, compression, size, budget, cut=not valid)
    if valid and checksum and zlib.crc32(records) != checksum:
        raise RecordFault(DAMAGED, "checksum of a chunk")
    return records


def _text(stream: BinaryIO, encoding: str = "utf-8") -> str:
    """A length-prefixed string."""
    (size,) = struct.unpack("<I", exactly(stream, 4))
    return exactly(stream, size).decode(encoding)
