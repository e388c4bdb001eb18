"""What every container of messages gives: channels, and serialised messages in the order of the file."""

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
    """A topic as the bag announces it.

    Attributes
    ----------
    topic, kind
        Its name, and the message type as in ROS 2: ``sensor_msgs/msg/LaserScan``.
    wire
        How messages are serialised: "cdr" or "ros1", Foxglove's own "protobuf" or "json"; others are
        not read.
    definition, language
        Text of the message type ("msg" or "idl"), or its bytes; empty where the bag does not tell it.
    own_kind
        The message type as the bag names it, where it is read as another.
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
        Its 1-based place in the bag.
    recorded_s
        When it was written, by the clock of the recorder.
    """

    number: int
    channel: Channel
    recorded_s: float
    content: bytes


class Container(Protocol):
    """A file of messages."""

    def announced(self, path: Path) -> list[Channel] | None:
        """All channels by the index of the file; None where it has none, as a cut-off file."""
        ...

    def records(
        self, path: Path, account: Account, budget: Budget, on_share: OnShare
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Channel, time in nanoseconds and content of each message; what is damaged goes to the account.

        What the file unpacks to is taken from the budget; where that is used up the rest is not read.

        Now and then ``on_share`` is told the share of the file that has been read, 0..1.

        Raises
        ------
        DatasetError
            The file cannot be read at all.
        """
        ...


class CutError(Exception):
    """The file, or a chunk in it, ends within a record; ``content`` is what there is of it."""

    def __init__(self, text: str, content: bytes = b"") -> None:
        super().__init__(text)
        self.content = content


def exactly(stream: BinaryIO, size: int) -> bytes:
    """So many bytes.

    Raises
    ------
    CutError
        There are fewer.
    RecordFault
        More than a message can have: the size is damaged.
    """
    if size > LARGEST_BYTES:
        raise RecordFault(DAMAGED, f"a record of {size} bytes")
    content = stream.read(size)
    if len(content) < size:
        raise CutError(f"{size} bytes announced, {len(content)} there", content)
    return content


def ros2_name(kind: str) -> str:
    """A message type as ROS 2 writes it, also where it comes as ``sensor_msgs/LaserScan``."""
    parts = kind.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else kind
