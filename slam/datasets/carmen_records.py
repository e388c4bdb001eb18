"""Parses one CARMEN line to one record, independent of earlier lines.

Grammar (all tokens are separated by blanks; angles in radians, lengths in metres, stamps in seconds)::

    ODOM x y theta tv rv accel <tail>
    FLASER | RLASER  n r1..rn laser(x y theta) robot(x y theta) <tail>
    ROBOTLASERk type start fov resolution max accuracy remission_mode n r1..rn m rem1..remm
                laser(x y theta) robot(x y theta) tv rv forward_safety side_safety turn_axis <tail>
    RAWLASERk   type start fov resolution max accuracy remission_mode n r1..rn m rem1..remm <tail>
    PARAM name value ...
    <tail> = ipc_stamp host logger_stamp
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fusion.kernel import ZERO, kernel
from slam.datasets.dataset import STAMP_LIMIT_S, RecordFault
from slam.measurements import FloatArray

WRONG_COUNT = "wrong number of values"
NOT_A_NUMBER = "not a number where one is expected"
BAD_POSE = "pose not finite or beyond any robot's reach"
BAD_STAMP = "stamp not finite or beyond any clock"
BAD_GEOMETRY = "beam angles not finite"

Row: TypeAlias = tuple[float, float, float]

_POSITION_LIMIT_M = 1e6
_YAW_LIMIT_RAD = 1e6  # some counters never wrap
# Integers and powers of ten up to these are exact as floats.
_EXACT, _MOST_DIGITS = 2**53, 18
# All three are required: if some were optional, a wrong count could shift poses and stamp unnoticed.
_TAIL = 3


@dataclass(frozen=True, slots=True)
class OdometryRecord:
    """The robot's pose by wheel odometry: x, y, yaw."""

    stamp_s: float
    robot: Row


@dataclass(frozen=True, slots=True)
class LaserRecord:
    """A scan line as written; None for fields that this type of line does not have."""

    kind: str
    stamp_s: float
    ranges_m: FloatArray
    laser: Row | None
    robot: Row | None
    start_rad: float | None = None
    fov_rad: float | None = None
    step_rad: float | None = None
    max_m: float | None = None


def parse_odometry(tokens: list[bytes]) -> OdometryRecord:
    """Parse an ODOM line; RecordFault if its numbers are too few, too many or not finite."""
    _check_tail(tokens, 7)
    values = _numbers(tokens[1:8])
    return OdometryRecord(_stamp(values[6]), finite_row(values[0:3]))


def parse_plain_laser(tokens: list[bytes]) -> LaserRecord:
    """Parse FLASER or RLASER: ranges and poses, no angles; RecordFault if a number is no finite one."""
    count = _count(tokens, 1)
    _check_tail(tokens, 2 + count + 6)
    values = _numbers(tokens[2 : count + 9])
    laser, robot = values[count : count + 3], values[count + 3 : count + 6]
    return LaserRecord(
        kind=tokens[0].decode(),
        stamp_s=_stamp(values[count + 6]),
        ranges_m=values[:count],
        laser=finite_row(laser),
        robot=finite_row(robot),
    )


def parse_configured_laser(tokens: list[bytes]) -> LaserRecord:
    """A ROBOTLASERk or RAWLASERk line: angles, ranges, remissions, and poses for the former.

    Raises
    ------
    RecordFault
        Wrong count, not a number, pose, stamp or angles not finite.
    """
    kind = tokens[0].decode()
    count = _count(tokens, 8)
    remission_at = 9 + count
    after = remission_at + 1 + _count(tokens, remission_at)
    pose_fields = 11 if kind.startswith("ROBOTLASER") else 0
    _check_tail(tokens, after + pose_fields)
    start_rad, fov_rad, step_rad, max_m = _numbers(tokens[2:6]).tolist()
    if not all(map(math.isfinite, (start_rad, fov_rad, step_rad))):
        raise RecordFault(BAD_GEOMETRY, f"start {start_rad}, field of view {fov_rad}, step {step_rad}")
    tail = _numbers(tokens[after : after + pose_fields + 1])
    ranges_m = _numbers(tokens[9:remission_at])
    if step_rad < 0.0:  # the beams are clockwise
        start_rad, step_rad, ranges_m = start_rad + step_rad * (count - 1), -step_rad, ranges_m[::-1].copy()
    return LaserRecord(
        kind=kind,
        stamp_s=_stamp(tail[pose_fields]),
        ranges_m=ranges_m,
        laser=finite_row(tail[0:3]) if pose_fields else None,
        robot=finite_row(tail[3:6]) if pose_fields else None,
        start_rad=start_rad,
        fov_rad=fov_rad,
        step_rad=step_rad,
        max_m=max_m,
    )


def parse_parameter(tokens: list[bytes]) -> tuple[str, str]:
    """Name and value of a PARAM line, the name in the same spelling for all logs.

    Logs write ``robot_front_laser_max`` but ``robot_frontlaser_offset``, and put the field of view
    under ``laser_``: the module's prefix and the underscores are dropped (``frontlasermax``).

    Raises
    ------
    RecordFault
        Name or value missing.
    """
    if len(tokens) < 3:
        raise RecordFault(WRONG_COUNT, "PARAM without a value")
    name = tokens[1].decode("ascii", "replace").lower()
    for module in ("robot_", "laser_"):
        name = name.removeprefix(module)
    return name.replace("_", ""), tokens[2].decode("ascii", "replace")


def _count(tokens: list[bytes], index: int) -> int:
    """A count of values, checked against the number of values that follow before memory is allocated."""
    if index >= len(tokens):
        raise RecordFault(WRONG_COUNT, f"line ends before value {index}")
    token = tokens[index]
    if not token.isdigit() or len(token) > 9:
        raise RecordFault(WRONG_COUNT, f"count {_shown(token)}")
    count = int(token)
    if count >= len(tokens) - index:
        raise RecordFault(WRONG_COUNT, f"{count} announced, {len(tokens) - index - 1} values follow")
    return count


def _check_tail(tokens: list[bytes], stamp_at: int) -> None:
    """Reject a line that does not end with stamp, host and logger stamp."""
    if len(tokens) != stamp_at + _TAIL:
        raise RecordFault(WRONG_COUNT, f"{len(tokens)} values, {stamp_at + _TAIL} expected")


def _numbers(tokens: list[bytes]) -> FloatArray:
    """The tokens as floats (N,); underscores, which Python allows between digits, are rejected."""
    values, text = np.empty(len(tokens)), b" ".join(tokens)
    if _plain_numbers(np.frombuffer(text, np.uint8), values) == len(tokens):
        return values
    for at, token in enumerate(tokens):
        try:
            values[at] = float(token.replace(b"_", b"?"))
        except ValueError:
            raise RecordFault(NOT_A_NUMBER, _shown(token)) from None
    return values


@kernel
def _plain_numbers(text, values):  # type: ignore[no-untyped-def]
    """Read numbers separated by blanks, bit-identical to ``float``; returns how many, up to a complex one.

    A simple number has a sign, digits and a point and is an exact integer over an exact power of ten: then
    one division rounds correctly (Clinger 1990).
    """
    count = ZERO
    mantissa = ZERO
    scale, sign = 1.0, 1.0
    digits, begun, point = 0, True, False
    for i in range(text.size + 1):
        letter = text[i] if i < text.size else 32
        if 48 <= letter <= 57:
            mantissa = 10 * mantissa + (letter - 48)
            digits += 1
            begun = False
            if point:
                scale *= 10.0
            if mantissa > _EXACT or digits > _MOST_DIGITS:
                break
        elif letter == 46 and not point:
            point, begun = True, False
        elif letter == 45 and begun:
            sign, begun = -1.0, False
        elif letter == 32 and digits > 0:
            values[count] = sign * mantissa / scale
            count += 1
            mantissa = ZERO
            scale, sign = 1.0, 1.0
            digits, begun, point = 0, True, False
        else:
            break
    return count


def finite_row(values: FloatArray) -> Row:
    """A pose (3,), finite and within limits."""
    x, y, yaw = values.tolist()
    # The comparisons are false for NaN, so NaN is rejected too.
    if not (abs(x) < _POSITION_LIMIT_M and abs(y) < _POSITION_LIMIT_M and abs(yaw) < _YAW_LIMIT_RAD):
        raise RecordFault(BAD_POSE, f"{x} {y} {yaw}")
    return x, y, yaw


def _stamp(stamp_s: float) -> float:
    """A stamp, finite and below the limit."""
    stamp_s = float(stamp_s)
    if not abs(stamp_s) < STAMP_LIMIT_S:
        raise RecordFault(BAD_STAMP, f"{stamp_s}")
    return stamp_s


def _shown(token: bytes) -> str:
    """A token for a message, short and printable."""
    return repr(token[:24].decode("ascii", "backslashreplace"))
