"""Keyframe clouds of a whole run, on disk."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.measurements import Float32Array, FloatArray


class CloudKeyframes:
    """Points of keyframes in their base frames, one after another in a temporary file that goes with it.

    Memory holds three numbers a keyframe.
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

    def add(self, points: FloatArray) -> int:
        """Keep the points (N, 3) of the next keyframe; its number.

        Raises
        ------
        MapFileError
            Where there is no room for them.
        """
        rows: Float32Array = np.ascontiguousarray(points, dtype=np.float32)
        try:
            self._file.seek(self._end)
            self._file.write(rows.tobytes())
        except OSError as error:
            folder = Path(tempfile.gettempdir())
            raise MapFileError(
                f"cannot keep a cloud in {folder}: {error.strerror}; free some space, or set TMPDIR"
            ) from error
        self._places.append((self._end, len(rows)))
        self._end += rows.nbytes
        return len(self._places) - 1

    def points(self, key: int) -> FloatArray:
        """The points (N, 3) of a keyframe."""
        start, count = self._places[key]
        self._file.seek(start)
        rows = np.frombuffer(self._file.read(12 * count), dtype=np.float32)
        return rows.reshape(count, 3).astype(np.float64)
