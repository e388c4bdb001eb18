"""One simulated drive of the reproduction: register all pairs, estimate the rig, repair, compare."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from xu2024_homography import fit
from xu2024_map import DriveMaps
from xu2024_pairs import TruePair, simulate_pairs, true_camera_in_laser
from xu2024_recall import score_recall
from xu2024_rows import (
    SIMILARITIES,
    masked_sums,
    register_by_pcc,
    register_rows,
    row_curves,
    similarity_map,
)
from xu2024_score import Tally, score_pair

import fusion
from fusion.curves import SAMPLE_STEP_RAD, resample
from fusion.denoise import matched_curves, matched_points, repair_by
from fusion.panorama import join
from slam.simulation.drive import Drive
from slam.simulation.true_grid import true_grid

MARGIN_M = 0.02  # beyond the heights that are as good: what a repair may touch
MODELS = ("homography", "magsac", "rigid")
EVERY_MODEL = 5  # pairs of which one is repaired with every model, and scored for recall


@dataclass
class DriveResult:
    """Results of one drive.

    Attributes
    ----------
    tally
        Everything that is counted, by name.
    grades
        Pairs by room and grade: of the paper (rows, PCC) and ours.
    u_within_1, height_within_10cm
        Whether the rig's constants were found; None without a truth.
    maps
        Completeness and false occupied cells before and after, empty without a truth.
    pictures
        What the page draws, empty for most drives.
    """

    rig: str
    home: int
    tally: Tally
    grades: dict[str, Counter[tuple[str, str]]]
    pairs: int = 0
    u_within_1: float | None = None
    height_within_10cm: float | None = None
    height_error_m: float | None = None
    maps: dict[str, float] = field(default_factory=dict)
    pictures: dict[str, Any] = field(default_factory=dict)

    def line(self) -> str:
        """In short."""
        t = self.tally
        return (
            f"{self.pairs} pairs, u {t.share('u_within_2'):.3f} of high, height off {self.height_error_m},"
            f" holes {t.share('lidar_hole', 'depth_hole'):.3f},"
            f" burrs {t.share('lidar_burr', 'depth_burr'):.3f},"
            f" worse {t.share('lidar_worse', 'depth_worse'):.5f}"
        )


def run_drive(drive: Drive, home: int, most: int, *, pictures: bool) -> DriveResult:
    """Simulate, fuse and score one drive; two passes, as an offline mapper takes them."""
    result = DriveResult(drive.rig.name, home, Tally(), {"rows": Counter(), "heights": Counter()})
    pairs = list(simulate_pairs(drive, most))
    rig = fusion.Rig()
    found = [register_pair(pair, result) for pair in pairs]
    for registration in found:
        rig.add(registration)
    estimate = rig.estimate()
    assert estimate is not None and drive.rig.lidar is not None
    truth_m = -float(true_camera_in_laser(drive.rig.lidar, drive.rig.cameras[0]).z())
    result.pairs = len(pairs)
    # The level frame's yaw is the robot's own: the true yaw between the two is zero.
    result.u_within_1 = float(abs(estimate.yaw_rad) <= SAMPLE_STEP_RAD)
    result.height_error_m = estimate.height_m - truth_m
    result.height_within_10cm = float(abs(result.height_error_m) <= 0.10)
    low_m, high_m = (height - truth_m for height in estimate.height_range_m)
    band_m = (low_m - MARGIN_M, high_m + MARGIN_M)
    maps = DriveMaps()
    kept: list[fusion.Denoised] = []
    for index, (pair, registration) in enumerate(zip(pairs, found, strict=True)):
        began = time.perf_counter()
        repaired = fusion.denoise(pair.scan, [image.depth for image in pair.images], estimate)
        result.tally.add("denoise_ms", [1e3 * (time.perf_counter() - began)])
        score_pair(pair, repaired, band_m, result.tally)
        maps.add(pair, repaired.ranges_m)
        kept.append(repaired)
        if index % EVERY_MODEL == 0:
            score_recall(pair, estimate, result.tally)
            score_models(pair, registration, estimate, band_m, result.tally)
    low, high = (float(drive.rig.lidar.T_base_laser.z()) + off for off in (-0.02, 0.02))
    before, after = maps.scores(true_grid(drive.home, low, high, 0.05))
    result.maps = {
        "completeness_before": before.completeness,
        "completeness_after": after.completeness,
        "false_occupied_before": before.false_occupied,
        "false_occupied_after": after.false_occupied,
    }
    if pictures:
        result.pictures = _pictures(pairs, found, kept, before.states, after.states)
    return result


def register_pair(pair: TruePair, result: DriveResult) -> fusion.Registration:
    """Register a pair our way and the paper's; count how near both came."""
    images = [image.depth for image in pair.images]
    began = time.perf_counter()
    ours = fusion.register(pair.scan, images)
    result.tally.add("register_ms", [1e3 * (time.perf_counter() - began)])
    began = time.perf_counter()
    rows = register_rows(pair.scan, images)
    result.tally.add("register_pcc_ms", [1e3 * (time.perf_counter() - began)])
    plain = register_by_pcc(ours.curve, ours.stacks)
    near = {name: abs(at.yaw_rad) <= 2.0 * SAMPLE_STEP_RAD for name, at in
            (("ours", ours), ("rows", rows), ("pcc", plain))}  # fmt: skip
    high = fusion.Grade.HIGH
    result.tally.add("high", [ours.grade == high])
    result.tally.add("high_pcc", [plain.grade == high])
    for name, key, at in (("u_within_2", "ours", ours), ("u_within_2_pcc", "pcc", plain),
                          ("u_within_2_rows", "rows", rows)):  # fmt: skip
        if at.grade == high:
            result.tally.add(name, [near[key]])
    for name, at in (("rows", rows), ("heights", ours)):
        result.grades[name][(pair.room, at.grade.name)] += 1
        stack = join(at.stacks).curve(at.v)
        camera, lidar = matched_points(at.curve, stack, at.yaw_rad)
        if len(camera):
            apart = np.abs(np.linalg.norm(camera, axis=1) - np.linalg.norm(lidar, axis=1))
            result.tally.add(f"residual_{name}", [float(np.median(apart))])
    _separations(rows, result.tally)
    return ours


def _separations(rows: fusion.Registration, tally: Tally) -> None:
    """How far each similarity's peak stands out of its own map, in the similarity's units: Fig. 4."""
    sums = masked_sums(join(rows.stacks).ranges_m, rows.curve.ranges_m)
    for name in SIMILARITIES:
        scores = similarity_map(sums, name)
        v, u = np.unravel_index(np.argmax(scores), scores.shape)
        far = np.abs(np.arange(scores.shape[1]) - u) > 5
        if far.any():
            tally.add(f"separation_{name}", [float(scores[v, u] - np.median(scores[:, far]))])


def score_models(
    pair: TruePair,
    registration: fusion.Registration,
    rig: fusion.RigEstimate,
    band_m: tuple[float, float],
    tally: Tally,
) -> None:
    """Repair one high-grade pair by itself with every model, and by the rig, and score them alike."""
    if registration.grade != fusion.Grade.HIGH:
        return
    images = [image.depth for image in pair.images]
    for model in (*MODELS, "rig"):
        if model in ("rig", "rigid"):
            repaired = fusion.denoise(pair.scan, images, rig if model == "rig" else registration)
        else:
            rng = np.random.default_rng(0)
            maps = [fit(*pairs, model, rng) for pairs in matched_curves(registration)]
            repaired = repair_by(pair.scan, tuple(images), registration, maps, least_probability=0.95)
        own = Tally()
        score_pair(pair, repaired, band_m, own)
        tally.merge(own.named(f"{model}_"))


def _pictures(
    pairs: list[TruePair],
    found: list[fusion.Registration],
    kept: list[fusion.Denoised],
    before: NDArray[np.int8],
    after: NDArray[np.int8],
) -> dict[str, Any]:
    """What the page draws of a drive: the pair with the most repairs, and two maps."""
    best = int(np.argmax([_repairs(repaired) for repaired in kept]))
    images = [image.depth for image in pairs[best].images]
    return {**pair_pictures(pairs[best].scan, images, found[best], kept[best]), "states": (before, after)}


def _repairs(repaired: fusion.Denoised) -> int:
    """How much of a pair was repaired; a beam weighs as much as a column of pixels."""
    lidar = np.isin(repaired.lidar_source, (fusion.Provenance.FILLED, fusion.Provenance.INTERPOLATED))
    pixels = sum(int((source == fusion.Provenance.FILLED).sum()) for source in repaired.depth_source)
    return int(lidar.sum()) + pixels // 40


def pair_pictures(
    scan: fusion.LidarCurve,
    images: list[fusion.DepthImage],
    registration: fusion.Registration,
    repaired: fusion.Denoised,
) -> dict[str, Any]:
    """What the page draws of one pair: the score maps of the paper, and before and after."""
    stacks = tuple(row_curves(image) for image in images)
    curve = resample(scan)
    sums = masked_sums(join(stacks).ranges_m, curve.ranges_m)
    return {
        "scan": scan,
        "images": images,
        "repaired": repaired,
        "heights": registration,
        "rows": register_by_pcc(curve, stacks),
        "maps": {name: similarity_map(sums, name) for name in SIMILARITIES},
    }
