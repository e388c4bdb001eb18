"""Keyframe clouds of a 3D lidar in ``map.db``; each is read when it is needed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import cast

import gtsam
import numpy as np

from slam.errors import MapFileError
from slam.mapping.sensor_packing import packed_cloud, unpacked_cloud
from slam.measurements import Float32Array, FloatArray
from slam.storage.map_edits import mask_of
from slam.storage.map_file import MapFile
from slam.storage.map_soundness import of, require, sound_stamp
from slam.storage.map_tables import CLOUDS, Value
from slam.storage.packing import FARTHEST_M, pack, unpack


class MapClouds:
    """The clouds of a map, one per node of its graph.

    Parameters
    ----------
    begun
        Whether the map is being written: clouds of an interrupted run are visible only after they are added
        again, without cost.
    erased
        Packed bits of the points removed by edits, by keyframe.
    """

    def __init__(
        self, file: MapFile, *, begun: bool = False, erased: Mapping[int, bytes] | None = None
    ) -> None:
        self._file, self._erased = file, erased or {}
        self._count = 0 if begun else file.count(CLOUDS)
        # Points, stamp and lidar of a keyframe are read one after the other.
        self._newest: tuple[int, tuple[Value, ...]] = (-1, ())
        self._verified = set[int]()  # rows with a verified checksum: they are read several times

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[FloatArray]:
        """Yield the points of every keyframe, one in memory at a time."""
        return (self.points(key) for key in range(len(self)))

    def add(self, stamp_s: float, rows: FloatArray, T_base_lidar: gtsam.Pose3) -> int:
        """Write points (N, 3) of the next keyframe, base frame, or (N, 4) with intensities; return its index.

        Raises
        ------
        ScanweaveError
            If a point is not finite, the map cannot be written, or an interrupted run had another cloud
            here.
        """
        key = self._count
        self._count += 1
        if key < self._file.count(CLOUDS):
            known_s = cast(float, self._row(key)[0])
            if known_s != stamp_s:
                raise MapFileError(
                    f"{self._file.path} cannot be resumed: it has a cloud at {known_s:.6f} s where one at "
                    f"{stamp_s:.6f} s comes; map anew, without --resume"
                )
            return key
        return self._file.append(CLOUDS, stamp_s, pack(T_base_lidar), packed_cloud(rows))

    def points(self, key: int, *, everything: bool = False) -> FloatArray:
        """Return the points (N, 3) of a keyframe, base frame; those removed by edits only if requested.

        Raises
        ------
        IndexError
            If there is no such keyframe.
        MapFileError
            If its row is damaged.
        """
        return self.rows(key, everything=everything, intensities=False)

    def intensities(self, key: int, *, everything: bool = False) -> Float32Array | None:
        """Return (N,) intensities of the points, in the sensor's own steps; None if its log has none."""
        rows = self.rows(key, everything=everything)
        return rows[:, 3].astype(np.float32) if rows.shape[1] > 3 else None

    def rows(self, key: int, *, everything: bool = False, intensities: bool = True) -> FloatArray:
        """Return `points`, with `intensities` as a fourth column if present and requested."""
        content = self._row(key)[2]
        with self._file.naming_row(CLOUDS, key):
            rows = unpacked_cloud(cast(bytes, content), intensities=intensities)
            require(np.abs(rows[:, :3]).max(initial=0.0) < FARTHEST_M, "a point is beyond the Earth")
            if not everything and key in self._erased:
                rows = rows[~mask_of(self._erased[key], len(rows))]
        return rows

    def without(self, erased: Mapping[int, bytes]) -> MapClouds:
        """Return the same clouds with other points removed."""
        return MapClouds(self._file, erased=erased)

    def stamp_s(self, key: int) -> float:
        """Return the stamp of a keyframe's cloud; errors as in `points`."""
        with self._file.naming_row(CLOUDS, key):
            return sound_stamp(self._row(key)[0])

    def T_base_lidar(self, key: int) -> gtsam.Pose3:
        """Return the pose of the lidar on the robot; errors as in `points`."""
        with self._file.naming_row(CLOUDS, key):
            stamp_s, lidar, _ = self._row(key)
            sound_stamp(stamp_s)
            return of(gtsam.Pose3, unpack(cast(bytes, lidar)))

    def digest(self, key: int) -> bytes:
        """Return the digest of a keyframe's row, time and points; errors as in `points`."""
        return hashlib.blake2b(repr(self._row(key)).encode(), digest_size=16).digest()

    def copy_to(self, file: MapFile, most: int | None = None) -> None:
        """Copy clouds, or the first ones, to another map unchanged.

        Raises
        ------
        MapFileError
            If a row is damaged, or the other map cannot be written.
        """
        for key in range(len(self))[:most]:
            file.append(CLOUDS, *self._row(key))

    def _row(self, key: int) -> tuple[Value, ...]:
        """Return the values of a row."""
        if not 0 <= key < len(self):
            raise IndexError(f"cloud {key} of {len(self)}")
        if key != self._newest[0]:
            self._newest = key, self._file.row(CLOUDS, key, again=key in self._verified)
            self._verified.add(key)
        return self._newest[1]
