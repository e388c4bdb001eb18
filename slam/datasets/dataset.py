"""What every reader hands on: a stream of measurements and an honest account of the reading."""

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

# Above these a pair of odometry readings is a jump of the counter, not a drive of the robot: an indoor
# robot stays below 3 m/s, and the slack covers pairs whose stamps coincide or run backward.
JUMP_SPEED_M_S = 3.0
JUMP_SLACK_M = 0.3
JUMP_TURN_RAD_S = math.pi
JUMP_SLACK_RAD = 0.5

STAMP_LIMIT_S = 1e11  # year 5138; milliseconds or ticks by mistake are beyond it
_SAMPLES_KEPT = 4096  # numbers kept for a median
_LINES_KEPT = 3  # examples kept of each kind of event
MOST_TOPICS = 2000  # a robot has some dozens; damaged names must not fill the memory
_KEYS_KEPT = 32  # kinds of event; the rest share one key, so that garbage cannot grow the report
_OTHER = "(others)"
READ_TO_THERE = "read up to there"  # ends the reason of a damage that ended the reading
WARNING = "warning: "  # begins a note that is one


class RecordFault(Exception):
    """A record that cannot be used; readers turn it into a counted drop, or stop under ``--strict``.

    Parameters
    ----------
    reason
        One of few fixed texts, the key of the count.
    detail
        The values at fault, for the message of a strict run.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(plain(f"{reason}: {detail}"))
        self.reason = reason
        self.detail = detail


@dataclass(slots=True)
class Tally:
    """How often something happened, where first, and how large it was at most."""

    count: int = 0
    lines: list[int] = field(default_factory=list)
    largest: float = 0.0

    def add(self, line: int, size: float = 0.0) -> None:
        """Count one more, seen at a 1-based record or line number."""
        self.count += 1
        self.largest = max(self.largest, size)
        if len(self.lines) < _LINES_KEPT:
            self.lines.append(line)


@dataclass(slots=True)
class Thinned:
    """An even sample of a stream of numbers, of bounded size and the same on every run."""

    values: list[float] = field(default_factory=list)
    stride: int = 1
    seen: int = 0

    def add(self, value: float) -> None:
        """Take the next number."""
        if self.seen % self.stride == 0:
            self.values.append(value)
            if len(self.values) >= _SAMPLES_KEPT:
                del self.values[1::2]
                self.stride *= 2
        self.seen += 1

    def median(self) -> float | None:
        """Of the sample; None where there is none."""
        return float(np.median(self.values)) if self.values else None


@dataclass(slots=True)
class ReadReport:
    """What one pass over a log found; it stays small however long or damaged the log is.

    Attributes
    ----------
    line_count
        Lines (or records) looked at.
    records
        Accepted records by their type in the file.
    beside
        Records that tell of sensors: mountings, lenses, the images that make a camera's frames.
    part_of
        The sensor that such records are a part of, by the keys of ``beside``: they are used if it is.
    ignored
        Records that this reader does not use, by topic or type.
    reasons
        Why it does not, by the keys of ``ignored``.
    dropped
        Refused records by reason.
    notes
        Oddities that the reader lived with, by text.
    backward_steps
        By sensor: stamps earlier than the one before them; ``largest`` in seconds. Nothing is dropped.
    odometry_jumps
        Odometry steps faster than any robot; ``largest`` in metres.
    share
        Of the log that has been read, 0..1; None where the reader cannot tell.
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
        """Refused records, all reasons."""
        return sum(tally.count for tally in self.dropped.values())

    @property
    def refusals(self) -> str:
        """How many records were refused, and why."""
        return "; ".join(
            f"{tally.count} x {reason}, first at record {tally.lines[0]}"
            for reason, tally in self.dropped.items()
        )

    @property
    def warnings(self) -> list[str]:
        """The notes that a person should see before trusting a map."""
        found = [note.removeprefix(WARNING) for note in self.notes if note.startswith(WARNING)]
        back_s = {name: tally.largest for name, tally in self.backward_steps.items() if tally.largest > GAP_S}
        if back_s:
            found.append(f"stamps of {', '.join(back_s)} go back by up to {max(back_s.values()):.1f} s")
        return sorted([*found, *(reason for reason in self.dropped if reason.endswith(READ_TO_THERE))])

    def accept(self, kind: str) -> None:
        """Count an accepted record."""
        self.records[kind] += 1

    def ignore(self, kind: str, why: str, count: int = 1) -> None:
        """Count records of a topic or type that is not used."""
        key = kind if kind in self.ignored or len(self.ignored) < MOST_TOPICS else _OTHER
        self.ignored[key] += count
        self.reasons[key] = why if key == kind else "too many names to list"

    def drop(self, reason: str, line: int) -> None:
        """Count a refused record."""
        _tally(self.dropped, reason).add(line)

    def note(self, text: str, line: int, size: float = 0.0) -> None:
        """Count an oddity that did not cost the record."""
        _tally(self.notes, text).add(line, size)

    def note_share(self, share: float) -> None:
        """Take down how much of the log has been read, 0..1."""
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
        """Count a step that no robot drives in the time between two readings."""
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
    """A log that can be read from its beginning any number of times.

    Iteration gives the measurements in the order of the file, which need not be the order of the
    stamps, and raises `slam.errors.DatasetError` at the end of a log without any. Each new
    iteration starts a new `report`; it is complete when the iteration is.

    Attributes
    ----------
    name
        Short name for people.
    path
        Where the log lies.
    report
        What the latest pass found.
    """

    name: str
    path: Path
    report: ReadReport

    def __iter__(self) -> Iterator[Measurement]:
        """Read the log from its beginning."""
        ...

    def groundtruth(self) -> Trajectory | None:
        """The true trajectory that comes with the log, None where none does."""
        ...
