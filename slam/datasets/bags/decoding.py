"""Serialised messages as objects, by the definitions in the bag and else by those of the common releases."""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

from slam.datasets.bags.records import LARGEST_BYTES, BagRecord, Channel
from slam.datasets.dataset import RecordFault

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

UNDECODED = "message does not decode as its type"
NO_TYPE = "message type without a usable definition"
BAD_STAMP = "stamp of the header is not a time"

_WIRES = frozenset({"cdr", "ros1"})
# The old name of the same type.
_BUILT_IN_NAMES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}


class Decoder:
    """The message types of one bag."""

    def __init__(self) -> None:
        self._stores: dict[Channel, tuple[Typestore, str] | None] = {}

    def decode(self, record: BagRecord) -> Any:
        """A message; its fields have the names of its definition.

        Raises
        ------
        RecordFault
            It is damaged, or its type is not known.
        """
        channel = record.channel
        if channel not in self._stores:
            self._stores[channel] = _typestore(channel)
        found = self._stores[channel]
        if found is None or channel.wire not in _WIRES:
            raise RecordFault(NO_TYPE, f"{channel.kind} on {channel.topic}, {channel.wire}")
        store, kind = found
        try:
            if channel.wire == "ros1":
                return store.deserialize_ros1(record.content, kind)
            return store.deserialize_cdr(record.content, kind)
        # The generated code fails in any way on damaged bytes: lengths, text, alignment.
        except Exception as error:
            raise RecordFault(UNDECODED, f"{channel.kind} on {channel.topic}: {error}") from error


def stamp_of(header: Any) -> float:
    """Seconds of a header.

    Raises
    ------
    RecordFault
        Not a time, or zero: the driver has not set it.
    """
    seconds, rest = int(header.stamp.sec), int(header.stamp.nanosec)
    if seconds < 0 or not 0 <= rest < 1_000_000_000 or seconds + rest == 0:
        raise RecordFault(BAD_STAMP, f"{seconds} s, {rest} ns")
    stamp_s = seconds + rest * 1e-9
    if not math.isfinite(stamp_s):
        raise RecordFault(BAD_STAMP, f"{seconds} s")
    return stamp_s


def frame_name(name: Any) -> str:
    """A frame's name without the slash that ROS 1 allowed before it."""
    return str(name).lstrip("/")


def _typestore(channel: Channel) -> tuple[Typestore, str] | None:
    """The types that a channel needs, and the name of its own among them."""
    if channel.definition:
        store = _own_types(channel.definition, channel.language, channel.kind)
        if store is not None:
            return store, channel.kind
    store, kind = _built_in(channel.wire), _BUILT_IN_NAMES.get(channel.kind, channel.kind)
    return (store, kind) if kind in store.fielddefs else None


# The same few definitions come in every bag and pass, and each costs a tenth of a second to compile.
@lru_cache(maxsize=64)
def _own_types(definition: str, language: str, kind: str) -> Typestore | None:
    """The types of a definition in the bag, None where it cannot be used."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        types = get_types_from_msg(definition, kind) if language == "msg" else get_types_from_idl(definition)
    except Exception:  # a damaged definition fails in any way in the parser
        return None
    # Definitions may leave out what every installation has, as std_msgs/Header.
    return _store(types, kind) or _store({**_built_in("cdr").fielddefs, **types}, kind)


def _store(types: Typesdict, kind: str) -> Typestore | None:
    """A store of types, None where they do not describe a type wholly."""
    from rosbags.typesys import Stores, get_typestore

    try:
        store = get_typestore(Stores.EMPTY)
        store.max_sequence_length = LARGEST_BYTES
        store.register(types)
        store.get_msgdef(kind)
    except Exception:  # nor do names that are none survive the code that is generated from them
        return None
    return store


@cache
def _built_in(wire: str) -> Typestore:
    """The message types of ROS 1 Noetic or ROS 2 Humble."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if wire == "ros1" else Stores.ROS2_HUMBLE)
    store.max_sequence_length = LARGEST_BYTES
    return store
