"""Converts Livox's own messages to clouds; a point's time offset is in nanoseconds after the stamp."""

from __future__ import annotations

from types import SimpleNamespace

from slam.datasets.bags.cloud_messages import Wire
from slam.datasets.budget import LARGEST_BYTES

_FIELDS = (("offset_time", 6, 0), ("x", 7, 4), ("y", 7, 8), ("z", 7, 12), ("reflectivity", 2, 16))
_POINT = 19  # bytes of a point
_ALIGNED = 20  # bytes from one point to the next in ROS 2


def livox_cloud(content: bytes, wire: str) -> SimpleNamespace:
    """Convert a CustomMsg to the fields of a PointCloud2.

    Decoded here because a message has tens of thousands of points, each a separate record.

    Raises
    ------
    struct.error, ValueError
        Bytes are missing, or there are too many.
    """
    ros1 = wire == "ros1"
    message = Wire(content, wire)
    header = message.header()
    at = message.at
    if not ros1:
        at += -(at - 4) % 8
    message.at = at + 16  # base of time, number of points, lidar, reserved
    count = message.number()
    at = message.at
    step = _POINT if ros1 else _ALIGNED
    if not 0 < count * step <= LARGEST_BYTES or len(content) < at + count * step - (step - _POINT):
        raise ValueError(f"{count} points in {len(content)} bytes")
    return SimpleNamespace(
        header=header,
        height=1,
        width=count,
        fields=[
            SimpleNamespace(name=name, datatype=kind, offset=offset, count=1)
            for name, kind, offset in _FIELDS
        ],
        is_bigendian=message.order == ">",
        point_step=step,
        row_step=count * step,
        data=bytearray(content[at:].ljust(count * step, b"\0")[: count * step]),
    )
