"""Map simulated homes from their lidar logs and score the trajectories against the exact truth.

Every run draws a home, drives a rig through it, feeds lidar and wheel readings straight into the mapper, and
measures the absolute trajectory error at the scans, after rigid alignment. The preset is the default one.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from pathlib import Path

import numpy as np

from slam.config import load_config
from slam.estimates import Trajectory
from slam.evaluation.trajectory_error import absolute_error
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.measurements import row_from_pose2
from slam.simulation.drive import simulate_drive
from slam.simulation.drive_faults import DriveFaults
from slam.simulation.events import OdometryEvent, ScanEvent
from slam.simulation.home import generate_home
from slam.simulation.rigs import RIGS


def main() -> None:
    """Run the matrix and print one Markdown table."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--rig", action="append", help=f"repeatable; of {', '.join(sorted(RIGS))}")
    parser.add_argument("--homes", type=int, default=5, help="homes, from seed 1")
    parser.add_argument("--seeds", type=int, default=3, help="drives a home, from seed 0")
    parser.add_argument("--kind", choices=("home", "office"), default="home")
    parser.add_argument(
        "--duration", type=float, help="seconds of driving; one tour through all rooms if absent"
    )
    parser.add_argument("--person", action="store_true", help="somebody walks about")
    parser.add_argument("--set", action="append", default=[], help="as in scanweave map --set")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    rows = []
    print("| rig | home | seed | scans | way m | ATE m | max m | wheels alone m | loops |")
    print("|---|---|---|---|---|---|---|---|---|")
    for rig in arguments.rig or ["xu2024", "sick2d"]:
        for home in range(1, arguments.homes + 1):
            for seed in range(arguments.seeds):
                row = run(rig, home, seed, arguments)
                rows.append(row)
                print(
                    f"| {rig} | {home} | {seed} | {row['scans']} | {row['path_m']:.0f} | {row['ate_m']:.4f} "
                    f"| {row['max_m']:.4f} | {row['wheels_m']:.3f} | {row['loops']} of {row['tried']} |",
                    flush=True,
                )
        errors = [row["ate_m"] for row in rows if row["rig"] == rig]
        print(
            f"| **{rig}** | | | | | median **{statistics.median(errors):.4f}** "
            f"| worst {max(errors):.4f} | | |"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2), encoding="utf-8")


def run(rig_name: str, home_seed: int, seed: int, arguments: Namespace) -> dict[str, float | str]:
    """One home, one drive: scores by name."""
    rig = dataclasses.replace(RIGS[rig_name], cameras=())
    home = generate_home(home_seed, arguments.kind)
    config = load_config(None, arguments.set)
    mapper = Mapper(config, PlanarRobot(config))
    stamps, truth, wheels, found = [], [], [], []
    last_wheels = np.zeros(3)
    faults = DriveFaults(person=arguments.person)
    for event in simulate_drive(home, rig, seed, faults, arguments.duration):
        if isinstance(event, OdometryEvent):
            mapper.add(event.reading)
            last_wheels = row_from_pose2(event.reading.T_odom_base)
            found.append(False)
        elif isinstance(event, ScanEvent):
            mapper.add(event.scan)
            stamps.append(event.scan.stamp_s)
            truth.append(row_from_pose2(event.T_map_base))
            wheels.append(last_wheels)
            found.append(True)
    if not stamps:
        sys.exit(f"rig {rig_name} has no 2D lidar")
    result = mapper.finish()
    at = np.array(stamps)
    reference = Trajectory.from_planar(at, np.array(truth))
    scans = np.flatnonzero(found)
    estimate = Trajectory.from_planar(at, result.map.trajectory.to_planar()[scans])
    error = absolute_error(estimate, reference).translation_m
    way = np.diff(np.array(truth)[:, :2], axis=0)
    drift = absolute_error(Trajectory.from_planar(at, np.array(wheels)), reference).translation_m
    return {
        "rig": rig_name,
        "home": home_seed,
        "seed": seed,
        "scans": len(stamps),
        "path_m": float(np.hypot(way[:, 0], way[:, 1]).sum()),
        "ate_m": error.rmse,
        "max_m": error.max,
        "wheels_m": drift.rmse,
        "loops": sum(loop.accepted for loop in result.map.loops),
        "tried": len(result.map.loops),
    }


if __name__ == "__main__":
    main()
