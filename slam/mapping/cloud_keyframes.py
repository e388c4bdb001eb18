"""Keyframe clouds of a whole run, on disk where no map keeps them."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import gtsam

from slam.errors import MapFileError
from slam.mapping.cloud_packing import packed_cloud, unpacked_cloud
from slam.measurements import FloatArray


class CloudSpool(Protocol):
    """Where the clouds of keyframes lie while a log is mapped: in the map, or in a temporary file."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[FloatArray]: ...

    def add(self, stamp_s: float, points: FloatArray, T_base_lidar: gtsam.Pose3) -> int:
        """Keep the points (N, 3), base frame, of the next keyframe; its number."""
        ...

    def points(self, key: int) -> FloatArray:
        """The points (N, 3) of a keyframe, as exactly as they are packed."""
        ...


class CloudKeyframes:
    """Points of keyframes in their base frames, one after another in a temporary file that goes with it.

    Memory holds two numbers a keyframe.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="scanweave-clouds-")  # noqa: SIM115 - lives as long as this
        weakref.finalize(self, self._file.close)
        self._places: list[tuple[int, int]] = []
        self._end = 0

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[FloatArray]:
        return (self.points(key) for key in range(len(self)))

    def add(self, stamp_s: float, points: FloatArray, T_base_lidar: gtsam.Pose3) -> int:
        """Keep the points (N, 3), base frame, of the next keyframe; its number.

        Raises
        ------
        MapFileError
            Where there is no room for them.
        """
        content = packed_cloud(points)
        try:
            self._file.seek(self._end)
            self._file.write(content)
        except OSError as error:
            folder = Path(tempfile.gettempdir())
            raise MapFileError(
                f"cannot keep a cloud in {folder}: {error.strerror}; free some space, or set TMPDIR"
            ) from error
        self._places.append((self._end, len(content)))
        self._end += len(content)
        return len(self._places) - 1

    def points(self, key: int) -> FloatArray:
        """The points (N, 3) of a keyframe, as exactly as they are packed."""
        start, size = self._places[key]
        self._file.seek(start)
        return unpacked_cloud(self._file.read(size))
