"""Compare maps of simulated homes, some of their furniture moved between the drives, against the exact truth.

    python tools/diff_trials.py FOLDER --homes 101 115                 15 pairs with furniture moved
    python tools/diff_trials.py FOLDER --homes 201 215 --moved 0       15 unchanged revisits
    python tools/diff_trials.py FOLDER --homes 1 4 --rig xu2024        by another robot

Two drives a home, of different seeds (tour, noise, somebody who walks about), are simulated and mapped by the
command line, once each, into a folder that keeps them, and the maps compared. A moved piece of furniture is
two places: one that it left, and one that it came to. A place is in sight where each drive looked there for
a second: scans of the one met the thing at the height of the lidar, and scans of the other looked through
what had been met. A report is right if it lies within a cell of such a place and states what happened
there; reports of places that were in sight for less are neither right nor wrong.
"""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from saved_maps import map_of, scanweave
from scipy import ndimage

from slam.app.differing import Difference, diff_maps
from slam.config import Config
from slam.errors import ScanweaveError
from slam.evaluation.alignment import align, nearest_indices
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.lidar_layer import lidar_board
from slam.measurements import BoolArray, FloatArray, LaserScan, pose2_from_row
from slam.outputs.finished_map import Map
from slam.sessions.moved_things import ChangedThing
from slam.simulation.rigs import RIGS, Rig
from slam.storage.tum import read_tum

_SIGHT_S = 1.0
_AROUND = np.ones((3, 3), np.bool_)


@dataclass
class Place:
    """A true change: of which piece, whether it came or went, its cells, and for how long it was in sight."""

    piece: int
    kind: str
    appeared: bool
    cells: BoolArray
    seconds: float
    found: bool = False

    @property
    def in_sight(self) -> bool:
        """Whether either drive looked there long enough."""
        return self.seconds >= _SIGHT_S


def main() -> None:
    """Print a row a pair, and the figures of all."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--homes", type=int, nargs=2, default=(1, 15), help="first and last")
    parser.add_argument("--moved", type=int, default=6, help="pieces of furniture; 0 for revisits")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 2), help="of the two drives")
    parser.add_argument("--rig", default="sick2d")
    parser.add_argument("--duration", type=float, help="seconds of driving; one tour if absent")
    arguments = parser.parse_args()
    rows = []
    print("| home | in sight | found | reports | wrong | moved told | CPU s | missed; wrong |")
    print("|---|---|---|---|---|---|---|---|")
    for home in range(arguments.homes[0], arguments.homes[1] + 1):
        row = trial(arguments, home)
        if row is not None:
            rows.append(row)
            missed = ", ".join(f"{place.kind}" for place in row.places if place.in_sight and not place.found)
            print(
                f"| {home} | {row.count('in sight')} | {row.count('found')} | {row.reports} | "
                f"{len(row.wrong)} | {row.moved_reported} of {row.movable} | {row.cpu_s:.1f} | "
                f"{missed}; {', '.join(row.wrong)} |",
                flush=True,
            )
    print(summary(rows))


@dataclass
class Row:
    """The result of a pair: true places, reports, the wrong ones, and objects reported as moved."""

    places: list[Place]
    reports: int
    wrong: list[str]
    moved_reported: int
    movable: int
    cpu_s: float

    def count(self, what: str) -> int:
        """How many true places are such."""
        return {
            "all": len(self.places),
            "in sight": sum(place.in_sight for place in self.places),
            "found": sum(place.in_sight and place.found for place in self.places),
            "found of all": sum(place.found for place in self.places),
        }[what]


def summary(rows: Sequence[Row]) -> str:
    """Precision, recall and F1 over all pairs, and the share of moved objects."""
    total = Counter({key: sum(row.count(key) for row in rows) for key in ("all", "in sight", "found")})
    of_all = sum(row.count("found of all") for row in rows)
    reports, wrong = sum(row.reports for row in rows), sum(len(row.wrong) for row in rows)
    precision = 1.0 - wrong / max(reports, 1)
    recall = total["found"] / max(total["in sight"], 1)
    f1 = 2.0 * precision * recall / max(precision + recall, 1e-9)
    with_false = sum(bool(row.wrong) for row in rows)
    return (
        f"\n{len(rows)} pairs: F1 {f1:.3f}, precision {precision:.3f} ({reports - wrong} of {reports}), "
        f"recall {recall:.3f} ({total['found']} of {total['in sight']} places in sight); of all "
        f"{total['all']} places {of_all} found; {wrong} false alarms in {with_false} pairs; moved told as "
        f"moved {sum(row.moved_reported for row in rows)} of {sum(row.movable for row in rows)}"
    )


def trial(arguments: Namespace, home: int) -> Row | None:
    """One home; None, and a line, where the maps do not connect."""
    drives, maps = [], []
    for seed, moved in zip(arguments.seeds, (0, arguments.moved), strict=True):
        drive = arguments.folder / f"{arguments.rig}-{home}-{seed}-{moved}"
        if not (drive / "groundtruth.txt").is_file():
            length = () if arguments.duration is None else ("--duration", arguments.duration)
            chosen = ("--rig", arguments.rig, "--home", home, "--seed", seed, "--moved", moved, *length)
            scanweave("simulate", *chosen, "--format", "folder", "-o", drive)
        drives.append(drive)
        maps.append(map_of(drive, drive.with_name(f"{drive.name}.map")))
    begun = time.process_time()
    try:
        found = diff_maps(*maps)
    except ScanweaveError as error:
        print(f"home {home}: {error}", flush=True)
        return None
    cpu_s = time.process_time() - begun
    row = scored(found, maps[0], drives, RIGS[arguments.rig])
    row.cpu_s = cpu_s
    for one in maps:
        one.close()
    return row


def scored(found: Difference, before: Map, drives: Sequence[Path], rig: Rig) -> Row:
    """The reports of two drives against what has truly changed between them."""
    grids = [np.load(drive / "truth" / "grid_lidar.npz") for drive in drives]
    places = true_places(drives, grids, rig)
    truth = read_tum(drives[0] / "groundtruth.txt")
    there = truth[nearest_indices(truth.stamps_s, before.trajectory.stamps_s)]
    T = align(before.trajectory, there).T_target_point
    wrong, told_moved, reports = [], set(), 0
    for thing in found.things:
        touched: list[list[Place]] = []
        for appeared, corners in ((False, thing.before_m), (True, thing.after_m)):
            if corners is None:
                continue
            reports += 1
            mask = _drawn(corners @ T[:2, :2].T + T[:2, 3], grids[0])
            right = [place for place in places if place.appeared == appeared and (place.cells & mask).any()]
            for place in right:
                place.found = True
            touched.append(right)
            if not right:
                wrong.append(_named(thing, appeared))
        if thing.what == "moved":
            told_moved |= set.intersection(*({place.piece for place in right} for right in touched))
    movable = {
        place.piece
        for place in places
        if place.in_sight
        and any(o.piece == place.piece and o.appeared != place.appeared and o.in_sight for o in places)
    }
    return Row(places, reports, wrong, len(told_moved & movable), len(movable), 0.0)


def true_places(drives: Sequence[Path], grids: Sequence[np.lib.npyio.NpzFile], rig: Rig) -> list[Place]:
    """What has changed at the height of the lidar, and for how long both drives could tell."""
    listed = drives[1] / "truth" / "changes.json"
    changes = json.loads(listed.read_text())["changes"] if listed.is_file() else []
    occupied = [grid["occupied"] for grid in grids]
    band_m = grids[0]["band_m"]
    places = []
    for piece, change in enumerate(changes):
        for appeared, thing in ((False, change["before"]), (True, change["after"])):
            parts = [] if thing is None else [p for p in thing["parts"] if _reaches(p["z_m"], band_m)]
            cells = np.zeros_like(occupied[0])
            for part in parts:
                cells |= _drawn(np.array(part["corners_m"]), grids[0])
            cells &= occupied[appeared] & ~occupied[not appeared]
            if cells.any():
                places.append(Place(piece, thing["kind"], appeared, cells, 0.0))
    if not places:
        return []
    # What the scans of each drive met or looked through, scan by scan.
    assert rig.lidar is not None
    seen = np.zeros((2, 2, *occupied[0].shape), np.int32)
    for drive, counts in zip(drives, seen, strict=True):
        for rows, cols, steps in _boards(drive, grids[0], rig):
            counts[0][rows, cols] += steps > 0
            counts[1][rows, cols] += steps < 0
    for place in places:
        own, other = int(place.appeared), int(not place.appeared)
        surface = ndimage.binary_dilation(place.cells, _AROUND) & (place.cells | ~occupied[own])
        both = np.minimum(seen[own][0], seen[other][1])[surface]
        place.seconds = float(both.max()) / rig.lidar.model.rate_hz
        place.cells = ndimage.binary_dilation(place.cells, _AROUND)
    return places


def _boards(drive: Path, grid: np.lib.npyio.NpzFile, rig: Rig) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Where in the true grid each true scan of a drive says what."""
    assert rig.lidar is not None
    lidar, cell_m = rig.lidar.model, float(grid["resolution_m"])
    mount, corner = rig.lidar.T_base_laser, np.rint(grid["origin_xy"] / cell_m).astype(int)
    height, width = grid["occupied"].shape
    model = replace(layer_settings(Config()).lidar, max_clear_range_m=0.0)
    for path in sorted((drive / "truth" / "lidar").glob("*.npz")):
        chunk = np.load(path)
        for stamp_s, pose, ranges_m in zip(
            chunk["stamp_s"], chunk["T_map_base_xyt"], chunk["true_ranges_m"], strict=True
        ):
            laser = pose2_from_row((mount.x(), mount.y(), mount.rotation().yaw()))
            scan = LaserScan(
                stamp_s, ranges_m, lidar.start_angle_rad, lidar.step_rad, lidar.range_max_m, laser
            )
            board = lidar_board(scan, pose2_from_row(pose), model, cell_m)
            row, col = board.row - corner[1], board.col - corner[0]
            top, left = max(-row, 0), max(-col, 0)
            steps = board.steps[top : height - row, left : width - col]
            rows = slice(row + top, row + top + steps.shape[0])
            yield rows, slice(col + left, col + left + steps.shape[1]), steps


def _reaches(z_m: Sequence[float], band_m: FloatArray) -> bool:
    """Whether a part stands at the height of the lidar."""
    return bool(z_m[0] < band_m[1] and z_m[1] > band_m[0])


def _drawn(corners_m: FloatArray, grid: np.lib.npyio.NpzFile) -> BoolArray:
    """The cells that a convex outline covers, (rows, cols)."""
    cell_m = float(grid["resolution_m"])
    rows, cols = np.indices(grid["occupied"].shape)
    middles = np.stack([cols, rows], axis=-1) * cell_m + grid["origin_xy"] + 0.5 * cell_m
    inside = np.ones(middles.shape[:2], np.bool_)
    for a, b in zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True):
        edge = b - a
        away = edge[0] * (middles[..., 1] - a[1]) - edge[1] * (middles[..., 0] - a[0])
        inside &= away >= -0.5 * np.sqrt(2.0) * cell_m * np.hypot(*edge)
    return inside


def _named(thing: ChangedThing, appeared: bool) -> str:
    """A false report, for the table."""
    x, y = thing.places_m[-1 if appeared else 0]
    what = "appeared" if appeared else "went"
    return f"{what} ({x:.1f}, {y:.1f}) {thing.size_m[0]:.2f} x {thing.size_m[1]:.2f} {thing.probability:.2f}"


if __name__ == "__main__":
    main()
