"""The interface of all containers: channels, and serialised messages in file order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from slam.datasets.account import Account
from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import OnShare

CUT = "the bag ends in the middle of a record; read up to there"
DAMAGED = "damaged record of the bag"
UNKNOWN = "record of an unknown kind, skipped"


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic as described in the bag.

    Attributes
    ----------
    topic, kind
        Its name, and the message type as in ROS 2: ``sensor_msgs/msg/LaserScan``.
    wire
        How messages are serialised: "cdr" or "ros1", Foxglove's own "protobuf" or "json"; others are
        not read.
    definition, language
        Text of the message type ("msg" or "idl"), or its bytes; empty if the bag does not contain it.
    own_kind
        The message type as the bag names it, if it is read as another.
    """

    topic: str
    kind: str
    wire: str
    definition: str = ""
    language: str = "msg"
    own_kind: str = ""


@dataclass(frozen=True, slots=True)
class BagRecord:
    """A serialised message.

    Attributes
    ----------
    number
        Its 1-based index in the bag.
    recorded_s
        Record time, by the clock of the recorder.
    """

    number: int
    channel: Channel
    recorded_s: float
    content: bytes


class Container(Protocol):
    """A file of messages."""

    def announced(self, path: Path) -> list[Channel] | None:
        """All channels in the index of the file; None if there is no index, as in a truncated file."""
        ...

    def records(
        self, path: Path, account: Account, budget: Budget, on_share: OnShare
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Channel, time in nanoseconds and content of each message; damaged ones are counted in the account.

        The decompressed size is taken from the budget; reading ends when the budget is exhausted. From time
        to time ``on_share`` is called with the fraction of the file that has been read, 0..1.

        Raises
        ------
        DatasetError
            The file cannot be read at all.
        """
        ...


class CutError(Exception):
    """The file, or a chunk in it, ends within a record; ``content`` is the part that exists."""

    def __init__(self, text: str, content: bytes = b"") -> None:
        super().__init__(text)
        self.content = content


def exactly(stream: BinaryIO, size: int) -> bytes:
    """Read exactly ``size`` bytes.

    Raises
    ------
    CutError
        There are fewer bytes.
    RecordFault
        More than a message can have, so the size is damaged.
    """
    if size > LARGEST_BYTES:
        raise RecordFault(DAMAGED, f"a record of {size} bytes")
    content = stream.read(size)
    if len(content) < size:
        raise CutError(f"{size} bytes announced, {len(content)} there", content)
    return content


def ros2_name(kind: str) -> str:
    """The ROS 2 name of a message type, also for names like ``sensor_msgs/LaserScan``."""
    parts = kind.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else kind
