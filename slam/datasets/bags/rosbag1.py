"""The ROS 1 bag container (format 2.0), read from its start, also if the file is truncated."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from slam.datasets.account import Account
from slam.datasets.bags.compression import unpacked_chunk
from slam.datasets.bags.records import CUT, DAMAGED, UNKNOWN, Channel, CutError, exactly, ros2_name
from slam.datasets.budget import Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import OnShare
from slam.errors import DatasetError
from slam.foreign import plain

MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG_HEADER, _CHUNK, _CONNECTION = 0x02, 0x03, 0x05, 0x07
_HEADER_BYTES = 1 << 16

_Fields = dict[str, bytes]


class Rosbag1Container:
    """A ``.bag`` file."""

    def announced(self, path: Path) -> list[Channel] | None:
        """The connections in the index at the end; None if there is none."""
        with path.open("rb") as file:
            try:
                if file.read(len(MAGIC)) != MAGIC:
                    return None
                fields, _, _ = next(_raw_records(file, Budget(0)), ({}, b"", True))
                index = struct.unpack("<Q", fields.get("index_pos", bytes(8)))[0]
                if not index or fields.get("op") != bytes([_BAG_HEADER]):
                    return None
                size = file.seek(0, io.SEEK_END)
                if index >= size:
                    return None
                file.seek(index)
                channels: dict[int, Channel] = {}
                for fields, content, _ in _raw_records(file, Budget(size)):
                    if fields.get("op") == bytes([_CONNECTION]):
                        number, channel = _connection(fields, content)
                        channels[number] = channel
                return list(channels.values()) or None
            except (CutError, RecordFault, struct.error, OSError):
                return None

    def records(
        self, path: Path, account: Account, budget: Budget, on_share: OnShare
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """All messages in file order; skips damaged chunks, ends where the file is truncated."""
        channels: dict[int, Channel] = {}
        chunks, indexed = 0, True
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise DatasetError(f"{path} does not begin as a ROS 1 bag 2.0; convert or copy it again")
            with account.refusing(path.name, None, CUT, CutError):
                size = path.stat().st_size
                for fields, content, valid in _raw_records(file, budget):
                    on_share(file.tell() / size)
                    kind = fields.get("op", b"")
                    if kind == bytes([_BAG_HEADER]):
                        indexed = any(fields.get("index_pos", b""))
                    elif kind == bytes([_CHUNK]):
                        chunks += 1
                        inside = _from_chunk(
                            channels, fields, content, account, budget, path.name, chunks, valid=valid
                        )
                        yield from inside
                    elif valid:
                        if not b"\2" <= kind <= b"\7":
                            account.report.note(UNKNOWN, account.report.line_count)
                        yield from _learned(channels, fields, content, account, path.name)
                if not indexed:
                    raise CutError("no index: the recorder was not stopped properly")


def _raw_records(stream: BinaryIO, budget: Budget) -> Iterator[tuple[_Fields, bytes, bool]]:
    """Header fields and contents up to the end of the stream, and whether the record is complete.

    Raises
    ------
    CutError, RecordFault
        After the last record: it is incomplete, has an impossible size, or exceeds the budget.
    """
    while head := stream.read(4):
        budget.take(0)
        if len(head) < 4:
            raise CutError("within the head of a record")
        (size,) = struct.unpack("<I", head)
        if size > _HEADER_BYTES:
            raise RecordFault(DAMAGED, f"a record's header of {size} bytes")
        fields = _fields(exactly(stream, size))
        (size,) = struct.unpack("<I", exactly(stream, 4))
        try:
            yield fields, exactly(stream, size), True
        except CutError as cut:
            yield fields, cut.content, False
            raise


def _fields(header: bytes) -> _Fields:
    """The named values of a header."""
    values, at = {}, 0
    while at + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, equals, value = header[at + 4 : at + 4 + size].partition(b"=")
        if not equals or at + 4 + size > len(header):
            raise RecordFault(DAMAGED, "header of a record")
        values[name.decode("ascii", "replace")] = value
        at += 4 + size
    return values


def _from_chunk(
    channels: dict[int, Channel],
    fields: _Fields,
    content: bytes,
    account: Account,
    budget: Budget,
    where: str,
    number: int,
    *,
    valid: bool,
) -> Iterator[tuple[Channel, int, bytes]]:
    """The messages of a chunk, as far as it is intact."""
    # A truncated file is reported once, at its end.
    cut = suppress(RecordFault, CutError, struct.error)
    with account.refusing(f"{where}, chunk", number, DAMAGED, CutError, struct.error) if valid else cut:
        (size,) = struct.unpack("<I", fields.get("size", b""))
        compression = fields.get("compression", b"none").decode("ascii", "replace")
        records = unpacked_chunk(content, compression, size, budget, cut=not valid)
        for inner, message, inner_whole in _raw_records(io.BytesIO(records), budget):
            if inner_whole:
                yield from _learned(channels, inner, message, account, where)


def _learned(
    channels: dict[int, Channel], fields: _Fields, content: bytes, account: Account, where: str
) -> Iterator[tuple[Channel, int, bytes]]:
    """The message of a record, if it is one; a damaged record is counted."""
    with account.refusing(where, None, DAMAGED, struct.error):
        if fields.get("op") == bytes([_CONNECTION]):
            number, channel = _connection(fields, content)
            channels[number] = channel
        elif fields.get("op") == bytes([_MESSAGE]):
            (number,) = struct.unpack("<I", fields.get("conn", b""))
            seconds, rest = struct.unpack("<II", fields.get("time", b""))
            if number not in channels:
                raise RecordFault(DAMAGED, f"message on unknown connection {number}")
            yield channels[number], seconds * 1_000_000_000 + rest, content


def _connection(fields: _Fields, content: bytes) -> tuple[int, Channel]:
    """A connection record."""
    (number,) = struct.unpack("<I", fields.get("conn", b""))
    described = _fields(content)
    names = [
        part.decode("utf-8", "replace") for part in (fields.get("topic", b""), described.get("type", b""))
    ]
    text = described.get("message_definition", b"").decode("utf-8", "replace")
    return number, Channel(plain(names[0]), plain(ros2_name(names[1])), "ros1", text)
