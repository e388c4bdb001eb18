"""The output of every reader: a stream of measurements and a report of the pass."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from fusion.time_alignment import GAP_S
from slam.estimates import Trajectory
from slam.foreign import plain
from slam.measurements import Measurement, WheelOdometry

# Above these limits, two odometry readings contain a jump, not a motion: an indoor robot stays below 3 m/s,
# and the tolerance covers pairs whose stamps coincide or run backward.
JUMP_SPEED_M_S = 3.0
JUMP_SLACK_M = 0.3
JUMP_TURN_RAD_S = math.pi
JUMP_SLACK_RAD = 0.5

STAMP_LIMIT_S = 1e11  # year 5138; milliseconds or ticks by mistake are beyond it
_SAMPLES_KEPT = 4096  # numbers stored for a median
_LINES_KEPT = 3  # examples stored for each type of event
MOST_TOPICS = 2000  # a robot has a few dozen; damaged names must not fill the memory
_KEYS_KEPT = 32  # types of event; the others share one key, so that damaged data cannot enlarge the report
_OTHER = "(others)"
READ_TO_THERE = "read up to there"  # end of a fault's reason, if reading stopped there
WARNING = "warning: "  # start of a note that is a warning


class RecordFault(Exception):
    """A record that cannot be used; readers count and drop it, or stop under ``--strict``.

    Parameters
    ----------
    reason
        One of a few fixed texts, the key of the count.
    detail
        The faulty values, for the message of a strict run.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(plain(f"{reason}: {detail}"))
        self.reason = reason
        self.detail = detail


@dataclass(slots=True)
class Tally:
    """How often something happened, where first, and its maximum size."""

    count: int = 0
    lines: list[int] = field(default_factory=list)
    largest: float = 0.0

    def add(self, line: int, size: float = 0.0) -> None:
        """Count an event at a 1-based record or line number."""
        self.count += 1
        self.largest = max(self.largest, size)
        if len(self.lines) < _LINES_KEPT:
            self.lines.append(line)


@dataclass(slots=True)
class Thinned:
    """A uniform, deterministic sample of a stream of numbers, of limited size."""

    values: list[float] = field(default_factory=list)
    stride: int = 1
    seen: int = 0

    def add(self, value: float) -> None:
        """Add the next number."""
        if self.seen % self.stride == 0:
            self.values.append(value)
            if len(self.values) >= _SAMPLES_KEPT:
                del self.values[1::2]
                self.stride *= 2
        self.seen += 1

    def median(self) -> float | None:
        """Median of the sample; None if it is empty."""
        return float(np.median(self.values)) if self.values else None


@dataclass(slots=True)
class ReadReport:
    """The report of one pass over a log; its size is limited, even for a long or damaged log.

    Attributes
    ----------
    line_count
        Number of lines (or records) read.
    records
        Accepted records by their type in the file.
    beside
        Auxiliary records of sensors: mountings, lenses, and images that are combined to frames.
    part_of
        The sensor to which such records belong, by the keys of ``beside``; they are used if it is used.
    ignored
        Records that this reader does not use, by topic or type.
    reasons
        Why they are not used, by the keys of ``ignored``.
    dropped
        Rejected records by reason.
    notes
        Anomalies that did not stop the reader, by text.
    backward_steps
        By sensor: stamps earlier than the previous one; ``largest`` in seconds. Nothing is dropped.
    odometry_jumps
        Odometry steps that are too fast for a robot; ``largest`` in metres.
    share
        Fraction of the log that has been read, 0..1; None if unknown.
    """

    line_count: int = 0
    share: float | None = None
    records: Counter[str] = field(default_factory=Counter)
    beside: Counter[str] = field(default_factory=Counter)
    part_of: dict[str, str] = field(default_factory=dict)
    ignored: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, Tally] = field(default_factory=dict)
    notes: dict[str, Tally] = field(default_factory=dict)
    backward_steps: dict[str, Tally] = field(default_factory=dict)
    odometry_jumps: Tally = field(default_factory=Tally)
    measurement_count: int = 0
    _last_stamp_s: dict[str, float] = field(default_factory=dict, repr=False)
    _last_odometry: WheelOdometry | None = field(default=None, repr=False)

    @property
    def dropped_count(self) -> int:
        """Number of rejected records."""
        return sum(tally.count for tally in self.dropped.values())

    @property
    def refusals(self) -> str:
        """How many records were rejected, and why."""
        return "; ".join(
            f"{tally.count} x {reason}, first at record {tally.lines[0]}"
            for reason, tally in self.dropped.items()
        )

    @property
    def warnings(self) -> list[str]:
        """The notes that a user should see before trusting a map."""
        texts = [note.removeprefix(WARNING) for note in self.notes if note.startswith(WARNING)]
        back_s = {name: tally.largest for name, tally in self.backward_steps.items() if tally.largest > GAP_S}
        if back_s:
            texts.append(f"stamps of {', '.join(back_s)} go back by up to {max(back_s.values()):.1f} s")
        return sorted([*texts, *(reason for reason in self.dropped if reason.endswith(READ_TO_THERE))])

    def accept(self, kind: str) -> None:
        """Count an accepted record."""
        self.records[kind] += 1

    def ignore(self, kind: str, why: str, count: int = 1) -> None:
        """Count records of a topic or type that is not used."""
        key = kind if kind in self.ignored or len(self.ignored) < MOST_TOPICS else _OTHER
        self.ignored[key] += count
        self.reasons[key] = why if key == kind else "too many names to list"

    def drop(self, reason: str, line: int) -> None:
        """Count a rejected record."""
        _tally(self.dropped, reason).add(line)

    def note(self, text: str, line: int, size: float = 0.0) -> None:
        """Count an anomaly of a record that is still used."""
        _tally(self.notes, text).add(line, size)

    def note_share(self, share: float) -> None:
        """Store the fraction of the log that has been read, 0..1."""
        self.share = share

    def observe(self, measurement: Measurement, line: int) -> None:
        """Check one measurement, in the order of the log, for clock steps and odometry jumps."""
        self.measurement_count += 1
        stamp_s = measurement.stamp_s
        previous_s = self._last_stamp_s.get(measurement.sensor, stamp_s)
        if stamp_s < previous_s:
            _tally(self.backward_steps, measurement.sensor).add(line, previous_s - stamp_s)
        self._last_stamp_s[measurement.sensor] = stamp_s
        if isinstance(measurement, WheelOdometry):
            if self._last_odometry is not None:
                self._check_jump(self._last_odometry, measurement, line)
            self._last_odometry = measurement

    def _check_jump(self, before: WheelOdometry, after: WheelOdometry, line: int) -> None:
        """Count a step that is too large for the time between two readings."""
        a, b = before.T_odom_base, after.T_odom_base
        elapsed_s = max(after.stamp_s - before.stamp_s, 0.0)
        distance_m = math.hypot(b.x() - a.x(), b.y() - a.y())
        turn_rad = abs(math.remainder(b.theta() - a.theta(), 2.0 * math.pi))
        too_far = distance_m > JUMP_SLACK_M + JUMP_SPEED_M_S * elapsed_s
        if too_far or turn_rad > JUMP_SLACK_RAD + JUMP_TURN_RAD_S * elapsed_s:
            self.odometry_jumps.add(line, distance_m)


def _tally(tallies: dict[str, Tally], key: str) -> Tally:
    """The tally of a key, or the shared one once there are too many keys."""
    if key not in tallies and len(tallies) >= _KEYS_KEPT:
        key = _OTHER
    return tallies.setdefault(key, Tally())


class Dataset(Protocol):
    """A log that can be read repeatedly from its start.

    Iteration returns the measurements in file order, which may differ from the order of the stamps, and
    raises `slam.errors.DatasetError` at the end of a log without any. Each new iteration starts a new
    `report`; it is complete when the iteration is.
    """

    name: str
    path: Path
    report: ReadReport

    def __iter__(self) -> Iterator[Measurement]:
        """Read the log from its start."""
        ...

    def groundtruth(self) -> Trajectory | None:
        """The ground truth trajectory of the log, None if there is none."""
        ...
