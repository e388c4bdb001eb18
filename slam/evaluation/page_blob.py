"""The data of a page as one block: a JSON head, then arrays as they lie in memory; packed, as text.

Four bytes tell the head's length, little-endian, which with them is a multiple of eight; the arrays follow,
each at a multiple of eight from there. In the head an array is ``{"dtype": "f4", "shape": [rows, columns],
"offset": bytes}``. ``templates/page/data.js`` reads it.
"""

from __future__ import annotations

import base64
import gzip
import json
import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam.foreign import plain_lines

_ALIGNED = 8


def packed(head: Mapping[str, Any]) -> str:
    """Texts, numbers and numpy arrays in mappings and sequences, as base64 of gzip; the same each time.

    Texts are made plain, see `slam.foreign`; a float that is not finite becomes null, in an array it stays.
    """
    parts: list[bytes] = []
    text = json.dumps(_told(head, parts), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    filled = text + b" " * (-(4 + len(text)) % _ALIGNED)
    whole = b"".join([struct.pack("<I", len(filled)), filled, *parts])
    return base64.b64encode(gzip.compress(whole, compresslevel=6, mtime=0)).decode("ascii")


def _told(value: Any, parts: list[bytes]) -> Any:
    """A value as JSON can tell it; arrays are appended to the parts."""
    if isinstance(value, np.ndarray):
        offset = sum(map(len, parts))
        content = np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes()
        parts.append(content + bytes(-len(content) % _ALIGNED))
        return {"dtype": value.dtype.str[1:], "shape": list(value.shape), "offset": offset}
    if isinstance(value, str):
        return plain_lines(value)
    if isinstance(value, Mapping):
        return {plain_lines(str(key)): _told(one, parts) for key, one in value.items()}
    if isinstance(value, Sequence):
        return [_told(one, parts) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
