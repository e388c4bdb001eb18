"""Convert clouds to bytes and back: points in integer steps, stored as differences, compressed by Zstandard.

Intensities, if there are any, follow unchanged (float32), with the upper bytes separate from the lower.
Maps of schema 5 and older used zlib, at seven times the cost and the same size.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

from fusion.kernel import ZERO, kernel
from slam.errors import ScanweaveError
from slam.measurements import FloatArray
from slam.zstandard import zstd

STEP_M = 0.001  # a thirtieth of a 3D lidar's noise; coarser only for a cloud that reaches beyond 500 km
_MOST_BYTES = 1 << 27  # unpacked
_HEAD = struct.Struct("<dI")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def packed_cloud(rows: FloatArray) -> bytes:
    """Pack points (N, 3), rounded to steps of `STEP_M`, in order; a fourth column contains intensities.

    Raises
    ------
    ScanweaveError
        If a point is not finite.
    """
    reach_m = float(np.abs(rows[:, :3]).max(initial=0.0))
    if not np.isfinite(reach_m):
        raise ScanweaveError(f"a cloud holds a point at {reach_m}; only finite points can be kept")
    step_m = max(STEP_M, reach_m / 2**29)
    ways = np.diff(np.rint(rows[:, :3] / step_m), axis=0, prepend=0.0).astype(np.int64)
    # The sign is the lowest bit: the upper bytes of small differences are zero for either sign.
    planes = (ways << 1 ^ ways >> 63).astype("<u4").view(np.uint8).reshape(-1, 3, 4).T
    intensities = rows[:, 3:].astype("<f4").view(np.uint8).reshape(-1, 4).T.tobytes()
    return _HEAD.pack(step_m, len(rows)) + zstd.compress(planes.tobytes() + intensities, 1)


def unpacked_cloud(content: bytes, *, intensities: bool = True) -> FloatArray:
    """Unpack points (N, 3), or (N, 4) with their intensities if requested.

    Raises
    ------
    ValueError
        If they are not the output of `packed_cloud`; no more than the stated size is unpacked.
    """
    if len(content) < _HEAD.size:
        raise ValueError("a cloud that ends too soon")
    step_m, count = _HEAD.unpack_from(content)
    sizes = [columns * np.dtype(np.int32).itemsize * count for columns in (3, 4)]
    if not 0.0 < step_m < np.inf:
        raise ValueError(f"a packed cloud in steps of {step_m:g} m")
    packed = content[_HEAD.size :]
    unpacker: Any = zstd.ZstdDecompressor() if packed.startswith(_ZSTD_MAGIC) else zlib.decompressobj()
    try:
        plain = unpacker.decompress(packed, min(sizes[-1], _MOST_BYTES) + 1)
    except (zlib.error, zstd.ZstdError) as error:
        raise ValueError(f"a packed cloud that is damaged: {error}") from error
    if len(plain) not in sizes or not unpacker.eof or unpacker.unused_data:
        raise ValueError(f"a packed cloud that is not of {count} points")
    rows = np.empty((count, 3 + (intensities and len(plain) > sizes[0])))
    planes = np.frombuffer(plain, np.uint8)
    _added_up(planes[: sizes[0]].reshape(4, 3, count), step_m, rows)
    if rows.shape[1] > 3:
        rows[:, 3] = np.ascontiguousarray(planes[sizes[0] :].reshape(4, count).T).view("<f4")[:, 0]
    return rows


@kernel(nogil=True)
def _added_up(planes, step_m, points):  # type: ignore[no-untyped-def]
    """Sum points (N, 3 or 4) from the bytes (4, 3, N) of their differences."""
    for axis in range(3):
        steps = ZERO
        for i in range(points.shape[0]):
            signless = np.int64(planes[0, axis, i]) | (np.int64(planes[1, axis, i]) << 8)
            signless |= (np.int64(planes[2, axis, i]) << 16) | (np.int64(planes[3, axis, i]) << 24)
            steps += (signless >> 1) ^ -(signless & 1)
            # As 32-bit integers, which a damaged cloud may exceed.
            steps = ((steps + (1 << 31)) & ((1 << 32) - 1)) - (1 << 31)
            points[i, axis] = steps * step_m
