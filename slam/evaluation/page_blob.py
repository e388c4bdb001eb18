"""Data of a page as one block: a JSON head, then arrays as they are in memory; compressed, as text.

The first four bytes are the length of the head, little-endian; together with them it is a multiple of eight.
The arrays follow, each at a multiple of eight from there. In the head an array is ``{"dtype": "f4", "shape":
[rows, columns], "offset": bytes}``. ``templates/page/data.js`` reads it.
"""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.foreign import plain_lines

_ALIGNED = 8


def packed(head: Mapping[str, Any]) -> str:
    """Pack texts, numbers and numpy arrays in mappings and sequences as base64 of gzip, deterministically.

    Texts are made plain, see `slam.foreign`; a float that is not finite becomes null, in an array it stays.
    """
    parts: list[NDArray[Any]] = []
    text = json.dumps(_json(head, parts), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    filled = text + b" " * (-(4 + len(text)) % _ALIGNED)
    # Packed part by part: all at once would need twice the memory more.
    packer = zlib.compressobj(4, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    pieces = [packer.compress(struct.pack("<I", len(filled)) + filled)]
    for part in parts:
        pieces += [packer.compress(part.data), packer.compress(bytes(-part.nbytes % _ALIGNED))]
    return base64.b64encode(b"".join([*pieces, packer.flush()])).decode("ascii")


def _json(value: Any, parts: list[NDArray[Any]]) -> Any:
    """Convert a value for JSON; arrays are appended to the parts."""
    if isinstance(value, np.ndarray):
        offset = sum(part.nbytes + -part.nbytes % _ALIGNED for part in parts)
        parts.append(np.ascontiguousarray(value, value.dtype.newbyteorder("<")).reshape(-1).view(np.uint8))
        return {"dtype": value.dtype.str[1:], "shape": list(value.shape), "offset": offset}
    if isinstance(value, str):
        return plain_lines(value)
    if isinstance(value, Mapping):
        return {plain_lines(str(key)): _json(item, parts) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_json(item, parts) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
