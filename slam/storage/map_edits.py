"""Edits of a map in ``map.db``: in their order, and how the map was before.

The other tables contain the map with its edits. Rows that the edits changed are also stored here in their old
form: these, and all unchanged rows, are the unedited map.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, cast

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.graph.loop_candidate import LoopCandidate
from slam.matching.planar import compose
from slam.measurements import BoolArray, FloatArray
from slam.storage.map_file import SEAL, MapFile
from slam.storage.map_soundness import of, require
from slam.storage.map_tables import (
    CAMERAS,
    CLOUDS,
    COVARIANCES,
    EDITS,
    FACTORS,
    FRAMES,
    GRIDS,
    IMAGES,
    KEYFRAMES,
    LOOPS,
    META,
    TRAJECTORY,
    Table,
    Value,
)
from slam.storage.packing import FARTHEST_M, Unpacker, pack, pack_small, unpack

Pair = tuple[int, int]
# A kind of evidence, and the index of the keyframe, frame or cloud.
Evidence = tuple[str, int]

MEASURED: Final = "measured"
REPAIRED: Final = "repaired"
FRAME: Final = "frame"
CLOUD: Final = "cloud"

_KEPT = (META, KEYFRAMES, FACTORS, LOOPS, TRAJECTORY, COVARIANCES, GRIDS, CAMERAS)
_COPIED = (FRAMES, IMAGES, CLOUDS)
_MOST_REGIONS = 100_000
# Settings of earlier versions; a map that was made anew with one keeps what it did.
_REMOVED: tuple[str, ...] = ("dense_map.octomap=", "localization.field_cell_m=")
_REMOVED += ("localization.search_threads=", "localization.tiles_cached=")


@dataclass(frozen=True, slots=True)
class Region:
    """Points that move with the map: each is relative to a nearby keyframe.

    Attributes
    ----------
    kind
        ``erase``, ``keep_out``, ``slow``, ``crop`` or ``place``.
    name
        Name given by the user, or empty.
    value
        For a slow zone percent of the usual speed, for a place its yaw in the frame of the keyframe, for an
        erased region 1 if it also applies to later sessions; else 0.
    keyframes
        (n,) the keyframe of each point.
    offsets
        (n, 2) the points in the frames of these.
    """

    kind: str
    name: str
    value: float
    keyframes: NDArray[np.int64]
    offsets: FloatArray

    def points(self, poses: FloatArray) -> FloatArray:
        """Return (n, 2) the points in the map, by the (K, 3) poses of all keyframes."""
        at = poses[self.keyframes]
        cos, sin = np.cos(at[:, 2]), np.sin(at[:, 2])
        x, y = self.offsets.T
        return np.column_stack([at[:, 0] + cos * x - sin * y, at[:, 1] + sin * x + cos * y])

    def pose(self, poses: FloatArray) -> FloatArray:
        """Return (3,) the pose of a place in the map."""
        offset = np.array([*self.offsets[0], self.value])
        return np.asarray(compose(poses[self.keyframes[0]], offset))


@dataclass(frozen=True, slots=True)
class AppliedEdits:
    """Edits as applied: keyframes by rows, evidence by bits.

    Attributes
    ----------
    text
        The file of edits, as YAML.
    forbidden, forced
        Loops by their two keyframes, the lower first.
    added
        Loops that a match has confirmed.
    erased
        Removed beams, pixels or points: packed bits by kind of evidence and index.
    regions
        Zones, places, crop, and what was erased.
    turned
        ``T_new_old`` of the map frame; None if it is as it was.
    settings
        Other values of settings, as ``--set`` takes them.
    """

    text: str
    forbidden: tuple[Pair, ...] = ()
    forced: tuple[Pair, ...] = ()
    added: tuple[LoopCandidate, ...] = ()
    erased: Mapping[Evidence, bytes] = field(default_factory=dict)
    regions: tuple[Region, ...] = ()
    turned: gtsam.Pose2 | None = None
    settings: tuple[str, ...] = ()


def erased_bits(entries: Sequence[AppliedEdits], kind: str) -> dict[int, bytes]:
    """Return the removed evidence of a kind by all edits: packed bits by index."""
    erased: dict[int, bytes] = {}
    for entry in entries:
        for (of_kind, number), bits in entry.erased.items():
            if of_kind == kind:
                before = erased.get(number, bytes(len(bits)))
                require(len(before) == len(bits), "edits take away of evidence of another size")
                erased[number] = bytes(a | b for a, b in zip(before, bits, strict=True))
    return erased


def mask_of(bits: bytes, size: int) -> BoolArray:
    """Return (size,) packed bits as booleans.

    Raises
    ------
    MapFileError
        If they are of another size.
    """
    require(len(bits) == (size + 7) // 8, "an edit takes away of evidence of another size")
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=size).astype(np.bool_)


def read_edits(file: MapFile) -> list[AppliedEdits]:
    """Read the edits of a map, in the order in which they were applied.

    Raises
    ------
    MapFileError
        If a row is damaged, or does not fit the map.
    """
    entries, small, nodes = list[AppliedEdits](), Unpacker(file.size), file.count(KEYFRAMES)
    for number, (source, _, content) in enumerate(file.rows(EDITS)):
        if source != EDITS.name:
            continue
        with file.naming_row(EDITS, number):
            entries.append(_entry(small(cast(bytes, content)), nodes))
    return entries


def regions_of(entries: Sequence[AppliedEdits], kind: str) -> list[Region]:
    """Return the regions of a kind; of zones and places with the same name, the last one counts."""
    regions: dict[object, Region] = {}
    for entry in entries:
        for number, region in enumerate(region for region in entry.regions if region.kind == kind):
            regions[region.name or (id(entry), number)] = region
    return list(regions.values())


def _entry(values: object, nodes: int) -> AppliedEdits:
    """Parse an entry, if it fits a map of so many keyframes."""
    rows = of(list, values)
    require(len(rows) == 8, "its edits have other fields")
    text, forbidden, forced, added, erased, regions, turned, settings = rows
    for place, keyframe in (*of(list, forbidden), *of(list, forced)):
        require(0 <= place < keyframe < nodes, "a loop of it ends at no keyframe")
    for loop in of(list, added):
        candidate = of(LoopCandidate, loop)
        fits = 0 <= candidate.place < candidate.keyframe < nodes and candidate.motion is not None
        require(fits, "a loop of it ends at no keyframe")
    for kind, number, bits in of(list, erased):
        require(kind in (MEASURED, REPAIRED, FRAME, CLOUD) and number >= 0, "it erases of nothing")
        of(bytes, bits)
    require(len(of(list, regions)) <= _MOST_REGIONS, "it has more regions than any map")
    return AppliedEdits(
        of(str, text),
        tuple((place, keyframe) for place, keyframe in forbidden),
        tuple((place, keyframe) for place, keyframe in forced),
        tuple(added),
        {(kind, number): bits for kind, number, bits in erased},
        tuple(_region(region, nodes) for region in regions),
        None if turned is None else of(gtsam.Pose2, turned),
        tuple(one for one in of(list, settings) if not of(str, one).startswith(_REMOVED)),
    )


def _region(values: object, nodes: int) -> Region:
    """Parse a region, if its keyframes exist."""
    kind, name, value, keyframes, offsets = of(list, values)
    count = len(of(np.ndarray, keyframes))
    fits = keyframes.dtype == np.int64 and keyframes.ndim == 1 and count > 0
    fits = fits and keyframes.min() >= 0 and keyframes.max() < nodes
    fits = fits and of(np.ndarray, offsets).dtype == np.float64 and offsets.shape == (count, 2)
    require(fits and (np.abs(offsets) < FARTHEST_M).all() and abs(value) < FARTHEST_M, "a region is nowhere")
    return Region(of(str, kind), of(str, name), of(float, value), keyframes, offsets)


def _values(entry: AppliedEdits) -> list[object]:
    """Return an entry as plain values."""
    return [
        entry.text,
        [list(pair) for pair in entry.forbidden],
        [list(pair) for pair in entry.forced],
        list(entry.added),
        [[kind, number, bits] for (kind, number), bits in sorted(entry.erased.items())],
        [[one.kind, one.name, one.value, one.keyframes, one.offsets] for one in entry.regions],
        entry.turned,
        list(entry.settings),
    ]


class UneditedFile(MapFile):
    """A map as it was before all edits, read from the file of the edited one, which stays open."""

    def __init__(self, file: MapFile) -> None:
        super().__init__(file.path, file.connection)
        self.tables = file.tables
        self._counts = {table.name: file.count(table) for table in file.tables}
        self._counts[EDITS.name] = 0
        self._edited = file
        self._before: dict[tuple[str, int], int] = {}
        for number, (source, row, _) in enumerate(file.rows(EDITS)):
            if source == EDITS.name:
                continue
            key = (cast(str, source), cast(int, row))
            self._before[key] = number
            with file.naming_row(EDITS, number):
                require(source in {table.name for table in _KEPT}, "it is of no table that edits change")
                if cast(int, row) < 0:  # the number of rows
                    self._counts[cast(str, source)] = -1 - cast(int, row)

    def row(self, table: Table, number: int, *, again: bool = False) -> tuple[Value, ...]:
        """Return the original values of a row."""
        place = self._before.get((table.name, number))
        if place is None:
            return self._edited.row(table, number, again=again)
        values = of(list, unpack(cast(bytes, self._edited.row(EDITS, place)[2])))
        with self.naming_row(table, number):
            require(
                len(values) == len(table.columns) and not table.misfit(tuple(values)), "it has other values"
            )
        return tuple(values)

    def rows(self, table: Table) -> Iterator[tuple[Value, ...]]:
        """Yield the original values of all rows."""
        return (self.row(table, number) for number in range(self.count(table)))


def copy_unedited(source: MapFile, path: Path) -> None:
    """Write a copy of a map without its edits.

    Raises
    ------
    MapFileError
        If a row is damaged, or the file cannot be written.
    """
    before = UneditedFile(source)
    with closing(MapFile.create(path)) as file:
        for table in (*_KEPT, *_COPIED):
            copy_rows(before, file, table)
        file.seal()


def copy_rows(source: MapFile, file: MapFile, table: Table) -> None:
    """Copy all rows of a table unchanged, except the seal."""
    for values in source.rows(table):
        if table is not META or values[0] != SEAL:
            file.append(table, *values)


def append_edits(file: MapFile, source: MapFile, entries: Sequence[AppliedEdits]) -> None:
    """Write edits, and the original rows that they changed, into a map that is complete except its seal."""
    for number, entry in enumerate(entries):
        file.append(EDITS, EDITS.name, number, pack_small(_values(entry)))
    for table in _KEPT:
        before = source.count(table)
        for number in range(before):
            values = source.row(table, number)
            if values[0] == SEAL and table is META:
                continue
            if number >= file.count(table) or file.row(table, number) != values:
                file.append(EDITS, table.name, number, pack(list(values)))
        if file.count(table) != before and table is not META:
            file.append(EDITS, table.name, -1 - before, b"")
