"""Scores a repair with the simulator's fault masks: every changed reading, and the reason."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from xu2024_pairs import TrueImage, TruePair

import fusion
from slam.simulation.faults import Fault

BURRS = (Fault.BURR_EDGE, Fault.BURR_MULTIPATH)
VISIBLE_M = 0.05  # a burr nearer to the truth than this makes nothing worse and counts as no burr
SAME_M = 0.05  # two sensors see the same point where they agree on it so far
WORSE_M = 0.05
KEPT_M = 0.10  # an obstacle is still there where a reading is this near to it

Bools = NDArray[np.bool_]


class Tally:
    """Flags and errors by name, over any number of pairs."""

    def __init__(self) -> None:
        self._held: dict[str, list[NDArray[np.generic]]] = defaultdict(list)

    def add(self, name: str, values: NDArray[np.generic] | list[float] | list[bool]) -> None:
        """More of a kind."""
        self._held[name].append(np.atleast_1d(np.asarray(values)))

    def all(self, name: str) -> NDArray[np.float64]:
        """Everything of a kind."""
        return np.concatenate([np.zeros(0), *self._held[name]]).astype(np.float64)

    def share(self, *names: str) -> float:
        """Mean of flags, of all kinds named together."""
        values = np.concatenate([self.all(name) for name in names])
        return float(values.mean()) if values.size else float("nan")

    def median(self, *names: str) -> float:
        """Median of all kinds named together."""
        values = np.concatenate([self.all(name) for name in names])
        return float(np.median(values)) if values.size else float("nan")

    def named(self, prefix: str) -> Tally:
        """The same under longer names."""
        result = Tally()
        for name, values in self._held.items():
            result._held[prefix + name] = values
        return result

    def merge(self, other: Tally) -> None:
        """Take in another tally."""
        for name, values in other._held.items():
            self._held[name] += values


def score_pair(pair: TruePair, repaired: fusion.Denoised, band_m: tuple[float, float], tally: Tally) -> None:
    """Count one pair's repairs; the band about the lidar's plane is what of an image could be touched."""
    _score_lidar(pair, repaired, tally)
    for image, depth, source in zip(pair.images, repaired.depth_m, repaired.depth_source, strict=True):
        _score_image(pair, image, depth, source, band_m, tally)


def _score_lidar(pair: TruePair, repaired: fusion.Denoised, tally: Tally) -> None:
    """Holes and burrs of beams whose true point the camera saw well; good beams; obstacles."""
    own, truth, fault = pair.scan.valid_ranges_m(), pair.true_ranges_m, pair.fault
    changed = ~np.isin(repaired.lidar_source, (fusion.Provenance.MEASURED, fusion.Provenance.HOLE))
    replaced = changed & (repaired.lidar_source != fusion.Provenance.AVERAGED)
    with np.errstate(invalid="ignore"):
        error, before = np.abs(repaired.ranges_m - truth), np.abs(own - truth)
    seen = camera_saw(pair)
    hole = is_hole(fault) & np.isnan(own) & seen
    tally.add("lidar_hole", changed[hole])
    tally.add("lidar_hole_error", error[hole & changed])
    for kind in BURRS:
        burr = (fault == kind) & (before > VISIBLE_M) & seen
        tally.add(f"lidar_{kind.name.lower()}", replaced[burr])
        tally.add("lidar_burr", replaced[burr])
        tally.add("lidar_burr_nearer", (replaced & (error < before))[burr])
        tally.add("lidar_burr_error", error[burr & replaced])
    good = (fault == Fault.NONE) & np.isfinite(own)
    tally.add("lidar_worse", (changed & (error > before + WORSE_M))[good])
    lost = obstacles_lost(pair, good, changed, error)
    tally.add("obstacle_lost", lost)
    tally.add("beams_lost_obstacles", [float(sum(lost))])


def obstacles_lost(pair: TruePair, good: Bools, changed: Bools, error: NDArray[np.float32]) -> list[bool]:
    """For every obstacle with a good reading in the scan, whether none is left of it."""
    still = good & (~changed | (error < KEPT_M))
    ids = np.unique(pair.obstacle[good & (pair.obstacle >= 0)])
    return [not bool((still & (pair.obstacle == owner)).any()) for owner in ids]


def _score_image(
    pair: TruePair,
    image: TrueImage,
    depth: NDArray[np.float32],
    source: NDArray[np.uint8],
    band_m: tuple[float, float],
    tally: Tally,
) -> None:
    """Pixels that look at the lidar's plane: holes, burrs, and good ones in the band about it."""
    given, truth, fault = image.depth.depth_m, image.true_depth_m, image.fault
    above, cone = _height_over_lidar(image)
    changed = source == fusion.Provenance.FILLED
    row, col = np.nonzero(np.abs(above) <= cone)
    seen = lidar_saw(pair, image, row, col)
    with np.errstate(invalid="ignore"):
        error, before = np.abs(depth - truth), np.abs(given - truth)
    on = (row[seen], col[seen])
    hole = is_hole(fault[on]) & (given[on] == 0.0)
    tally.add("depth_hole", changed[on][hole])
    tally.add("depth_hole_error", error[on][hole & changed[on]])
    for kind in BURRS:
        burr = (fault[on] == kind) & (before[on] > VISIBLE_M) & (given[on] > 0.0)
        tally.add(f"depth_{kind.name.lower()}", changed[on][burr])
        tally.add("depth_burr", changed[on][burr])
        tally.add("depth_burr_nearer", (changed & (error < before))[on][burr])
        tally.add("depth_burr_error", error[on][burr & changed[on]])
    # All that was touched is counted, but only what could be touched is in the denominator.
    good = (fault == Fault.NONE) & (given > 0.0) & (((above >= band_m[0]) & (above <= band_m[1])) | changed)
    tally.add("depth_worse", (changed & (error > before + WORSE_M))[good])


def is_hole(fault: NDArray[np.uint8]) -> Bools:
    """Whether a fault is a hole of any cause, the sensor's own reach included."""
    return (fault >= Fault.HOLE_GLASS) & (fault <= Fault.HOLE_SHADOW)


def is_burr(fault: NDArray[np.uint8]) -> Bools:
    """Whether a fault is a burr."""
    return np.isin(fault, BURRS)


def pixels_of_beams(pair: TruePair, image: TrueImage) -> tuple[Bools, NDArray[np.int64], NDArray[np.int64]]:
    """Which beams' true points an image has in view, unhidden, and at which row and column."""
    bearings = pair.scan.bearings_rad()
    reach = np.where(np.isfinite(pair.true_ranges_m), pair.true_ranges_m, 0.0)
    points = np.column_stack([reach * np.cos(bearings), reach * np.sin(bearings), np.zeros(reach.size)])
    T = np.linalg.inv(image.T_laser_camera.matrix())
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    camera = image.depth.intrinsics
    assert camera is not None
    ahead = np.where(z > 0.1, z, np.nan)
    col, row = np.round(camera.fx * x / ahead + camera.cx), np.round(camera.fy * y / ahead + camera.cy)
    height, width = image.fault.shape
    inside = (reach > 0.0) & (col >= 0) & (col < width) & (row >= 0) & (row < height)
    rows, cols = np.where(inside, row, 0).astype(int), np.where(inside, col, 0).astype(int)
    inside &= np.abs(image.true_depth_m[rows, cols] - z) < SAME_M
    return inside, rows, cols


def camera_saw(pair: TruePair) -> Bools:
    """(N,) beams at whose true point some camera has a good reading."""
    seen = np.zeros(pair.fault.size, dtype=bool)
    for image in pair.images:
        inside, row, col = pixels_of_beams(pair, image)
        seen |= inside & (image.fault[row, col] == Fault.NONE) & (image.depth.depth_m[row, col] > 0.0)
    return seen


def lidar_saw(pair: TruePair, image: TrueImage, row: NDArray[np.int64], col: NDArray[np.int64]) -> Bools:
    """(K,) pixels at whose true point the lidar has a good reading."""
    camera = image.depth.intrinsics
    assert camera is not None
    z = image.true_depth_m[row, col].astype(np.float64)
    rays = np.column_stack([(col - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(z.size)])
    T = image.T_laser_camera.matrix()
    x, y = ((rays * z[:, None]) @ T[:2, :3].T + T[:2, 3]).T
    beam = np.round((np.arctan2(y, x) - pair.scan.start_angle_rad) / pair.scan.step_rad).astype(int)
    inside = (beam >= 0) & (beam < pair.fault.size)
    beam = beam.clip(0, pair.fault.size - 1)
    near = np.abs(pair.true_ranges_m[beam] - np.hypot(x, y)) < SAME_M
    fine = (pair.fault[beam] == Fault.NONE) & np.isfinite(pair.scan.valid_ranges_m()[beam])
    return inside & near & fine


def _height_over_lidar(image: TrueImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(H, W) true height of each pixel's point over the lidar's plane, and half the pixel's own height."""
    camera = image.depth.intrinsics
    assert camera is not None
    depth = np.where(np.isfinite(image.true_depth_m), image.true_depth_m, 0.0).astype(np.float64)
    height, width = depth.shape
    x = (np.arange(width)[None, :] - camera.cx) / camera.fx
    y = (np.arange(height)[:, None] - camera.cy) / camera.fy
    T = image.T_laser_camera.matrix()
    above = depth * (T[2, 0] * x + T[2, 1] * y + T[2, 2]) + T[2, 3]
    cone = np.where(depth > 0.0, 0.5 * depth / max(camera.fx, camera.fy), -1.0)
    return above, cone
