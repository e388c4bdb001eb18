"""Compare fused maps of furnished homes with the true grid: F1 of occupied cells per layer, low obstacles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from layer_building import build_layers
from numpy.typing import NDArray
from scipy import ndimage

from slam.mapping.layer_builder import LayerSettings
from slam.mapping.layered_map import LAYERS, DecisionRule, LayeredMap
from slam.mapping.occupancy_grid import OCCUPIED
from slam.measurements import LaserScan, RgbdFrame, planar
from slam.simulation.home import generate_home
from slam.simulation.home_model import Home
from slam.simulation.rigs import Rig
from slam.simulation.scene import Scene
from slam.simulation.sensors import render_rgbd, scan_lidar
from slam.simulation.tour import plan_tour
from slam.simulation.true_grid import TrueGrid, true_grid

EVERY_M, EVERY_RAD = 0.25, 0.26
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.015, 0.007
_AROUND = np.ones((3, 3), dtype=bool)
_STREAM = 21

Cells = NDArray[np.bool_]
PosedReading = tuple[LaserScan | RgbdFrame, gtsam.Pose2]


@dataclass(frozen=True)
class CellScore:
    """Precision against all true cells, recall of those that a robot can see or touch, within one cell."""

    precision: float
    recall: float

    @property
    def f1(self) -> float:
        """Their harmonic mean."""
        return 2.0 * self.precision * self.recall / max(self.precision + self.recall, 1e-9)


def keyframes(home: Home, rig: Rig, seed: int) -> Iterator[PosedReading]:
    """Scan and images every so many metres or radians of a tour through all rooms, at true poses."""
    tour = plan_tour(home, rig.robot_radius_m, rig.robot_height_m, seed)
    caster = Scene(home)
    last = np.full(3, np.inf)
    for index, row in enumerate(tour.poses_xyt):
        moved = np.abs(row - last)
        if np.hypot(moved[0], moved[1]) < EVERY_M and moved[2] < EVERY_RAD:
            continue
        last = row
        rng = np.random.default_rng([seed, _STREAM, index])
        yield from readings_at(gtsam.Pose2(*row), caster, rig, float(index), rng)


def readings_at(
    base: gtsam.Pose2, caster: Scene, rig: Rig, stamp_s: float, rng: np.random.Generator
) -> Iterator[PosedReading]:
    """All sensors of the rig at one pose."""
    body = gtsam.Pose3(base)
    if rig.lidar is not None:
        model = rig.lidar.model
        seen = scan_lidar(caster, body.compose(rig.lidar.T_base_laser), model, rng)
        angles = (model.start_angle_rad, model.step_rad, model.range_max_m)
        yield LaserScan(stamp_s, seen.ranges_m, *angles, planar(rig.lidar.T_base_laser)), base
    for camera in rig.cameras:
        image = render_rgbd(caster, body.compose(camera.T_base_camera), camera.model, rng)
        images = (image.color, image.depth_m, camera.model.intrinsics)
        yield RgbdFrame(stamp_s, *images, camera.T_base_camera, camera.name), base


def on_truth(states: NDArray[np.int8], built: LayeredMap, truth: TrueGrid) -> Cells:
    """The occupied cells of a layer on the truth's grid; both lie on one lattice through the map's origin."""
    corner = np.array([built.T_map_grid.x(), built.T_map_grid.y()])
    shift = np.round((corner - truth.origin_xy) / truth.resolution_m).astype(int)
    rows, cols = np.nonzero(states == OCCUPIED)
    # What lies outside the truth is kept at its rim: it still counts as wrong.
    laid = np.zeros(truth.occupied.shape, dtype=bool)
    laid[np.clip(rows + shift[1], 0, laid.shape[0] - 1), np.clip(cols + shift[0], 0, laid.shape[1] - 1)] = (
        True
    )
    return laid


def to_be_seen(truth: TrueGrid, home: Home, reach_cells: int = 1) -> Cells:
    """True cells that border on the floor which hangs together with the robot's start.

    No sensor sees the inside of a wardrobe; a map can be asked for its faces.
    """
    labels, _ = ndimage.label(~truth.occupied)
    col, row = np.floor((np.array(home.start_xy_yaw[:2]) - truth.origin_xy) / truth.resolution_m).astype(int)
    floor = labels == labels[row, col]
    return truth.occupied & ndimage.binary_dilation(floor, _AROUND, iterations=reach_cells)


def score_cells(found: Cells, truth: Cells, wanted: Cells) -> CellScore:
    """Within one cell: what was found is right near any true cell, what is wanted is met near one found."""
    right = found & ndimage.binary_dilation(truth, _AROUND)
    met = wanted & ndimage.binary_dilation(found, _AROUND)
    return CellScore(
        float(right.sum() / max(found.sum(), 1)),
        float(met.sum() / max(wanted.sum(), 1)),
    )


def obstacles_found(
    found: Cells, ids: NDArray[np.int32], names: Sequence[int], least_cells: int = 2
) -> list[int]:
    """Ids of obstacles that have at least so many occupied cells in or beside them."""
    result = []
    for name in names:
        own = ndimage.binary_dilation(ids == name, _AROUND)
        # A cell beside it may be its neighbour's.
        own &= (ids == name) | (ids < 0)
        if np.count_nonzero(own & found) >= least_cells:
            result.append(int(name))
    return result


def score_home(seed: int, rig: Rig, settings: LayerSettings) -> dict[str, Any]:
    """F1 of every layer of one home, of the plain union, and the low obstacles that each sensor saw.

    Poses carry smooth errors as an optimised graph leaves them. ``union`` is every cell in which either
    sensor ever ended, without Bayes.
    """
    home = generate_home(seed)
    posed = list(keyframes(home, rig, seed))
    poses = with_errors([pose for _, pose in posed], np.random.default_rng([seed, _STREAM]))
    rule = DecisionRule("corrected")  # as Li2020 decides
    built = build_layers((reading for reading, _ in posed), poses, settings, rule)
    hits_only = replace(
        settings,
        lidar=replace(settings.lidar, p_miss=0.49999),
        depth=replace(settings.depth, p_miss=0.49999),
    )
    ended = build_layers((reading for reading, _ in posed), poses, hits_only, rule)
    truth = true_grid(home, settings.depth.band.low_m, settings.depth.band.high_m, settings.resolution_m)
    wanted = to_be_seen(truth, home)
    laid = {name: on_truth(built.states(name), built, truth) for name in LAYERS}
    either = np.where((ended.grid("lidar").steps > 0) | (ended.grid("depth").steps > 0), OCCUPIED, 0)
    laid["union"] = on_truth(either, ended, truth)
    lidar_z = 0.0 if rig.lidar is None else rig.lidar.T_base_laser.z()
    low = [o.id for o in home.obstacles if settings.depth.band.low_m < o.box[1, 2] < lidar_z]
    seen = {name: set(obstacles_found(laid[name], truth.obstacle_id, low)) for name in LAYERS}
    return {
        "home": seed,
        "f1": {name: score_cells(cells, truth.occupied, wanted).f1 for name, cells in laid.items()},
        "low_seen": len(seen["lidar"] | seen["depth"]),
        "low_missed": sorted((seen["lidar"] | seen["depth"]) - seen["decision"]),
    }


def with_errors(poses: Sequence[gtsam.Pose2], rng: np.random.Generator) -> list[gtsam.Pose2]:
    """Poses with smooth errors of `POSE_SIGMA_M` and `POSE_SIGMA_RAD`."""
    errors = ndimage.gaussian_filter1d(rng.standard_normal((len(poses), 3)), 40, axis=0, mode="wrap")
    errors *= np.array([POSE_SIGMA_M, POSE_SIGMA_M, POSE_SIGMA_RAD]) / errors.std(axis=0)
    return [
        gtsam.Pose2(pose.x() + x, pose.y() + y, pose.theta() + yaw)
        for pose, (x, y, yaw) in zip(poses, errors, strict=True)
    ]
