"""What a bag tells of its topics beside their measurements: rates, gaps, clocks, frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam.datasets.bags.records import BagRecord
from slam.datasets.bags.transforms import FrameTree

_SAMPLES_KEPT = 4096
_MOST_TOPICS = 2000  # a robot has some dozens; damaged names must not fill the memory


@dataclass(slots=True)
class TopicFigures:
    """One topic, by the recorder's clock.

    Attributes
    ----------
    late_s
        An even sample of record time less header stamp, of the messages that are read.
    """

    kind: str
    count: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    gap_s: float = 0.0
    gap_at_s: float = 0.0
    late_s: list[float] = field(default_factory=list)
    _stride: int = 1
    _stamped: int = 0

    def saw(self, recorded_s: float) -> None:
        """Count a message."""
        if self.count == 0:
            self.first_s = self.last_s = recorded_s
        if recorded_s - self.last_s > self.gap_s:
            self.gap_s, self.gap_at_s = recorded_s - self.last_s, self.last_s
        self.last_s = recorded_s
        self.count += 1

    def stamped(self, late_s: float) -> None:
        """A message was recorded so much later than its header says."""
        if self._stamped % self._stride == 0:
            self.late_s.append(late_s)
            if len(self.late_s) >= _SAMPLES_KEPT:
                del self.late_s[1::2]
                self._stride *= 2
        self._stamped += 1

    @property
    def rate_hz(self) -> float | None:
        """Messages a second, None for fewer than two or no time between them."""
        span_s = self.last_s - self.first_s
        return (self.count - 1) / span_s if self.count > 1 and span_s > 0.0 else None

    @property
    def median_late_s(self) -> float | None:
        """Median of record time less header stamp, None where no message was read."""
        return float(np.median(self.late_s)) if self.late_s else None


@dataclass(slots=True)
class BagFigures:
    """All topics of a bag, and its tree of frames.

    Attributes
    ----------
    base
        The robot's frame, None where the bag has no tf.
    """

    tree: FrameTree = field(default_factory=FrameTree)
    base: str | None = None
    topics: dict[str, TopicFigures] = field(default_factory=dict)

    def saw(self, record: BagRecord) -> None:
        """Count a message."""
        topic = record.channel.topic
        if topic not in self.topics:
            if len(self.topics) >= _MOST_TOPICS:
                return
            self.topics[topic] = TopicFigures(record.channel.kind)
        self.topics[topic].saw(record.recorded_s)

    def stamped(self, record: BagRecord, stamp_s: float) -> None:
        """A message that was read has a stamp in its header."""
        figures = self.topics.get(record.channel.topic)
        if figures is not None:
            figures.stamped(record.recorded_s - stamp_s)
