"""Statistics of a bag's topics: rates, gaps, clocks, frames."""

from __future__ import annotations

from dataclasses import dataclass, field

from slam.datasets.bags.records import BagRecord
from slam.datasets.bags.robots import Robots
from slam.datasets.bags.transforms import FrameTree
from slam.datasets.dataset import MOST_TOPICS, Thinned


@dataclass(slots=True)
class TopicFigures:
    """Statistics of one topic, by the recorder's clock.

    Attributes
    ----------
    frame
        Frame of its readings; empty if it is no sensor's topic.
    late_s
        Uniform sample of the record time minus the header stamp, of the messages that are read.
    """

    kind: str
    frame: str = ""
    count: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    gap_s: float = 0.0
    gap_at_s: float = 0.0
    late_s: Thinned = field(default_factory=Thinned)

    def add(self, recorded_s: float) -> None:
        """Count a message."""
        if self.count == 0:
            self.first_s = self.last_s = recorded_s
        if recorded_s - self.last_s > self.gap_s:
            self.gap_s, self.gap_at_s = recorded_s - self.last_s, self.last_s
        self.last_s = recorded_s
        self.count += 1

    @property
    def rate_hz(self) -> float | None:
        """Messages per second, None for fewer than two or no time between them."""
        span_s = self.last_s - self.first_s
        return (self.count - 1) / span_s if self.count > 1 and span_s > 0.0 else None


@dataclass(slots=True)
class BagFigures:
    """All topics of a bag, and its frame tree.

    Attributes
    ----------
    base
        The robot's frame, None if the bag has no tf.
    """

    tree: FrameTree = field(default_factory=FrameTree)
    base: str | None = None
    robots: Robots = field(default_factory=Robots)
    frames: dict[str, str] = field(default_factory=dict)
    topics: dict[str, TopicFigures] = field(default_factory=dict)

    def add(self, record: BagRecord) -> None:
        """Count a message."""
        topic = record.channel.topic
        if topic not in self.topics:
            if len(self.topics) >= MOST_TOPICS:
                return
            self.topics[topic] = TopicFigures(record.channel.kind, self.frames.get(topic, ""))
        self.topics[topic].add(record.recorded_s)

    def stamped(self, record: BagRecord, stamp_s: float) -> None:
        """Add the header stamp of a message that was read."""
        figures = self.topics.get(record.channel.topic)
        if figures is not None:
            figures.late_s.add(record.recorded_s - stamp_s)
