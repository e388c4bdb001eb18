"""What a ROS bag tells beside its measurements: topics, clocks, the tree of frames."""

from __future__ import annotations

from dataclasses import dataclass

from slam.datasets.bags.dataset import BagDataset
from slam.datasets.dataset import Dataset

_TELLING_S = 0.02  # medians that are nearer to each other than that tell nothing


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
            topic.median_late_s,
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


def bag_lines(bag: BagSummary) -> list[str]:
    """The summary as lines for people."""
    lines = ["  topics of the bag, by the recorder's clock:"]
    for topic in bag.topics:
        rate = "rate unknown" if topic.rate_hz is None else f"{topic.rate_hz:.2f} Hz"
        late = "" if topic.late_s is None else f", {_lateness(topic.late_s)} its stamp (median)"
        kind = topic.kind.rpartition("/")[2]
        gap = f"longest gap {topic.longest_gap_s:.2f} s at {topic.longest_gap_at_s:.1f} s"
        lines.append(f"    {topic.topic} ({kind}): {topic.count} messages, {rate}, {gap}{late}")
    far = {name: ahead_s for name, ahead_s in bag.clock_offsets_s.items() if abs(ahead_s) > _TELLING_S}
    for name, ahead_s in far.items():
        side = "ahead of" if ahead_s > 0.0 else "behind"
        lines.append(
            f"    clock: {name} is stamped {abs(ahead_s):.3f} s {side} {bag.reference}, "
            "if both arrive equally fast"
        )
    if bag.frames:
        lines.append(f"  frames, the robot's is {bag.base or 'not told'}:")
        lines += [f"    {line}" for line in bag.frames]
    return lines


def _lateness(late_s: float) -> str:
    """A time before or after, in words."""
    return f"{abs(late_s):.3f} s {'before' if late_s < -0.0005 else 'after'}"
