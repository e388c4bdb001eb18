"""Logs of Player's writelog driver, versions 1 to 3: wheel odometry and one 2D lidar.

A line is a message: time, device, data of its interface (Player manual: writelog, laser, position2d).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.carmen import read_messages
from slam.datasets.carmen_records import WRONG_COUNT
from slam.datasets.dataset import ReadReport, RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.log_file import numbered_lines
from slam.datasets.recording import Contents

_HEAD, _OLD = b"## Player version", b"## File version 0.1"
_DATA, _GEOMETRY = (b"001",), (b"004", b"001")
# Number of fields before the ranges, and index of the first angle: by version, and with a pose.
_BEFORE_RANGES = {6: 1, 9: 4, 5: 0, 4: 0}
_PARAMETERS = (b"frontlaser_offset", b"frontlaser_sideoffset", b"frontlaser_angularoffset")


def _load(path: Path, account: Account) -> Contents:
    """A log; its poses are the robot's own estimates."""
    lines = numbered_lines(path, account, account.report.note_share)
    return Contents(log=read_messages(lines, _Words(account.report).of, path.name, account))


class _Words:
    """Converts lines to CARMEN messages; of several lidars, the first that appears is read."""

    def __init__(self, report: ReadReport) -> None:
        self._report = report
        self._old = False
        self._lidar = b""

    def of(self, line: bytes) -> Iterator[list[bytes]]:
        """The CARMEN messages of a line."""
        if line.startswith(b"#"):
            self._old = self._old or line.startswith(_OLD)
            return
        fields = line.split()
        if not fields:
            return
        if len(fields) < 7:
            raise RecordFault(WRONG_COUNT, f"{len(fields)} values")
        interface, index = fields[3:5]
        stamp, kind, data = fields[0], tuple(fields[5:7]), fields[7:]
        if self._old:
            stamp, kind, data = fields[5], _DATA, fields[6:]
        if interface in (b"position", b"position2d") and kind[:1] == _DATA:
            if len(data) != 7:
                raise RecordFault(WRONG_COUNT, f"{len(data)} values of a position")
            yield [b"ODOM", *data[:3], b"0", b"0", b"0", stamp, b"player", stamp]
        elif interface == b"laser" and kind[:1] == _DATA and index == (self._lidar or index):
            self._lidar = index
            yield _scan(data, stamp)
        elif interface == b"laser" and kind == _GEOMETRY and index == (self._lidar or index):
            yield from ([b"PARAM", *pair] for pair in zip(_PARAMETERS, data, strict=False))
        elif interface != b"sync":
            other = f"{interface.decode('ascii', 'replace')} {index.decode('ascii', 'replace')}"
            self._report.ignore(other, "only wheels and one 2D lidar are read from a Player log")


def _scan(data: list[bytes], stamp: bytes) -> list[bytes]:
    """A scan; the number of ranges determines the fields before them."""
    for before, angles in _BEFORE_RANGES.items():
        count = data[before - 1] if before <= len(data) else b""
        if count.isdigit() and len(data) == before + 2 * int(count[:9]):
            first, last, step = data[angles : angles + 3]
            greatest = data[angles + 3] if before > 4 else b"0"
            try:
                span = repr(float(last) - float(first)).encode()
            except ValueError as error:
                raise RecordFault(WRONG_COUNT, str(error)) from error
            head = [b"RAWLASER1", b"0", first, span, step, greatest, b"0", b"0", count]
            return [*head, *data[before::2], b"0", stamp, b"player", stamp]
    raise RecordFault(WRONG_COUNT, f"{len(data)} values of a scan")


FORMAT = recorded("log of Player", lambda path, head: head.startswith(_HEAD), _load)
