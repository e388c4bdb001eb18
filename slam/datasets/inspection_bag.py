"""What a ROS bag tells beside its measurements: topics, clocks, the tree of frames."""

from __future__ import annotations

from dataclasses import dataclass

from slam.datasets.bags.dataset import BagDataset
from slam.datasets.dataset import Dataset


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic, by the recorder's clock.

    Attributes
    ----------
    rate_hz
        None for fewer than two messages.
    longest_gap_s, longest_gap_at_s
        The longest time without a message, and when it began after the bag's first message.
    late_s
        Median of record time less header stamp; None where the topic is not read.
    """

    topic: str
    kind: str
    count: int
    rate_hz: float | None
    longest_gap_s: float
    longest_gap_at_s: float
    late_s: float | None


@dataclass(frozen=True, slots=True)
class BagSummary:
    """A bag.

    Attributes
    ----------
    topics
        By name.
    clock_offsets_s
        By topic: how far its stamps are ahead of those of ``reference``, if both arrive equally fast.
    reference
        The topic with the most messages among those that are read.
    base, frames
        The robot's frame, and the tree of frames, one a line.
    """

    topics: tuple[TopicSummary, ...]
    reference: str
    clock_offsets_s: dict[str, float]
    base: str | None
    frames: tuple[str, ...]


def bag_summary(dataset: Dataset) -> BagSummary | None:
    """Of a dataset that has been read to its end; None where it is no bag."""
    if not isinstance(dataset, BagDataset):
        return None
    figures = dataset.figures
    first_s = min((topic.first_s for topic in figures.topics.values()), default=0.0)
    topics = tuple(
        TopicSummary(
            name,
            topic.kind,
            topic.count,
            topic.rate_hz,
            topic.gap_s,
            topic.gap_at_s - first_s if topic.gap_s else 0.0,
            topic.late_s.median(),
        )
        for name, topic in sorted(figures.topics.items())
    )
    read = [topic for topic in topics if topic.late_s is not None]
    reference = max(read, key=lambda topic: topic.count, default=None)
    offsets = {}
    if reference is not None and reference.late_s is not None:
        offsets = {t.topic: reference.late_s - t.late_s for t in read if t.late_s is not None}
        del offsets[reference.topic]
    name = reference.topic if reference else ""
    return BagSummary(topics, name, offsets, figures.base, tuple(figures.tree.lines()))
