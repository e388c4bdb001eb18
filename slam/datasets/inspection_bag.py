"""Summarises topics, clocks and the frame tree of a ROS bag."""

from __future__ import annotations

from typing import Any

from slam.datasets.bags.dataset import BagDataset
from slam.datasets.dataset import Dataset


def bag_facts(dataset: Dataset) -> dict[str, Any] | None:
    """Summary of a dataset that has been read to its end; None if it is no bag.

    ``late_s`` of a topic is the median of record time minus header stamp. ``clock_offsets_s`` is how far its
    stamps are ahead of those of ``reference``, the topic with most messages, assuming equal latency.
    ``base`` is the robot's frame, ``frames`` the frame tree, one frame per line. With several robots,
    ``robots`` are their namespaces, and ``robot`` is the namespace of the one that is read.
    """
    if not isinstance(dataset, BagDataset):
        return None
    figures = dataset.figures
    first_s = min((topic.first_s for topic in figures.topics.values()), default=0.0)
    topics: list[dict[str, Any]] = [
        {
            "topic": name,
            "kind": topic.kind,
            "count": topic.count,
            "rate_hz": topic.rate_hz,
            "longest_gap_s": topic.gap_s,
            "longest_gap_at_s": topic.gap_at_s - first_s if topic.gap_s else 0.0,
            "frame": topic.frame,
            "late_s": topic.late_s.median(),
        }
        for name, topic in sorted(figures.topics.items())
    ]
    read = sorted((topic for topic in topics if topic["late_s"] is not None), key=lambda one: -one["count"])
    return {
        "topics": topics,
        "reference": read[0]["topic"] if read else "",
        "clock_offsets_s": {one["topic"]: read[0]["late_s"] - one["late_s"] for one in read[1:]},
        "base": figures.base,
        "frames": list(figures.tree.lines()),
        "robots": list(figures.robots.spaces),
        "robot": figures.robots.read,
    }
