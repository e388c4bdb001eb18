"""Summarises a log in one pass and constant memory: ``scanweave inspect``.

Values are JSON types: angles in radians, all numbers finite, None for unknown.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from slam.config.calibration import Calibration
from slam.config.stages import SensorsConfig
from slam.datasets.bags.dataset import BagDataset
from slam.datasets.corrections import corrected
from slam.datasets.dataset import Dataset, Tally, Thinned
from slam.datasets.inspection_figures import KINDS, Figures
from slam.datasets.sensor_choice import SensorTally
from slam.errors import BadRecordError, DatasetError
from slam.measurements import Measurement

_SEEING = {"2D lidar", "3D lidar", "RGB-D camera"}
_BLIND = "no sensor of the surroundings is used: neither a scan, nor a cloud, nor colour with depth"


def inspect_dataset(dataset: Dataset, calibration: Calibration | None = None) -> dict[str, Any]:
    """Read a log once from start to end, and summarise its contents.

    ``first_stamp_s`` is the earliest stamp, ``duration_s`` the latest minus the earliest; ``refusal`` says
    why the log cannot be mapped (a bag is summarised even then). ``uses`` says for every sensor and topic
    whether mapping with default settings uses it, or why not; ``dropped`` contains the damaged records by
    reason and ``notes`` the anomalies, each with a count, its first lines and the largest.

    Parameters
    ----------
    calibration
        Corrections of sensors; None for none.

    Raises
    ------
    DatasetError
        The log cannot be read; or it is empty and no bag.
    BadRecordError
        A damaged record, if the dataset was opened with ``strict``.
    """
    calibration = calibration or Calibration()
    tally = SensorTally(config=SensorsConfig(calibration=calibration))
    streams: dict[str, _Stream] = {}
    earliest_s, latest_s, refusals = math.inf, -math.inf, list[str]()
    for measurement in _readable_part(corrected(tally.counted(dataset), calibration), dataset, refusals):
        stream = streams.setdefault(measurement.sensor, _Stream())
        stream.add(measurement)
        earliest_s = min(earliest_s, measurement.stamp_s)
        latest_s = max(latest_s, measurement.stamp_s)
    report, uses = dataset.report, tally.uses(dataset.report)
    if not refusals and not any(use.kind in _SEEING and not use.why_not for use in uses):
        refusals.append(_BLIND)
    inspection = {
        "name": dataset.name,
        "path": str(dataset.path),
        "first_stamp_s": earliest_s if streams else 0.0,
        "duration_s": latest_s - earliest_s if streams else 0.0,
        "refusal": " ".join(refusals),
        "sensors": [
            streams[name].facts(name, earliest_s, report.backward_steps.get(name, Tally()))
            for name in sorted(streams)
        ],
        "records": dict(report.records),
        "uses": [asdict(use) for use in uses],
        "dropped": {reason: asdict(tally) for reason, tally in report.dropped.items()},
        "notes": {text: asdict(tally) for text, tally in report.notes.items()},
        "odometry_jumps": asdict(report.odometry_jumps),
        "bag": _bag_facts(dataset),
    }
    return {**inspection, "commands": map_commands(inspection, Path(dataset.path))}


def map_commands(
    inspection: Mapping[str, Any], log: Path, topics: Sequence[str] = (), calibration: Path | None = None
) -> list[str]:
    """The commands that map an inspected log: one for each robot, none if it cannot be mapped."""
    if inspection["refusal"]:
        return []
    bag = inspection["bag"] or {}
    others = [space for space in bag.get("robots", ()) if space != bag["robot"]]
    commands = []
    for space in ("", *others):
        chosen = [space] if space else list(topics)
        out = f"{log.resolve().name.split('.')[0]}{space.replace('/', '-')}-map"
        words = ["scanweave", "map", str(log), *(["--topics", ",".join(chosen)] if chosen else [])]
        words += ["--calibration", str(calibration)] if calibration else []
        commands.append(shlex.join([*words, "-o", out]))
    return commands


def _readable_part(
    log: Iterable[Measurement], dataset: Dataset, refusals: list[str]
) -> Iterator[Measurement]:
    """Iterate over a log; if a bag contains nothing that can be mapped, store the reason."""
    try:
        yield from log
    except BadRecordError:
        raise
    except DatasetError as error:
        if not (_bag_facts(dataset) or {}).get("topics"):
            raise
        refusals.append(str(error))


@dataclass(slots=True)
class _Stream:
    """Running statistics of one sensor."""

    count: int = 0
    intervals: Thinned = field(default_factory=Thinned)
    last_stamp_s: float | None = None
    gap_s: float = 0.0
    gap_from_s: float | None = None
    figures: dict[str, Figures] = field(default_factory=dict)

    def add(self, measurement: Measurement) -> None:
        """Update rate and gaps, ignoring backward steps, and the statistics of the readings."""
        stamp_s = measurement.stamp_s
        self.count += 1
        if self.last_stamp_s is not None and (interval_s := stamp_s - self.last_stamp_s) > 0.0:
            self.intervals.add(interval_s)
            if interval_s > self.gap_s:
                self.gap_s, self.gap_from_s = interval_s, self.last_stamp_s
        self.last_stamp_s = stamp_s
        if known := KINDS.get(type(measurement)):
            name, begun = known
            self.figures.setdefault(name, begun(measurement)).add(measurement)

    def facts(self, sensor: str, origin_s: float, backward: Tally) -> dict[str, Any]:
        """Summary of one stream; its rate is 1 / median interval, the longest gap starts after the origin."""
        median_s = self.intervals.median()
        return {
            "sensor": sensor,
            "count": self.count,
            "rate_hz": None if median_s is None else 1.0 / median_s,
            "longest_gap_s": self.gap_s,
            "longest_gap_at_s": 0.0 if self.gap_from_s is None else self.gap_from_s - origin_s,
            "clock_steps_backward": backward.count,
            "largest_clock_step_s": backward.largest,
            **dict.fromkeys(name for name, _ in KINDS.values()),
            **{name: figures.facts() for name, figures in self.figures.items()},
        }


def _bag_facts(dataset: Dataset) -> dict[str, Any] | None:
    """Topics, clocks and the frame tree of a bag that has been read to its end; None if it is none.

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
