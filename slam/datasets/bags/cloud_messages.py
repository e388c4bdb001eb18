"""Converts clouds of other message types, including the old PointCloud, to the fields of a PointCloud2."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES

_KIND, _SIZE = 7, 4  # sensor_msgs/PointField: a float of four bytes
_MOST_CHANNELS = 64


def as_cloud(header: Any, columns: Mapping[str, NDArray[Any]]) -> SimpleNamespace:
    """A message made of the columns of a cloud; ``x``, ``y`` and ``z`` are among them, (N,) each."""
    table = np.stack([np.asarray(column, dtype="<f4").ravel() for column in columns.values()], axis=1)
    return SimpleNamespace(
        header=header,
        height=1,
        width=len(table),
        fields=[
            SimpleNamespace(name=name, datatype=_KIND, offset=_SIZE * place, count=1)
            for place, name in enumerate(columns)
        ],
        is_bigendian=False,
        point_step=_SIZE * len(columns),
        row_step=table.nbytes,
        data=np.frombuffer(table.tobytes(), np.uint8),
    )


def header_at(stamp_s: float, frame: str) -> SimpleNamespace:
    """A header with a stamp in seconds."""
    sec = int(stamp_s)
    stamp = SimpleNamespace(sec=sec, nanosec=min(round((stamp_s - sec) * 1e9), 999_999_999))
    return SimpleNamespace(stamp=stamp, frame_id=frame)


class Wire:
    """Reads serialised bytes field by field, of ROS 1 or CDR.

    Raises
    ------
    struct.error, ValueError
        From all methods: bytes are missing, or there are too many.
    """

    def __init__(self, content: bytes, wire: str) -> None:
        self.content = content
        self._aligned = wire != "ros1"
        self.order = "<" if not self._aligned or content[1] & 1 else ">"
        self.at = self._start = 4  # the encapsulation of CDR; the number of a header in ROS 1

    def number(self) -> int:
        """A uint32."""
        if self._aligned:
            self.at += -(self.at - self._start) % 4
        (value,) = struct.unpack_from(f"{self.order}I", self.content, self.at)
        self.at += 4
        return int(value)

    def text(self) -> str:
        """A string."""
        return bytes(self._taken(self.number(), "u1")).rstrip(b"\0").decode("utf-8", "replace")

    def header(self) -> SimpleNamespace:
        """The header at the start of a message."""
        stamp = SimpleNamespace(sec=self.number(), nanosec=self.number())
        return SimpleNamespace(stamp=stamp, frame_id=self.text())

    def floats(self, per_item: int) -> NDArray[Any]:
        """(N, per_item) values of a list whose items consist of floats."""
        return self._taken(self.number() * per_item, f"{self.order}f4").reshape(-1, per_item)

    def _taken(self, count: int, kind: str) -> NDArray[Any]:
        size = count * np.dtype(kind).itemsize
        if size > min(LARGEST_BYTES, len(self.content) - self.at):
            raise ValueError(f"{count} values in {len(self.content)} bytes")
        values = np.frombuffer(self.content, kind, count, self.at)
        self.at += size
        return values


def point_cloud(content: bytes, wire: str) -> SimpleNamespace:
    """Convert a sensor_msgs/PointCloud, of the first years of ROS, to a PointCloud2.

    Decoded here because each of its points is a separate record.

    Raises
    ------
    struct.error, ValueError
        Bytes are missing, or there are too many.
    """
    message = Wire(content, wire)
    header, points = message.header(), message.floats(3)
    columns = dict(zip("xyz", points.T, strict=True))
    for _ in range(min(message.number(), _MOST_CHANNELS)):
        name, values = message.text(), message.floats(1).ravel()
        if len(values) == len(points) and name:
            columns.setdefault(name, values)
    return as_cloud(header, columns)
