"""The true contents of a sample recording, from its writer, and the list of all samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slam.measurements import CameraIntrinsics


@dataclass(frozen=True)
class CameraTruth:
    """A camera.

    Attributes
    ----------
    lens
        Of the depth image, or of what it is brought to.
    stamps_s
        Of its frames, on any clock: only steps are compared.
    poses
        (4, 4) of the depth image's optical frame in the room.
    mount
        Of that frame on the robot; None if the recording does not contain it.
    grey
        Whether colours are lost.
    """

    lens: CameraIntrinsics
    stamps_s: list[float]
    poses: list[Any]
    mount: Any = None
    grey: bool = False


@dataclass(frozen=True)
class CloudTruth:
    """A 3D lidar: stamps, (N, 3) points in its frame, seconds after the stamp or None, poses and mounting."""

    stamps_s: list[float]
    points: list[Any]
    times_s: list[Any] | None
    poses: list[Any]
    mount: Any = None
    apart_m: float = 1e-3


@dataclass(frozen=True)
class ScanTruth:
    """A flat lidar: stamps, ranges by bearing of the first scan, mounting (x, y, yaw)."""

    stamps_s: list[float]
    bearings_rad: Any
    ranges_m: list[Any]
    mount: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Sample:
    """A recording and what is true of it.

    Attributes
    ----------
    path
        What a user gives to the program.
    wheels
        How many readings at least; 0 for no wheels.
    imu
        Readings of turn rates and forces that must be read, 0 for none: stands still but for gravity.
    moved
        Sensor or robot poses for the true trajectory that goes with it; None where there is none.
    refused
        A pattern of what must be said where it cannot be mapped; empty where it can.
    mend
        Further words of the command that maps it, which the refusal must name.
    by_hand
        What a message must name (a command of another program, another thing to give), and what does it here;
        it returns what to give then, None where that is the same.
    """

    path: Path
    cameras: tuple[CameraTruth, ...] = ()
    cloud: CloudTruth | None = None
    scans: tuple[ScanTruth, ...] = ()
    wheels: int = 0
    imu: int = 0
    moved: list[Any] | None = None
    refused: str = ""
    mend: tuple[str, ...] = ()
    by_hand: tuple[str, Callable[[], Path | None]] | None = None


@dataclass(frozen=True)
class Layout:
    """How to write a sample: a name, the group that it is counted in, and whose words it follows."""

    name: str
    group: str
    source: str
    write: Callable[[Path], Sample] = field(repr=False)


LAYOUTS: dict[str, Layout] = {}


def layout(name: str, group: str, source: str) -> Callable[[Callable[[Path], Sample]], Any]:
    """Add a writer to the list."""

    def add(write: Callable[[Path], Sample]) -> Callable[[Path], Sample]:
        assert name not in LAYOUTS, name
        LAYOUTS[name] = Layout(name, group, source, write)
        return write

    return add
