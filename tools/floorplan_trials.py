"""Floor plans of simulated homes against the exact ones: rooms, walls, and whether intervals hold the truth.

    python tools/floorplan_trials.py WORK --homes 1-15 [--rig sick2d]

Drives and maps are made in WORK where they are missing. A room is found where one of the plan has it with an
intersection over union of half; walls, lengths and areas are compared in these. A length or
an area counts where the plan gives an interval.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.app.mapping import map_log
from slam.datasets import open_dataset
from slam.evaluation.trajectory_error import absolute_error
from slam.mapping.floor_plan import FloorPlan
from slam.mapping.floor_plan import Room as FoundRoom
from slam.measurements import FloatArray
from slam.outputs.finished_map import Map, load_map
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.home import Home, Room, generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS

_PIXEL_M = 0.01


@dataclass
class Score:
    """Of one home, or of all."""

    rooms: list[int] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list)
    entered: list[bool] = field(default_factory=list)
    walls_m: list[float] = field(default_factory=list)
    walls_untold: int = 0
    lengths: list[tuple[float, float]] = field(default_factory=list)
    areas: list[tuple[float, float]] = field(default_factory=list)
    doors: list[int] = field(default_factory=list)

    def add(self, other: Score) -> None:
        """Add another home."""
        for name in ("overlaps", "entered", "walls_m", "lengths", "areas"):
            getattr(self, name).extend(getattr(other, name))
        self.walls_untold += other.walls_untold


def main() -> None:
    """Score every home and all together."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--homes", default="1-15", help="first-last")
    parser.add_argument("--rig", default="sick2d", choices=sorted(RIGS))
    parser.add_argument("--kind", default="home", choices=("home", "office"))
    parser.add_argument("--duration", type=float, help="seconds of driving; one tour if absent")
    arguments = parser.parse_args()
    first, last = (int(part) for part in arguments.homes.split("-"))
    right, total = 0, Score()
    print("| home | rooms | IoU | doors | walls RMSE, m | walls told | lengths held | areas held |")
    print("|---|---|---|---|---|---|---|---|")
    for seed in range(first, last + 1):
        home = generate_home(seed, arguments.kind)
        with_truth = _score(home, *_mapped(home, seed, arguments))
        right += with_truth.rooms[0] == with_truth.rooms[1]
        total.add(with_truth)
        print(
            f"| {seed} | {_counts(with_truth.rooms)} {_row(with_truth, _counts(with_truth.doors))}",
            flush=True,
        )
    print(f"| all | {right} of {last - first + 1} right {_row(total, '')}")
    entered = [iou for iou, inside in zip(total.overlaps, total.entered, strict=True) if inside]
    off = np.abs(total.walls_m)
    print(
        f"IoU of the {len(entered)} rooms of {len(total.overlaps)} that were entered: {np.mean(entered):.3f}"
    )
    near = off[off < 0.1]
    shares = f"within 3 cm: {np.mean(off < 0.03):.3f}, within 10 cm: {np.mean(off < 0.1):.3f}"
    print(f"walls {shares}, RMSE of these {_rms(near):.4f} m")


def _mapped(home: Home, seed: int, arguments: Namespace) -> tuple[Map, Path]:
    """The map of a drive through a home, made if need be."""
    folder = arguments.work / f"{arguments.kind}-{arguments.rig}-{seed}"
    drive, out = folder / "drive", folder / "map"
    if not (drive / "groundtruth.txt").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        faults = FAULT_PRESETS["usual"]
        record_drive(home, RIGS[arguments.rig], seed, drive, faults, arguments.duration, formats=("folder",))
    if not (out / "map.db").is_file():
        map_log(drive, out=out).close()
    return load_map(out), drive


def _score(home: Home, found: Map, drive: Path) -> Score:
    """The plan of a map against the home."""
    truth = open_dataset(drive).groundtruth()
    assert truth is not None
    plan = found.floor_plan()
    T_true_map = np.asarray(absolute_error(found.trajectory, truth).T_reference_map)
    found.close()
    turn, shift = T_true_map[:2, :2], T_true_map[:2, -1]
    score = Score(rooms=[len(plan.rooms), len(home.rooms)], doors=[len(plan.doors), len(home.doors)])
    for room in home.rooms:
        overlap, best = _best(room, plan, turn, shift)
        x0, y0, x1, y1 = room.rectangle
        x, y = truth.positions_m[:, :2].T
        score.overlaps.append(overlap)
        score.entered.append(bool(((x > x0) & (x < x1) & (y > y0) & (y < y1)).any()))
        if best is not None:
            _compare(score, room, best, turn, shift)
    return score


def _best(room: Room, plan: FloorPlan, turn: FloatArray, shift: FloatArray) -> tuple[float, FoundRoom | None]:
    """The room of the plan that has most of a room in common, if it is half."""
    x0, y0, x1, y1 = room.rectangle
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    overlaps = [_overlap(corners, found.corners_m @ turn.T + shift) for found in plan.rooms]
    if not overlaps:
        return 0.0, None
    best = int(np.argmax(overlaps))
    return overlaps[best], plan.rooms[best] if overlaps[best] >= 0.5 else None


def _overlap(one: FloatArray, other: FloatArray) -> float:
    """Intersection over union of two polygons, drawn in centimetres."""
    import cv2

    low = np.minimum(one.min(axis=0), other.min(axis=0)) - _PIXEL_M
    high = np.maximum(one.max(axis=0), other.max(axis=0)) + _PIXEL_M
    drawn = []
    for polygon in (one, other):
        image = np.zeros(np.ceil((high - low) / _PIXEL_M).astype(int)[::-1], np.uint8)
        cv2.fillPoly(image, [np.round((polygon - low) / _PIXEL_M).astype(np.int32)], 1)
        drawn.append(image > 0)
    return float((drawn[0] & drawn[1]).sum() / (drawn[0] | drawn[1]).sum())


def _compare(score: Score, room: Room, found: FoundRoom, turn: FloatArray, shift: FloatArray) -> None:
    """Compare a room of a plan with the true room."""
    sides = np.array(room.rectangle).reshape(2, 2)
    for wall in found.walls:
        if wall.sigma_m is None:
            score.walls_untold += 1
            continue
        begin, end = turn @ wall.begin_m + shift, turn @ wall.end_m + shift
        axis = int(abs((end - begin)[0]) > abs((end - begin)[1]))
        score.walls_m.append(float(np.abs(0.5 * (begin + end)[axis] - sides[:, axis]).min()))
    for length in found.lengths:
        along = np.abs(turn @ (length.end_m - length.begin_m))
        axis = int(along[1] > along[0])
        true = float(sides[1, axis] - sides[0, axis])
        score.lengths.append((length.length_m - true, length.half_interval_m))
    if found.area_half_interval_m2 is not None:
        true = float(np.prod(sides[1] - sides[0]))
        score.areas.append((found.area_m2 - true, found.area_half_interval_m2))


def _row(score: Score, doors: str) -> str:
    """The rest of a row."""
    walls = len(score.walls_m)
    return (
        f"| {np.mean(score.overlaps):.3f} | {doors} | {_rms(np.array(score.walls_m)):.4f} "
        f"| {walls} of {walls + score.walls_untold} | {_held(score.lengths)} | {_held(score.areas)} |"
    )


def _held(errors: list[tuple[float, float]]) -> str:
    """How many intervals hold the truth."""
    held = sum(abs(error) <= half for error, half in errors)
    return f"{held} of {len(errors)} ({held / max(len(errors), 1):.3f})"


def _counts(pair: list[int]) -> str:
    """Found and true."""
    return f"{pair[0]} of {pair[1]}"


def _rms(values: FloatArray) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(values**2))) if len(values) else math.nan


if __name__ == "__main__":
    main()
