"""Convert plain values and Scanweave's records to bytes and back, exactly; reading never runs code.

There is a closed list of types, each with a tag of one byte. There are no field names, so a changed record
needs a new schema (`slam.storage.map_tables.SCHEMA_VERSION`). Every length is checked against the remaining
bytes before memory is allocated.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import fields
from operator import attrgetter
from typing import Any, cast

import gtsam
import numpy as np

from slam.errors import MapFileError
from slam.estimates import MotionEstimate, Trajectory
from slam.graph.loop_candidate import LoopCandidate
from slam.measurements import CameraIntrinsics, LaserScan
from slam.vision.color_registration import ColorRegistration
from slam.vision.features import Features
from slam.vision.learned_camera import LearnedCamera
from slam.vision.visual_match import VisualMatch

# These numbers are in files: a number once used (also 7 and 8) is never reused.
_RECORDS: dict[int, type] = {
    0: MotionEstimate,
    1: LaserScan,
    2: CameraIntrinsics,
    3: Features,
    4: LoopCandidate,
    5: VisualMatch,
    6: ColorRegistration,
    9: Trajectory,
    10: LearnedCamera,
}
_NUMBER_OF = {record: number for number, record in _RECORDS.items()}
_FIELDS = {
    number: tuple(one.name for one in fields(record) if one.repr) for number, record in _RECORDS.items()
}
_PARTS = {number: attrgetter(*names) for number, names in _FIELDS.items()}
_DTYPES = tuple(np.dtype(name) for name in ("f8", "f4", "i8", "i4", "i2", "i1", "u1", "?"))
_DTYPE_NUMBER = {dtype: number for number, dtype in enumerate(_DTYPES)}
_PLAIN = {b"N": None, b"T": True, b"F": False}
_DEEPEST = 8
_MOST_AXES = 4
FARTHEST_M = 1e8  # limit of a position; farther than any place on Earth
ROUNDING = 1e-6  # tolerance of a rotation after many compositions
# Limits of one decompressed value (twice a map of `grid.greatest_cells`), and of all of a file.
_LARGEST_BYTES, _GROWTH = 1 << 28, 64

_U4, _I8, _F8 = struct.Struct("<I"), struct.Struct("<q"), struct.Struct("<d")
_POSE2, _POSE3 = struct.Struct("<4d"), struct.Struct("<12d")


def pack(value: Any) -> bytes:
    """Pack a value to bytes.

    Raises
    ------
    TypeError
        For a type that is not in the list.
    """
    out = bytearray()
    _pack(value, out)
    return bytes(out)


def unpack(content: bytes) -> Any:
    """Unpack a value from all these bytes.

    Raises
    ------
    MapFileError
        If they are no output of `pack`.
    """
    try:
        value, end = _unpack(content, 0, 0)
    except (struct.error, IndexError, UnicodeDecodeError, ValueError, TypeError) as error:
        raise MapFileError(f"not packed values: {error}") from error
    if end != len(content):
        raise MapFileError(f"{len(content) - end} bytes too many")
    return value


def pack_small(value: Any) -> bytes:
    """Pack a value to compressed bytes."""
    if isinstance(value, np.ndarray):
        # A grid is large, and is compressed in place.
        head, cells = _array_parts(value)
        packer = zlib.compressobj(1)
        parts = _I8.pack(len(head) + len(cells)), packer.compress(head), packer.compress(cells)
        return b"".join([*parts, packer.flush()])
    content = pack(value)
    return _I8.pack(len(content)) + zlib.compress(content, 1)


class Unpacker:
    """Unpacks the compressed values of one file, with a limit relative to its size.

    Parameters
    ----------
    size
        Size of the file in bytes.
    """

    def __init__(self, size: int) -> None:
        self._bytes_left = _LARGEST_BYTES + _GROWTH * size

    def __call__(self, content: bytes, read: Callable[[bytes], Any] | None = None) -> Any:
        """As `unpack_small`, or with another function than `unpack`."""
        self._bytes_left -= _I8.unpack_from(content)[0] if len(content) >= _I8.size else 0
        if self._bytes_left < 0:
            raise MapFileError("it unpacks to more than any map")
        return (read or unpack)(_inflated(content))


def unpack_small(content: bytes) -> Any:
    """Unpack a value from compressed bytes; `MapFileError` as in `unpack`."""
    return unpack(_inflated(content))


def is_in_plane(content: bytes) -> bool:
    """Return whether a packed pose is planar."""
    return content[:1] == b"2"


def last_text(content: bytes) -> str:
    """Return the text at the end of a packed record; `MapFileError` if there is none."""
    for end in range(len(content), 4, -1):
        size = len(content) - end
        if content[end - 5 : end] == b"s" + _U4.pack(size):
            return content[end:].decode("utf-8", "replace")
    raise MapFileError("a record without a text at its end")


def _inflated(content: bytes) -> bytes:
    """Return the decompressed bytes."""
    if len(content) < _I8.size:
        raise MapFileError("compressed values end too soon")
    (size,) = _I8.unpack_from(content)
    if not 0 <= size <= _LARGEST_BYTES:
        raise MapFileError(f"compressed values of {size} bytes")
    unpacker, plain, packed = zlib.decompressobj(), bytearray(), content[_I8.size :]
    try:
        while len(plain) <= size and (part := unpacker.decompress(packed, _LARGEST_BYTES >> 8)):
            plain += part
            packed = unpacker.unconsumed_tail
    except zlib.error as error:
        raise MapFileError(f"compressed values are damaged: {error}") from error
    if len(plain) != size or not unpacker.eof:
        raise MapFileError(f"compressed values are not the {size} bytes that they should be")
    # An array stays in the decompressed buffer.
    return cast(bytes, plain) if plain[:1] == b"a" else bytes(plain)


def _pack(value: Any, out: bytearray) -> None:
    """Append the bytes of one value."""
    number = _NUMBER_OF.get(type(value))
    if number is not None:
        out += b"o" + bytes([number])
        for part in _PARTS[number](value):
            _pack(part, out)
    elif isinstance(value, float):
        out += b"d" + _F8.pack(value)
    elif isinstance(value, np.ndarray):
        for part in _array_parts(value):
            out += part
    elif value is None:
        out += b"N"
    elif isinstance(value, bool | np.bool_):
        out += b"T" if value else b"F"
    elif isinstance(value, gtsam.Pose2):
        # Cosine and sine, not the angle, which would return with another last bit.
        rotation = value.rotation()
        out += b"2" + _POSE2.pack(value.x(), value.y(), rotation.c(), rotation.s())
    elif isinstance(value, int | np.integer):
        out += b"i" + _I8.pack(value)
    elif isinstance(value, str | bytes):
        content = value.encode() if isinstance(value, str) else value
        out += (b"s" if isinstance(value, str) else b"b") + _U4.pack(len(content)) + content
    elif isinstance(value, list | tuple):
        out += (b"l" if isinstance(value, list) else b"t") + _U4.pack(len(value))
        for item in value:
            _pack(item, out)
    elif isinstance(value, gtsam.Pose3):
        out += b"3" + _POSE3.pack(*value.matrix()[:3].ravel())
    else:
        raise TypeError(f"cannot pack a {type(value).__name__}")


def _array_parts(array: np.ndarray[Any, Any]) -> tuple[bytes, memoryview]:
    """Return the header of an array, and its elements in memory order, which may affect last bits."""
    fortran = array.flags.f_contiguous and not array.flags.c_contiguous
    head = b"a", _DTYPE_NUMBER[array.dtype], fortran, array.ndim
    packed = struct.pack(f"<c3B{array.ndim}I", *head, *array.shape)
    return packed, np.ascontiguousarray(array.T if fortran else array).reshape(-1).view(np.uint8).data


def _unpack(content: bytes, at: int, depth: int) -> tuple[Any, int]:
    """Return the value that starts at a byte, and its end."""
    if depth > _DEEPEST:
        raise ValueError("nested too deep")
    tag = content[at : at + 1]
    at += 1
    if tag == b"o":
        number = content[at]
        if number not in _RECORDS:
            raise ValueError(f"unknown record {number}")
        values, at = _unpack_many(content, at + 1, len(_FIELDS[number]), depth)
        return _RECORDS[number](*values), at
    if tag == b"d":
        return _F8.unpack_from(content, at)[0], at + 8
    if tag == b"a":
        return _unpack_array(content, at)
    if tag == b"i":
        return _I8.unpack_from(content, at)[0], at + 8
    if tag in (b"l", b"t", b"s", b"b"):
        (count,) = _U4.unpack_from(content, at)
        at += 4
        if count > len(content) - at:  # an item has at least one byte
            raise ValueError(f"{count} items in {len(content) - at} bytes")
        if tag in (b"s", b"b"):
            part = content[at : at + count]
            return part.decode() if tag == b"s" else part, at + count
        values, at = _unpack_many(content, at, count, depth)
        return values if tag == b"l" else tuple(values), at
    if tag == b"2":
        x, y, cosine, sine = _POSE2.unpack_from(content, at)
        if not (abs(cosine * cosine + sine * sine - 1.0) < ROUNDING and abs(x) + abs(y) < FARTHEST_M):
            raise ValueError("not a pose")
        return gtsam.Pose2(gtsam.Rot2.fromCosSin(cosine, sine), np.array([x, y])), at + 32
    if tag == b"3":
        rows = np.array(_POSE3.unpack_from(content, at)).reshape(3, 4)
        turn = rows[:, :3]
        error = np.abs(turn @ turn.T - np.eye(3)).max() if np.abs(rows).max() < FARTHEST_M else np.inf
        if not (error < ROUNDING and np.linalg.det(turn) > 0.0):
            raise ValueError("not a pose")
        return gtsam.Pose3(gtsam.Rot3(rows[:, :3]), rows[:, 3]), at + 96
    if tag not in _PLAIN:
        raise ValueError(f"unknown tag {tag!r}")
    return _PLAIN[tag], at


def _unpack_many(content: bytes, at: int, count: int, depth: int) -> tuple[list[Any], int]:
    """Return so many values, and their end."""
    values = []
    for _ in range(count):
        value, at = _unpack(content, at, depth + 1)
        values.append(value)
    return values, at


def _unpack_array(content: bytes, at: int) -> tuple[np.ndarray[Any, Any], int]:
    """Return an array, and its end; with its own memory, unless the content is used only by it."""
    dtype, fortran, axes = _DTYPES[content[at]], content[at + 1], content[at + 2]
    if axes > _MOST_AXES or fortran > 1:
        raise ValueError(f"an array with {axes} axes")
    shape = struct.unpack_from(f"<{axes}I", content, at + 3)
    at += 3 + 4 * axes
    size = dtype.itemsize * math.prod(shape)
    if size > len(content) - at:
        raise ValueError(f"an array of {size} bytes in {len(content) - at}")
    array = np.frombuffer(content, dtype, math.prod(shape), at).reshape(shape, order="F" if fortran else "C")
    own = isinstance(content, bytearray) and array.flags.aligned
    return array if own else array.copy(order="A"), at + size
