"""What fusion and gaps of glass make of the map to drive by, at true poses with a little noise.

    PYTHONPATH=. python tools/plan_homes.py --homes 101 102 [--seed 5] [--seconds 40] [--json FILE]

Simulates the keyframes of drives of `xu2024` alone, and all scans, repairs the scans of the keyframes as
a run does, and draws the layers: by Table 3 and cautiously without fusion, with repaired scans, with gaps of
glass closed, and without what moves from scan to scan, by true poses. Scores as in `tools/plan_trials.py`;
``f1_thin`` is F1 with the occupied cells thinned to lines one cell wide (Zhang and Suen 1984), ``panes`` the
share of the glass doors within 4 m of the way of which half is in the map.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import plan_trials
from scipy import ndimage

from slam.comparison.map_score import REACH_M, map_scores, on_truth
from slam.comparison.plan_score import plan_scores
from slam.config import load_config
from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import absolute_error
from slam.mapper.keyframe_fusion import KeyframeFusion
from slam.mapper.map_result import depth_grid
from slam.mapping.glass_gaps import with_glass
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.layered_map import DecisionRule, LayeredMap
from slam.mapping.moving_things import MovingThings
from slam.mapping.occupancy_grid import OCCUPIED, UNKNOWN
from slam.measurements import row_from_pose2
from slam.simulation.drive import Drive, prepare_drive
from slam.simulation.drive_faults import FAULT_PRESETS, LIDAR
from slam.simulation.home import generate_home
from slam.simulation.record import truth_bands_m
from slam.simulation.rigs import RIGS
from slam.simulation.scene import Scene
from slam.simulation.true_grid import TrueGrid, true_grid
from slam.simulation.truth_writer import GRID_RESOLUTION_M

RIG = RIGS["xu2024"]
# Of a pose that the mapper finds: metres and radians.
_NOISE = np.array([0.007, 0.007, np.radians(0.14)])
_STREAM = 77  # of its random numbers


def main() -> None:
    """Score every home, and print the table."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, nargs="+", required=True)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--json", type=Path, help="gets the figures of every drive")
    arguments = parser.parse_args()
    found: dict[str, dict[str, dict[str, float]]] = {}
    for home in arguments.homes:
        faults = FAULT_PRESETS["usual"]
        drive = prepare_drive(generate_home(home), RIG, arguments.seed, faults, arguments.seconds)
        for name, scores in scores_of(drive, home).items():
            found.setdefault(name, {})[f"home {home}"] = scores
        print(f"home {home} done", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(plan_trials.table(found, (*plan_trials.SHOWN, "f1_thin", "panes")))


def scores_of(drive: Drive, home: int) -> dict[str, dict[str, float]]:
    """Of each way to draw the layers, its scores."""
    config = load_config(None, [f"layers.robot_height_m={RIG.robot_height_m:g}"])
    keys, raw, repaired, fixed = keyframes(drive, np.random.default_rng([home, drive.seed, _STREAM]), config)
    poses = np.array([row_from_pose2(pose) for pose in keys.poses])
    depth = depth_grid(keys.frames, keys.frame_poses, config)
    first, fused, still = (grid_of_keyframes(scans, poses, config) for scans in (raw, repaired, fixed))
    assert fused is not None and still is not None
    truth = true_grid(drive.home, *truth_bands_m(RIG)["robot"], GRID_RESOLUTION_M)
    way = drive.tour.poses_at(np.arange(0.0, drive.tour.duration_s, 0.02))[:, :2]
    stamps = np.array([scan.stamp_s for scan in raw])
    true_poses = np.array([row_from_pose2(pose) for pose in keys.true_poses])
    estimate, true = (Trajectory.from_planar(stamps, rows) for rows in (poses, true_poses))
    T_true_map = absolute_error(estimate, true).T_reference_map
    found = {}
    for name, grid, rule in (
        ("no fusion, Table 3", first, DecisionRule("corrected")),
        ("no fusion", first, DecisionRule()),
        ("repaired scans", fused, DecisionRule()),
        ("and gaps of glass", with_glass(fused, repaired, poses, config), DecisionRule()),
        ("and what moves", with_glass(still, fixed, poses, config), DecisionRule()),
    ):
        layers = LayeredMap(grid, depth, rule)
        states = layers.decision()
        laid = (states, truth, T_true_map, way)
        scores = plan_scores(*laid, poses[:, :2], RIG.robot_radius_m) | map_scores(*laid)
        lines = np.where((states.states == OCCUPIED) & ~thinned(states.states), UNKNOWN, states.states)
        scores["f1_thin"] = map_scores(replace(states, states=lines), *laid[1:])["f1"]
        inside = ndimage.binary_dilation(on_truth(*laid[:3])[0], np.ones((3, 3)))
        panes = [np.mean(share) >= 0.5 for share in panes_in(inside, drive, truth, way)]
        scores["panes"] = float(np.mean(panes)) if panes else np.nan
        found[name] = scores
    return found


def keyframes(drive: Drive, random: np.random.Generator, config: Any) -> tuple[Any, Any, Any, Any]:
    """Poses, frames and scans of a drive's keyframes; scans as recorded, repaired, and without what moves."""
    scene, schedules = Scene(drive.home), drive.schedules
    fusion, moving = KeyframeFusion(config.fusion), MovingThings(config.scan.range_max_m)
    keys = SimpleNamespace(poses=[], true_poses=[], frames=[], frame_poses=[])
    scans, last = [], None
    for at in np.flatnonzero(schedules[LIDAR].kept).tolist():
        base = drive.base_at(float(schedules[LIDAR].true_s[at]))
        scan = drive._scan(scene, schedules[LIDAR], at).scan
        moving.add(scan, row_from_pose2(base))
        step = None if last is None else last.between(base)
        near = step is not None and np.hypot(step.x(), step.y()) < config.keyframes.distance_m
        if step is not None and near and abs(step.theta()) < config.keyframes.angle_rad:
            continue
        last = base
        pose = base.compose(gtsam.Pose2(*(_NOISE * random.standard_normal(3))))
        pictures = []
        for camera in RIG.cameras:
            seen = schedules[camera.name]
            taken = np.flatnonzero(seen.kept & (seen.true_s <= schedules[LIDAR].true_s[at]))
            if taken.size:
                image = drive._image(scene, camera, seen, int(taken[-1]))
                moved = gtsam.Pose3(base.between(image.T_map_base)).compose(camera.T_base_camera)
                keys.frames.append(image.frame)
                keys.frame_poses.append(gtsam.Pose3(pose).compose(moved))
                stamp_s = image.frame.stamp_s - seen.clock_offset_s
                pictures.append(
                    SimpleNamespace(
                        frame=SimpleNamespace(frame=image.frame, stamp_s=stamp_s), T_base_camera=moved
                    )
                )
        fusion.add(len(scans), scan, pictures)
        moving.keep(scan)
        scans.append(scan)
        keys.poses.append(pose)
        keys.true_poses.append(base)
    repaired = fusion.repair(scans)[0]
    return keys, scans, repaired, moving.taken_from(repaired)


def panes_in(inside: Any, drive: Drive, truth: TrueGrid, way: Any) -> list[list[bool]]:
    """Of each glass door near the way, which of its cells have an occupied one within 0.15 m across it."""
    driven = np.zeros(truth.occupied.shape, dtype=bool)
    driven[tuple(np.floor((way - truth.origin_xy) / truth.resolution_m).astype(int)[:, ::-1].T)] = True
    labels, _ = ndimage.label(~truth.occupied)
    floor = np.isin(labels, np.setdiff1d(labels[driven], 0))
    floor &= ndimage.distance_transform_edt(~driven) * truth.resolution_m <= REACH_M
    walls = ndimage.binary_dilation(inside, np.ones((3, 3)))
    found = []
    for thing in drive.home.obstacles:
        if thing.kind == "glass":
            cells = np.argwhere(truth.obstacle_id == thing.id)
            low, high = cells.min(axis=0), cells.max(axis=0) + 1
            around = tuple(slice(max(0, a - 6), b + 6) for a, b in zip(low, high, strict=True))
            if floor[around].any():
                across = (5, 1) if high[0] - low[0] < high[1] - low[1] else (1, 5)
                there = ndimage.binary_dilation(walls, np.ones(across))
                found.append(there[tuple(cells.T)].tolist())
    return found


def thinned(states: Any) -> Any:
    """The occupied cells that are left when walls are thinned to lines (Zhang and Suen 1984)."""
    image = states == OCCUPIED
    going = True
    while going:
        going = False
        for first, last in (((0, 2, 4), (2, 4, 6)), ((0, 2, 6), (0, 4, 6))):
            p = np.pad(image, 1)
            rows, cols = (0, 0, 1, 2, 2, 2, 1, 0), (1, 2, 2, 2, 1, 0, 0, 0)
            near = [
                p[row : row + len(image), col : col + image.shape[1]]
                for row, col in zip(rows, cols, strict=True)
            ]
            count = np.sum(near, axis=0)
            turns = np.sum([~near[i] & near[(i + 1) % 8] for i in range(8)], axis=0)
            gone = image & (count >= 2) & (count <= 6) & (turns == 1)
            for three in (first, last):
                gone &= ~(near[three[0]] & near[three[1]] & near[three[2]])
            image = image & ~gone
            going = going or bool(gone.any())
    return image


if __name__ == "__main__":
    main()
