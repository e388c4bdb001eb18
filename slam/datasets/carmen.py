"""The CARMEN log reader (.log, .clf, plain or gzip): one streaming pass in file order."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.carmen_records import (
    NOT_A_NUMBER,
    LaserRecord,
    OdometryRecord,
    parse_configured_laser,
    parse_odometry,
    parse_parameter,
    parse_plain_laser,
)
from slam.datasets.dataset import ReadReport, RecordFault
from slam.datasets.laser_geometry import (
    DEFAULT_NO_RETURN_M,
    NO_VALID_RANGE,
    SICK_LARGEST_CODE_FREE_M,
    ZERO_BEAMS,
    BeamLayout,
    RepeatedRange,
    beam_layout,
    classify_ranges,
)
from slam.datasets.log_file import numbered_lines, read_head
from slam.datasets.recording import Contents, Numbered, Recording
from slam.foreign import plain
from slam.measurements import LaserScan, Measurement, WheelOdometry, pose2_from_row

HEAD_BYTES = 1 << 18  # enough for a full block of parameters and some scans
_MESSAGE_NAME = re.compile(rb"[A-Za-z][A-Za-z0-9_]{1,31}")
_HEAD_MESSAGE = re.compile(rb"^[ \t]*([A-Z]+[0-9]?)[ \t]", re.MULTILINE)

# A scan may be logged in several types of record; the first common one is read, the others are ignored.
_SAME_LASER = (
    ("ROBOTLASER1", "FLASER", "RAWLASER1"),
    ("ROBOTLASER2", "RLASER", "RAWLASER2"),
    ("ROBOTLASER3", "RAWLASER3"),
    ("ROBOTLASER4", "RAWLASER4"),
)
_REAR = frozenset(_SAME_LASER[1])
_PARSERS: dict[str, Callable[[list[bytes]], LaserRecord]] = {
    kind: parse_plain_laser if kind in ("FLASER", "RLASER") else parse_configured_laser
    for group in _SAME_LASER
    for kind in group
}
_KNOWN = frozenset({*_PARSERS, "ODOM", "PARAM", "SYNC", "TRUEPOS"})

TRUNCATED = "truncated last line"
NO_MESSAGE = "line does not begin with a message name"

_SAME_POSE = 1e-6  # the last digit in the logs
_MOUNT_REACH_M = 3.0  # maximum distance of a laser from the robot's centre
_MOUNT_TOLERANCE = 0.02  # metres and radians: rounding and interpolation in the logged poses


def looks_like_carmen(path: Path, head: bytes) -> bool:
    """Whether a file's first bytes contain CARMEN messages, or only its name indicates them."""
    if any(match.decode() in _KNOWN for match in _HEAD_MESSAGE.findall(head)):
        return True
    suffixes = {suffix.lower() for suffix in path.suffixes[-2:]}
    only_comments = all(not line.strip() or line.startswith(b"#") for line in head.splitlines())
    return bool(suffixes & {".log", ".clf"}) and only_comments


def open_carmen(path: Path, strict: bool) -> Recording:
    """A CARMEN log as a stream of odometry and scans; its poses are the robot's estimates, not ground truth.

    Every ODOM line gives one `WheelOdometry`; so does the robot pose in a scan line, unless it repeats the
    previous reading (same stamp and pose). The scan follows its odometry. The stamp is the ipc stamp. The
    order is that of the file: stamps may run backward, which is counted but not corrected.
    """
    remedy = "expected are CARMEN messages FLASER, ROBOTLASER1 or ODOM"
    dataset = Recording(
        path,
        lambda account: Contents(log=read_carmen(path, account)),
        lambda _: None,
        strict=strict,
        remedy=remedy,
    )
    dataset.name = plain(path.name).removesuffix(".gz").removesuffix(".log").removesuffix(".clf")
    return dataset


def read_carmen(path: Path, account: Account) -> Iterator[Numbered]:
    """Line numbers and measurements of a log."""
    lines = numbered_lines(path, account, account.report.note_share)
    kinds = _preferred_kinds(read_head(path, HEAD_BYTES))
    return read_messages(lines, lambda line: (line.split(),), path.name, account, kinds)


def read_messages(
    lines: Iterable[tuple[int, bytes]],
    words: Callable[[bytes], Iterable[list[bytes]]],
    where: str,
    account: Account,
    kinds: frozenset[str] = frozenset(("RAWLASER1",)),
) -> Iterator[Numbered]:
    """Measurements of numbered lines that are equivalent to CARMEN messages.

    Parameters
    ----------
    words
        Converts a line to CARMEN messages; raises `RecordFault` if it is damaged.
    kinds
        The types of scan messages that are read.
    """
    decoder = _Decoder(account.report, kinds)
    last = 0
    for number, line in lines:
        account.report.line_count += max(number - last, 0)
        last = number
        try:
            for message in words(line):
                for measurement in decoder.decode(message, number):
                    yield number, measurement
        except RecordFault as fault:
            is_complete = line.endswith(b"\n")
            account.refuse(fault if is_complete else RecordFault(TRUNCATED, str(fault)), where, number)


class _Decoder:
    """The state of one pass: parameters, laser poses, the last odometry."""

    def __init__(self, report: ReadReport, preferred: frozenset[str]) -> None:
        self._report = report
        self._preferred = preferred
        self._parameters: dict[str, float] = {}
        self._mounts: dict[str, gtsam.Pose2] = {}
        self._repeated = defaultdict[str, RepeatedRange](RepeatedRange)
        self._last_odometry: OdometryRecord | None = None

    def decode(self, tokens: list[bytes], number: int) -> Iterator[Measurement]:
        """Return the measurements of a line, odometry first; RecordFault at the end of a damaged one."""
        if not tokens or tokens[0].startswith(b"#"):
            return
        if not _MESSAGE_NAME.fullmatch(tokens[0]):
            raise RecordFault(NO_MESSAGE, repr(tokens[0][:24]))
        kind = tokens[0].decode()
        if kind == "ODOM":
            record = parse_odometry(tokens)
            self._report.accept(kind)
            yield from self._odometry(record, with_scan=False)
        elif kind == "PARAM":
            self._set_parameter(*parse_parameter(tokens), number)
            self._report.accept(kind)
        elif kind in self._preferred:
            laser = _PARSERS[kind](tokens)
            if laser.robot is not None:
                yield from self._odometry(OdometryRecord(laser.stamp_s, laser.robot), with_scan=True)
            scan = self._scan(laser, number)
            self._report.accept(kind)
            yield scan
        else:
            twin = kind in _PARSERS and "the log holds the same scans in another type of record"
            self._report.ignore(kind, twin or f"records of type {kind} are not read")

    def _odometry(self, record: OdometryRecord, *, with_scan: bool) -> Iterator[WheelOdometry]:
        """The reading; none for a scan line that only repeats the previous one."""
        last, self._last_odometry = self._last_odometry, record
        if with_scan and last is not None and last.stamp_s == record.stamp_s:
            moved = max(abs(a - b) for a, b in zip(last.robot, record.robot, strict=True))
            if moved <= _SAME_POSE:
                return
        yield WheelOdometry(record.stamp_s, pose2_from_row(record.robot))

    def _scan(self, record: LaserRecord, number: int) -> LaserScan:
        """A scan with its angles, laser pose and maximum range."""
        if record.ranges_m.size == 0:
            raise RecordFault(ZERO_BEAMS, record.kind)
        layout = self._layout(record, number)
        stated_m = record.max_m or self._parameter(record.kind, "max") or 0.0
        limit_m = min(stated_m, SICK_LARGEST_CODE_FREE_M) if stated_m > 0.0 else DEFAULT_NO_RETURN_M
        ranges_m, limit_m = classify_ranges(record.ranges_m, limit_m, self._repeated[record.kind])
        invalid = int(np.count_nonzero(np.isnan(ranges_m)))
        if invalid == ranges_m.size:
            raise RecordFault(NO_VALID_RANGE, f"{invalid} beams")
        return LaserScan(
            stamp_s=record.stamp_s,
            ranges_m=ranges_m,
            start_angle_rad=layout.start_rad,
            step_rad=layout.step_rad,
            range_max_m=limit_m,
            T_base_laser=self._mount(record, number),
            sensor=record.kind,
        )

    def _layout(self, record: LaserRecord, number: int) -> BeamLayout:
        """The bearings of the beams: from the line if it has them, else from the beam count and PARAM."""
        count = record.ranges_m.size
        if record.start_rad is None:
            fov, step = self._parameter(record.kind, "fov"), self._parameter(record.kind, "resolution")
            # No lidar has a field of view below 2 pi degrees, so such values are radians.
            unit_rad = 1.0 if (fov or (step or 0.0) * count) <= 2.0 * math.pi else math.radians(1.0)
            layout = beam_layout(count, fov and fov * unit_rad, step and step * unit_rad)
        else:
            layout = beam_layout(count, record.fov_rad, record.step_rad)
            if not layout.contradiction and abs(record.start_rad) <= 2.0 * math.pi:
                layout = BeamLayout(record.start_rad, layout.step_rad)
        if layout.contradiction:
            text = f"{record.kind}: the stated field of view and resolution do not fit {count} beams"
            self._report.note(f"{text}; the beam count was used", number)
        return layout

    def _mount(self, record: LaserRecord, number: int) -> gtsam.Pose2:
        """Pose of the laser, found once per sensor: from PARAM or from the logged poses."""
        from_line = None
        if record.robot is not None and record.laser is not None:
            from_line = pose2_from_row(record.robot).between(pose2_from_row(record.laser))
        if record.kind not in self._mounts:
            mount = self._parameter_mount(record.kind)
            # FLASER lines may contain a corrected laser pose, so only PARAM is used for them.
            if (
                record.start_rad is not None
                and from_line is not None
                and math.hypot(*from_line.translation()) <= _MOUNT_REACH_M
            ):
                mount = from_line
            self._mounts[record.kind] = mount
        mount = self._mounts[record.kind]
        if from_line is not None and not from_line.equals(mount, _MOUNT_TOLERANCE):
            text = "laser pose of the line does not fit the mount in use (corrected poses?); mount kept"
            self._report.note(
                f"{record.kind}: {text}", number, math.hypot(*mount.between(from_line).translation())
            )
        return mount

    def _parameter_mount(self, kind: str) -> gtsam.Pose2:
        """The pose by PARAM; a rear laser points backward, even if the log does not say so."""
        yaw_rad = self._parameter(kind, "angularoffset")
        if yaw_rad is None:
            yaw_rad = math.pi if kind in _REAR else 0.0
        return gtsam.Pose2(
            self._parameter(kind, "offset") or 0.0, self._parameter(kind, "sideoffset") or 0.0, yaw_rad
        )

    def _parameter(self, kind: str, name: str) -> float | None:
        """A PARAM of a laser, None if it is missing; lasers 3 and 4 have none."""
        if kind[-1] in "34":
            return None
        return self._parameters.get(("rearlaser" if kind in _REAR else "frontlaser") + name)

    def _set_parameter(self, name: str, value: str, number: int) -> None:
        """Store a PARAM of a laser."""
        if not name.startswith(("frontlaser", "rearlaser")) or name.endswith(("use", "id")):
            return
        try:
            number_value = float(value)
        except ValueError:
            number_value = math.nan
        if not math.isfinite(number_value):
            raise RecordFault(NOT_A_NUMBER, f"PARAM {name} {value!r}")
        self._parameters[name] = number_value
        if name.endswith("offset"):
            self._mounts.clear()


def _preferred_kinds(head: bytes) -> frozenset[str]:
    """The scan messages to read: one type of record per scan.

    A type must be at least half as frequent as the commonest one, so that a stray line has no influence.
    """
    present = Counter(match.decode() for match in _HEAD_MESSAGE.findall(head))
    preferred: set[str] = set()
    for group in _SAME_LASER:
        most = max(present[kind] for kind in group)
        frequent = [kind for kind in group if present[kind] and 2 * present[kind] >= most]
        preferred.update(frequent[:1] or group)
    return frozenset(preferred)
