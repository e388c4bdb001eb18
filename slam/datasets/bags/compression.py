"""Decompresses files, chunks and messages."""

from __future__ import annotations

import bz2
from contextlib import suppress
from pathlib import Path
from typing import Any

from slam.datasets.bags.records import DAMAGED, Channel
from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.dataset import RecordFault
from slam.errors import DatasetError
from slam.foreign import plain

PACKED = (".zstd", ".zst")  # endings of files that the recorder compressed as a whole
_PIECE_BYTES = 1 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no serialised message starts like this: CDR with 0, ROS 1 with a count


def unpacked_file(path: Path, folder: Path) -> Path:
    """Decompress a whole file into a folder, up to where it is truncated or damaged.

    Raises
    ------
    DatasetError
        It cannot be read or written, or is larger than any log when decompressed.
    """
    if path.suffix.lower() not in PACKED:
        return path
    from slam.zstandard import zstd

    unpacked = folder / path.stem
    try:
        budget = Budget(path.stat().st_size)
        with zstd.open(path) as packed, unpacked.open("wb") as file, suppress(EOFError, zstd.ZstdError):
            while chunk := packed.read1(_PIECE_BYTES):
                budget.take(len(chunk), 0)
                file.write(chunk)
    except (OSError, RecordFault) as error:
        raise DatasetError(
            f"cannot unpack {path} into {folder.parent}: {plain(error)}; set TMPDIR to a folder with "
            f"free space, or unpack it by hand: zstd -d {path}"
        ) from error
    return unpacked


def unpacked_chunk(packed: bytes, compression: str, size: int, budget: Budget, *, cut: bool = False) -> bytes:
    """The decompressed bytes of a chunk.

    Parameters
    ----------
    cut
        The end is missing: return as much as can be decompressed.

    Raises
    ------
    RecordFault
        It does not decompress to that size, the compression is unknown, or the budget is exceeded.
    """
    if size > LARGEST_BYTES:
        raise RecordFault(DAMAGED, f"a chunk of {size} bytes")
    budget.take(size, 0)
    unpacked = packed if compression in ("", "none") else _unpacked(packed, compression, size)
    if len(unpacked) != size and not (cut and len(unpacked) < size):
        raise RecordFault(DAMAGED, f"chunk of {len(unpacked)} bytes, {size} announced")
    return unpacked


def unpacked_message(content: bytes, channel: Channel, budget: Budget) -> bytes:
    """Return a message as serialised, if packed with zstd, too; RecordFault if it does not unpack."""
    if channel.wire != "cdr" or not content.startswith(_ZSTD_MAGIC):
        return content
    budget.take(0, 0)  # if the budget is exhausted, decompress nothing
    message = _unpacked(content, "zstd", LARGEST_BYTES)
    budget.take(len(message), 0)
    if len(message) > LARGEST_BYTES:
        raise RecordFault(DAMAGED, f"a message of more than {LARGEST_BYTES} bytes")
    return message


def _unpacked(packed: bytes, compression: str, most: int) -> bytes:
    """Up to ``most`` decompressed bytes, as far as the data are intact."""
    decompressor = _decompressor(compression)
    failures: tuple[type[Exception], ...] = (RuntimeError, ValueError, OSError, EOFError)
    if compression == "zstd":
        from slam.zstandard import zstd

        failures += (zstd.ZstdError,)
    try:
        return bytes(decompressor.decompress(packed, most + 1))
    except failures as error:
        raise RecordFault(DAMAGED, f"{compression} data cannot be decompressed: {error}") from error


def _decompressor(compression: str) -> Any:
    """What unpacks a stream of a method."""
    if compression == "zstd":
        from slam.zstandard import zstd

        return zstd.ZstdDecompressor()
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor()
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    raise RecordFault(DAMAGED, f"compression {compression[:16]!r} is not known")
