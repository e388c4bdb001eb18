"""Reproduce Li2020's experiment (Fig. 9-13): five obstacles, lidar alone, Kinect alone, fused; 20 seeds.

Writes DIR/results.json, DIR/details.json and DIR/index.html, one page that needs nothing else, and the fused
scene in 3D: scene.ply and scene.bt. The robot's poses are the simulator's: this measures the map, not SLAM.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from layer_building import build_layers
from layer_homes import obstacles_found, on_truth, score_home
from layer_page import grids, section, table, write_json, write_parts
from layer_rigs import layer_settings
from li2020_scene import draw_scene, readings

from fusion import bayes
from fusion.height_band import HeightBand
from slam.evaluation.figure_parts import figure_of, png_of
from slam.evaluation.pages import parts
from slam.mapping.dense_map import ColoredCloud, DenseMapSettings, fuse_keyframes
from slam.mapping.layered_map import LAYERS, DecisionRule, LayeredMap
from slam.measurements import LaserScan, RgbdFrame
from slam.simulation.rigs import RIGS
from slam.simulation.true_grid import true_grid
from slam.storage.octomap import write_octomap
from slam.storage.ply import write_cloud_ply

PUBLISHED = {"lidar": [1, 3, 5], "kinect": [1, 2, 3], "fused": [1, 2, 3, 5]}
# Eq. (9)'s decision of each sensor, and Table 3's of both.
LAYER_OF = {"lidar": "lidar", "kinect": "depth", "fused": "decision"}
CLIMB_M = 0.01  # obstacles lower than this are dropped


def main() -> None:
    """Measure, write, say the headline."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the page and the figures")
    parser.add_argument("--seeds", type=int, default=20, help="scenes, from seed 0")
    parser.add_argument("--homes", type=int, default=0, help="also furnished homes, from seed 1; slow")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs = [run_seed(seed) for seed in range(arguments.seeds)]
    results = summarise(runs)
    write_json(arguments.out / "results.json", results)
    details = {
        "printed_rule": [run["printed"] for run in runs],
        "fused_by_eq_10": [run["eq_10"] for run in runs],
        "homes": [home(seed) for seed in range(1, arguments.homes + 1)],
    }
    write_json(arguments.out / "details.json", details)
    scene_3d = write_3d(arguments.out, 0)
    pieces = page(runs, results, scene_3d) + homes_part(details["homes"])
    write_parts(arguments.out / "index.html", "Li2020: one map of lidar and Kinect", pieces)
    print(json.dumps({"seeds": results["seeds"], "right": results["right"]}))


def home(seed: int) -> dict[str, Any]:
    """A furnished home, by the robot that carries a lidar and a D435i."""
    rig = RIGS["yang2021_lidar"]
    return score_home(seed, rig, layer_settings(rig, HeightBand(0.0, rig.robot_height_m - 0.03, 0.03)))


def run_seed(seed: int) -> dict[str, Any]:
    """Obstacles found in each layer of one scene."""
    scene = draw_scene(seed)
    posed = list(readings(scene))
    band = HeightBand(0.0, RIGS["li2020"].robot_height_m - CLIMB_M, CLIMB_M)
    settings = layer_settings(RIGS["li2020"], band)
    built = build_layers(
        (reading for reading, _ in posed), [pose for _, pose in posed], settings, DecisionRule("corrected")
    )
    # With the mat, which is there all the same.
    truth = true_grid(scene.home, 0.001, RIGS["li2020"].robot_height_m, settings.resolution_m)

    def numbers(states: Any) -> list[int]:
        found = obstacles_found(on_truth(states, built, truth), truth.obstacle_id, list(scene.number_of))
        return [scene.number_of[name] for name in found]

    found = {name: numbers(built.states(layer)) for name, layer in LAYER_OF.items()}  # type: ignore[arg-type]
    return {
        "seed": seed,
        "built": built,
        "printed": numbers(printed_decision(built)),
        "eq_10": numbers(built.states("fused")),
        **found,
    }


def printed_decision(built: LayeredMap) -> Any:
    """The decision by Table 3 as it is printed."""
    return bayes.decide(built.states("lidar"), built.states("depth"), "printed")


def summarise(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures that the issue names."""
    return {
        "seeds": len(runs),
        "right": sum(all(run[name] == ids for name, ids in PUBLISHED.items()) for run in runs),
        **{name: [run[name] for run in runs] for name in PUBLISHED},
    }


def write_3d(out: Path, seed: int) -> bytes:
    """The scene as OctoMap and as a coloured cloud with the lidar's ends in it; a picture of the cloud."""
    posed = list(readings(draw_scene(seed)))
    frames = [reading for reading, _ in posed if isinstance(reading, RgbdFrame)]
    poses = [
        gtsam.Pose3(pose).compose(reading.T_base_camera)
        for reading, pose in posed
        if isinstance(reading, RgbdFrame) and reading.T_base_camera is not None
    ]
    write_octomap(out / "scene.bt", frames, poses, 0.05, 3.5)
    seen = fuse_keyframes(frames, poses, DenseMapSettings(0.01, 3.5, 0.8)).cloud
    lidar = np.concatenate(
        [_ends(reading, pose) for reading, pose in posed if isinstance(reading, LaserScan)]
    )
    cloud = ColoredCloud(
        np.concatenate([seen.points_map, lidar]).astype(np.float32),
        np.concatenate([seen.colors, np.full((len(lidar), 3), (220, 40, 40), np.uint8)]),
        np.concatenate([seen.normals_map, np.tile(np.float32([0, 0, 1]), (len(lidar), 1))]),
    )
    write_cloud_ply(out / "scene.ply", [cloud])
    return cloud_picture(cloud)


def cloud_picture(cloud: ColoredCloud) -> bytes:
    """The points before the robot, from over its shoulder."""
    near = (cloud.points_map[:, 0] > 0.5) & (cloud.points_map[:, 2] < 1.2)
    points, colors = cloud.points_map[near][::4], cloud.colors[near][::4]
    figure = figure_of(900, 520)
    axes: Any = figure.add_subplot(projection="3d")
    axes.scatter(*points.T, c=colors / 255.0, s=1.0)
    axes.view_init(elev=28.0, azim=-160.0)
    axes.set_box_aspect(np.ptp(points, axis=0))
    return png_of(figure)


def _ends(scan: LaserScan, T_map_base: gtsam.Pose2) -> Any:
    """(N, 3) where the beams ended, at the lidar's height."""
    mount = RIGS["li2020"].lidar
    assert mount is not None
    good = np.isfinite(scan.ranges_m)
    bearing, range_m = scan.bearings_rad()[good], scan.ranges_m[good]
    laser = np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing), np.zeros(len(range_m))])
    return gtsam.Pose3(T_map_base).compose(mount.T_base_laser).transformFrom(laser.T).T


def page(runs: list[dict[str, Any]], results: dict[str, Any], scene_3d: bytes) -> list[str]:
    """The parts of the page."""
    note = (
        "Source: the simulator (RPLIDAR A2 at 0.30 m, Kinect at 0.45 m, 8 degrees down), true poses. "
        "Obstacle 1 is a box, 2 a box under the lidar's plane, 3 a chair, 4 a mat under 1 cm, 5 a box beside "
        f"the robot. Right in {results['right']} of {results['seeds']} seeds."
    )
    rows = [
        [str(run["seed"]), *(_ids(run[name]) for name in (*PUBLISHED, "printed", "eq_10"))] for run in runs
    ]
    head = ["seed", "lidar", "Kinect", "fused", "Table 3 as printed", "Eq. (10)"]
    pictures = [
        grids([(name, run["built"].states(name)) for name in LAYERS], f"layers of seed {run['seed']}")
        for run in runs[:3]
    ]
    return [
        f"<p class=note>{note}</p>",
        section(
            "Obstacles found", table(head, [["published", *map(_ids, PUBLISHED.values()), "", ""], *rows])
        ),
        section("Layers: black occupied, white free, grey unknown", "".join(pictures)),
        section(
            "The scene in 3D, as of Fig. 13",
            "<p>The camera's points in colour, the lidar's ends in red; also scene.ply and scene.bt.</p>",
            parts().image(scene_3d, "coloured points of the scene"),
        ),
    ]


def homes_part(homes: list[dict[str, Any]]) -> list[str]:
    """Occupied-cell F1 within one cell, home by home."""
    if not homes:
        return []
    names = list(homes[0]["f1"])
    rows = [
        [str(h["home"]), *(f"{h['f1'][n]:.3f}" for n in names), f"{len(h['low_missed'])} of {h['low_seen']}"]
        for h in homes
    ]
    note = (
        "Precision is against everything in the true grid, recall of what borders on the floor. The decision "
        "is by its rule the union of what each sensor has decided; union: where either ever ended."
    )
    head = ["home", *names, "low obstacles missed"]
    return [section("Furnished homes: F1 of occupied cells", f"<p>{note}</p>", table(head, rows))]


def _ids(ids: list[int]) -> str:
    """For people."""
    return "{" + ", ".join(map(str, ids)) + "}"


if __name__ == "__main__":
    main()
