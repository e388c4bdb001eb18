"""Decodes messages with the definitions in the bag, or else with those of the common ROS releases.

Livox's own messages are converted to clouds; a point's time offset is in nanoseconds after the stamp.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from slam.datasets.bags import foxglove
from slam.datasets.bags.cloud_messages import Wire, point_cloud
from slam.datasets.bags.definitions import message_parts, simple_idl
from slam.datasets.bags.ouster import Ousters
from slam.datasets.bags.records import BagRecord, Channel
from slam.datasets.bags.topics import LIVOX, OUSTER, POINT_CLOUD, VELODYNE
from slam.datasets.bags.velodyne import VelodyneDecoder
from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.dataset import RecordFault
from slam.foreign import plain

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

UNDECODED = "message does not decode as its type"
NO_TYPE = "message type without a usable definition"
BAD_STAMP = "stamp of the header is not a time"

_MOST_ELEMENTS = 1 << 13  # in the lists of one message: beams of several echoes, transforms
_WIRES = frozenset({"cdr", "ros1"})
# Messages of drivers; an SQLite bag older than ROS 2 Iron contains no definitions.
_OF_DRIVERS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
    "realsense2_camera_msgs/msg/Extrinsics": "float64[9] rotation\nfloat64[3] translation",
}
# The old name of the same type.
_BUILT_IN_NAMES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}

_FIELDS = (("offset_time", 6, 0), ("x", 7, 4), ("y", 7, 8), ("z", 7, 12), ("reflectivity", 2, 16))
_POINT = 19  # bytes of a point
_ALIGNED = 20  # bytes from one point to the next in ROS 2


class Decoder:
    """The message types of one bag; messages beyond the bag's budget are not decoded."""

    def __init__(self, budget: Budget, ousters: Ousters | None = None) -> None:
        self.ousters = ousters or Ousters()
        self._types: dict[Channel, _Types | None] = {}
        self._velodynes: dict[str, VelodyneDecoder] = {}
        self._budget = budget

    def _cloud(self, record: BagRecord) -> Any:
        """Decode a message of many small records as a cloud."""
        read = point_cloud if record.channel.kind == POINT_CLOUD else livox_cloud
        try:
            return read(record.content, record.channel.wire)
        except (struct.error, ValueError, IndexError) as error:
            text = f"{record.channel.kind} on {record.channel.topic}: {error}"
            raise RecordFault(UNDECODED, text) from error

    def decode(self, record: BagRecord) -> Any:
        """A message with the field names of its definition; None for a packet that completes no revolution.

        Raises
        ------
        RecordFault
            It is damaged, or its type is unknown.
        """
        channel = record.channel
        if channel.wire in foxglove.WIRES and channel.own_kind != channel.kind:
            fits = self._budget.takes_definition(channel.definition)
            definition = channel.definition if fits else ""
            return foxglove.message_of(record.content, channel.own_kind, channel.wire, definition)
        if channel.kind in LIVOX | {POINT_CLOUD} and channel.wire in _WIRES:
            return self._cloud(record)
        if OUSTER & {channel.kind, channel.own_kind} and channel.wire in _WIRES:
            return self.ousters.read(record, of_imu=channel.kind not in OUSTER)
        if channel not in self._types:
            fits = self._budget.takes_definition(channel.definition)
            self._types[channel] = _typestore(channel if fits else replace(channel, definition=""))
        types = self._types[channel]
        if types is None or channel.wire not in _WIRES:
            raise RecordFault(NO_TYPE, f"{channel.kind} on {channel.topic}, {channel.wire}")
        try:
            message = types.decode(record.content, channel.wire)
        # On damaged bytes the generated code can raise anything: lengths, text, alignment.
        except Exception as error:
            raise RecordFault(UNDECODED, f"{channel.kind} on {channel.topic}: {error}") from error
        finally:
            self._budget.take_elements(types.elements)
        if channel.kind == VELODYNE:
            return self._velodynes.setdefault(channel.topic, VelodyneDecoder()).cloud(message)
        return message


def stamp_of(header: Any) -> float:
    """Return seconds of a header; RecordFault if it is no time, or zero (the driver has not set it)."""
    seconds, rest = int(header.stamp.sec), int(header.stamp.nanosec)
    if seconds < 0 or not 0 <= rest < 1_000_000_000 or seconds + rest == 0:
        raise RecordFault(BAD_STAMP, f"{seconds} s, {rest} ns")
    stamp_s = seconds + rest * 1e-9
    if not math.isfinite(stamp_s):
        raise RecordFault(BAD_STAMP, f"{seconds} s")
    return stamp_s


def frame_name(name: Any) -> str:
    """A frame name without the leading slash that ROS 1 allowed."""
    return plain(str(name).lstrip("/"))


def _typestore(channel: Channel) -> _Types | None:
    """The types that a channel needs, with the name of its own type."""
    if channel.definition:
        types = _own_types(channel.definition, channel.language, channel.kind)
        if types is not None:
            return types
    return _built_in(channel.wire, _BUILT_IN_NAMES.get(channel.kind, channel.kind))


# Every bag and pass has the same few definitions; compiling one takes 0.1 s.
@lru_cache(maxsize=64)
def _own_types(definition: str, language: str, kind: str) -> _Types | None:
    """The types of a definition in the bag, None if it cannot be used."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        if language == "msg":
            types = get_types_from_msg(definition, kind)
        else:
            types = get_types_from_idl(simple_idl(definition))
        # Definitions may omit types that every installation has, such as std_msgs/Header.
        return _Types({**_common("cdr").fielddefs, **types}, kind)
    except Exception:  # a damaged definition can raise anything, in the parser or in the generated code
        return None


@cache
def _built_in(wire: str, kind: str) -> _Types | None:
    """A message type of the common releases; None if they have no type of this name."""
    common = _common(wire).fielddefs
    return _Types(common, kind) if kind in common else None


@cache
def _common(wire: str) -> Typestore:
    """The message types of ROS 1 Noetic or ROS 2 Humble."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if wire == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in _OF_DRIVERS.items():
        store.register(get_types_from_msg(text, name))
    return store


class _Types:
    """One message type and its parts, ready to decode.

    Raises
    ------
    ValueError
        It cannot be used; see `message_parts`.

    Attributes
    ----------
    elements
        Number of list elements in the latest message.
    """

    def __init__(self, types: Typesdict, kind: str) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.kind, self.elements = kind, 0
        parts, listed = message_parts(types, kind)
        self.store = get_typestore(Stores.EMPTY)
        self.store.max_sequence_length = LARGEST_BYTES
        self.store.register(parts)
        self.store.get_msgdef(kind)
        for name in listed:
            made = self.store.get_msgdef(name)
            readers = ("deserialize_ros1", "deserialize_cdr_le", "deserialize_cdr_be")
            counted: dict[str, Any] = {reader: self._counting(getattr(made, reader)) for reader in readers}
            self.store.cache[name] = replace(made, **counted)

    def decode(self, content: bytes, wire: str) -> Any:
        """Decode a message; damaged bytes can raise any exception."""
        self.elements = 0
        store = self.store
        read = store.deserialize_ros1 if wire == "ros1" else store.deserialize_cdr
        return read(content, self.kind)

    def _counting(self, read: Callable[..., Any]) -> Callable[..., Any]:
        """Wraps a function that reads one list element, to limit their number."""

        def counting(*arguments: Any) -> Any:
            self.elements += 1
            if self.elements > _MOST_ELEMENTS:
                raise ValueError(f"more than {_MOST_ELEMENTS} elements in its lists")
            return read(*arguments)

        return counting


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
