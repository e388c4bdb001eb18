"""The data of a page, decoded as its script does."""

from __future__ import annotations

import base64
import gzip
import json
import re
import struct
from typing import Any

import numpy as np


def page_data(html: str) -> dict[str, Any]:
    """The head of a page's data, arrays in their places."""
    text = re.search(r'<script type="application/octet-stream" id="data">([^<]*)</script>', html)
    assert text is not None
    whole = gzip.decompress(base64.b64decode(text[1]))
    (size,) = struct.unpack("<I", whole[:4])
    assert (4 + size) % 8 == 0
    return found(json.loads(whole[4 : 4 + size]), whole[4 + size :])


def found(value: Any, arrays: bytes) -> Any:
    """A value of the head."""
    if isinstance(value, list):
        return [found(one, arrays) for one in value]
    if not isinstance(value, dict):
        return value
    if {"dtype", "shape", "offset"} <= value.keys():
        assert value["offset"] % 8 == 0
        count = int(np.prod(value["shape"]))
        return np.frombuffer(arrays, "<" + value["dtype"], count, value["offset"]).reshape(value["shape"])
    return {name: found(one, arrays) for name, one in value.items()}
