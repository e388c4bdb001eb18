"""Packed chunks and packed messages."""

from __future__ import annotations

import bz2
from typing import Any

from slam.datasets.bags.records import DAMAGED, LARGEST_BYTES, Channel
from slam.datasets.dataset import RecordFault

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no serialised message begins so: CDR with 0, ROS 1 with a count


def unpacked_chunk(packed: bytes, compression: str, size: int, *, cut: bool = False) -> bytes:
    """A chunk's bytes.

    Parameters
    ----------
    size
        That it must have.
    cut
        The end is missing: as much as unpacks is given.

    Raises
    ------
    RecordFault
        It does not unpack to that size, or by no method that is known.
    """
    if size > LARGEST_BYTES:
        raise RecordFault(DAMAGED, f"a chunk of {size} bytes")
    unpacked = packed if compression in ("", "none") else _unpacked(packed, compression, size)
    if len(unpacked) != size and not (cut and len(unpacked) < size):
        raise RecordFault(DAMAGED, f"chunk of {len(unpacked)} bytes, {size} announced")
    return unpacked


def unpacked_message(content: bytes, channel: Channel) -> bytes:
    """A message as it was serialised, also where the recorder packed each one with zstd.

    Raises
    ------
    RecordFault
        It does not unpack.
    """
    if channel.wire != "cdr" or not content.startswith(_ZSTD_MAGIC):
        return content
    return _unpacked(content, "zstd", LARGEST_BYTES)


def _unpacked(packed: bytes, compression: str, most: int) -> bytes:
    """Up to so many bytes, as far as the data go."""
    decompressor = _decompressor(compression)
    failures: tuple[type[Exception], ...] = (RuntimeError, ValueError, OSError, EOFError)
    if compression == "zstd":
        from backports import zstd

        failures += (zstd.ZstdError,)
    try:
        return bytes(decompressor.decompress(packed, most + 1))
    except failures as error:
        raise RecordFault(DAMAGED, f"{compression} data do not unpack: {error}") from error


def _decompressor(compression: str) -> Any:
    """What unpacks a stream of a method."""
    if compression == "zstd":
        from backports import zstd

        return zstd.ZstdDecompressor()
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor()
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    raise RecordFault(DAMAGED, f"compression {compression[:16]!r} is not known")
