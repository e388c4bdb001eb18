"""Localise the rest of a log in the map of its beginning: random starts, tracking, teleports, other logs.

The truth is the full run's own trajectory, seen from the nearest of the mapped readings, which both runs
have: how the two maps bend against each other over their length is not the localiser's error. For comparison
the tracking error is also given against the full run aligned as a whole. Travel counts as mapped where the
true pose explains most of the scan.

With ``--drawn`` the robot is localised in the map's picture alone, or a worse one: see `tools.drawn_maps`.
Truth, starts and the mapped part stay those of the map itself. With ``--told`` every start is given as well
as a person points at it (``right``), or is given at the place of another one (``wrong``).

Of a folder of ``scanweave simulate --campus`` the map is drawn from the true poses, so that no error of the
map is the localiser's, and the drive, tracked and found from random starts, has all its faults.
"""

from __future__ import annotations

import math
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.estimation import gate
from slam.app.localizing import START_SIGMA
from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.estimates import Trajectory
from slam.localization.global_search import at_once, search_map
from slam.localization.known_map import Walls
from slam.localization.localizer import Localizer
from slam.localization.output import LocalizerOutput, State
from slam.localization.planar_sensor import PlanarSensor
from slam.localization.poses import Measured
from slam.localization.scan_view import ScanView, first_in_cells
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.layered_map import OCCUPANCY
from slam.matching.planar import between, compose
from slam.measurements import (
    FloatArray,
    LaserScan,
    Measurement,
    WheelOdometry,
    pose2_from_row,
    row_from_pose2,
)
from slam.storage.map_contents import MapContents
from slam.storage.tum import read_tum
from tools.drawn_maps import DRAWN, drawn

RIGHT_M, RIGHT_RAD = 0.25, np.radians(5.0)
MAPPED_SHARE = 0.6
WITHIN_M = 10.0
CONFIDENT = 0.5
OFF_M = 0.5


@dataclass(frozen=True)
class Case:
    """A log, the map of its beginning, and the true pose (n, 3) of every reading in that map's frame.

    ``aligned`` is the same by one alignment of the whole run.
    """

    name: str
    log: list[Measurement]
    split: int
    known_map: MapContents
    truth: FloatArray
    aligned: FloatArray
    mapped: FloatArray
    config: Config


def main() -> None:
    """Run all trials and print Markdown tables."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument(
        "logs", nargs="+", help="as in fr079.log.gz:0.6, a log or a campus, and the share that is mapped"
    )
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drawn", choices=DRAWN, help="in the picture of the map alone")
    parser.add_argument("--told", choices=("right", "wrong"), help="tell where each start is")
    parser.add_argument("--set", action="append", default=[], help="as in scanweave localize --set")
    arguments = parser.parse_args()
    config = load_config(None, arguments.set)
    named = [argument.rsplit(":", 1) for argument in arguments.logs]
    for path, share in named:
        if Path(path).is_dir():
            print(f"\n## {path}\n")
            case = campus_case(Path(path), float(share), config)
            tracking_trial(case)
            starts_trial(case, arguments.starts, np.random.default_rng(arguments.seed))
    cases = [build_case(path, share, config) for path, share in named if not Path(path).is_dir()]
    if arguments.drawn:
        cases = [replace(case, known_map=drawn(case.known_map, arguments.drawn)) for case in cases]
    for case in cases:
        rng = np.random.default_rng(arguments.seed)
        print(f"\n## {case.name}\n")
        search_trial(case, rng)
        starts_trial(case, arguments.starts, rng, arguments.told)
        tracking_trial(case)
        teleport_trial(case)
        for other in cases:
            if other is not case:
                stranger_trial(case, other)


def build_case(path: str, share: str, config: Config) -> Case:
    """Map all of a log and its beginning."""
    log = [m for m in open_dataset(Path(path)) if isinstance(m, LaserScan | WheelOdometry)]
    split = int(float(share) * len(log))
    full, part = mapped_run(log, config), mapped_run(log[:split], config)
    begun = part.map.trajectory.to_planar()
    truth = full.map.trajectory.to_planar()
    T_part_full = aligned(truth[:split], begun)
    whole = np.array([compose(T_part_full, pose) for pose in truth])
    truth = whole.copy()
    for n in range(split, len(log)):
        turned = np.abs((whole[:split, 2] - whole[n, 2] + np.pi) % (2.0 * np.pi) - np.pi)
        near = int(np.argmin(np.hypot(*(whole[:split, :2] - whole[n, :2]).T) + 0.5 * turned))
        truth[n] = compose(begun[near], between(whole[near], whole[n]))
    known_map = part.map
    mapped = mapped_shares(log, split, known_map, truth, config)
    return Case(Path(path).name, log, split, known_map, truth, whole, mapped, config)


def campus_case(folder: Path, share: float, config: Config) -> Case:
    """A simulated campus, its beginning drawn from the true poses; readings of wheels have none."""
    log = [m for m in open_dataset(folder / "scans.log") if isinstance(m, LaserScan | WheelOdometry)]
    numbers = [n for n, m in enumerate(log) if isinstance(m, LaserScan)]
    truth = np.full((len(log), 3), np.nan)
    truth[numbers] = read_tum(folder / "groundtruth.txt").to_planar()
    begun = numbers[: int(share * len(numbers))]
    scans = [scan for scan in (log[n] for n in begun) if isinstance(scan, LaserScan)]
    grid = grid_of_keyframes(scans, truth[begun], config)
    stamps_s = np.array([scan.stamp_s for scan in scans])
    known_map = MapContents(
        [pose2_from_row(pose) for pose in truth[begun]],
        stamps_s,
        np.arange(len(scans)),
        Trajectory.from_planar(stamps_s, truth[begun]),
        keyframe_scans=scans,
        grids={} if grid is None else {OCCUPANCY: grid},
    )
    split = numbers[len(begun)]
    mapped = mapped_shares(log, split, known_map, truth, config)
    return Case(folder.name, log, split, known_map, truth, truth, mapped, config)


def mapped_shares(
    log: list[Measurement], split: int, known_map: MapContents, truth: FloatArray, config: Config
) -> FloatArray:
    """(n,) share of each scan after the beginning that the map explains at its true pose; 0 of the others."""
    sensor = PlanarSensor(Walls(known_map, config), config)
    mapped = np.zeros(len(log))
    for n in range(split, len(log)):
        scan = log[n]
        if isinstance(scan, LaserScan):
            motion = sensor.align(ScanView.of(scan, config), pose2_from_row(truth[n]))
            mapped[n] = 0.0 if motion is None else motion.inlier_share
    return mapped


def mapped_run(log: Iterable[Measurement], config: Config):  # type: ignore[no-untyped-def]
    """The map of a log."""
    mapper = Mapper(config, PlanarRobot(config))
    for measurement in log:
        if isinstance(measurement, LaserScan | WheelOdometry):
            mapper.add(measurement)
    return mapper.finish()


def aligned(source: FloatArray, target: FloatArray) -> FloatArray:
    """T_target_source (3,) by the positions of two (n, 3) trajectories."""
    a, b = source[:, :2].mean(0), target[:, :2].mean(0)
    h = (source[:, :2] - a).T @ (target[:, :2] - b)
    yaw = np.arctan2(h[0, 1] - h[1, 0], h[0, 0] + h[1, 1])
    turned = np.array([np.cos(yaw) * a[0] - np.sin(yaw) * a[1], np.sin(yaw) * a[0] + np.cos(yaw) * a[1]])
    return np.array([*(b - turned), yaw])


def scans_of(case: Case, *, room_m: float = WITHIN_M) -> list[int]:
    """Numbers of the scans after the mapped part that have so much mapped travel before them."""
    scans = [n for n in range(case.split, len(case.log)) if isinstance(case.log[n], LaserScan)]
    steps = np.hypot(*np.diff(case.truth[scans, :2], axis=0).T) * (case.mapped[scans[1:]] >= MAPPED_SHARE)
    left = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])
    return [scan for scan, path_m in zip(scans, left, strict=True) if path_m >= room_m]


def error_of(output: LocalizerOutput, truth: FloatArray) -> tuple[float, float]:
    """Metres and radians by which a pose is wrong."""
    assert output.pose is not None
    offset = between(truth, row_from_pose2(output.pose))
    return float(np.hypot(offset[0], offset[1])), abs(float(offset[2]))


def wrong(output: LocalizerOutput, truth: FloatArray) -> bool:
    """Whether a pose was reported for sure and is wrong."""
    if output.state is not State.TRACKING or output.confidence < CONFIDENT:
        return False
    error_m, error_rad = error_of(output, truth)
    return error_m > RIGHT_M or error_rad > RIGHT_RAD


def search_trial(case: Case, rng: np.random.Generator) -> None:
    """Time of a global search, by scans from everywhere."""
    walls = Walls(case.known_map, case.config)
    settings = case.config.localization
    walls_s, cpu_s = [], []
    for n in [scans_of(case)[0], *rng.choice(scans_of(case), 40)]:
        scan = case.log[n]
        assert isinstance(scan, LaserScan)
        points = ScanView.of(scan, case.config).points.points_base
        points = points[first_in_cells(points, settings.novel_cell_m)[0]]
        began, cpu = time.perf_counter(), time.process_time()
        at_once(search_map(walls.field, points, settings, settings.hypotheses))
        walls_s.append(time.perf_counter() - began)
        cpu_s.append(time.process_time() - cpu)
    print(
        f"global search: wall {np.median(walls_s[1:]):.3f} s median, {max(walls_s[1:]):.3f} s at most; "
        f"CPU {np.median(cpu_s[1:]):.3f} s median, {max(cpu_s[1:]):.3f} s at most"
    )


def starts_trial(case: Case, count: int, rng: np.random.Generator, given_start: str | None = None) -> None:
    """Localisation from random starts."""
    found, confident_and_wrong = 0, 0
    print("\n| start | first found after m | of them mapped | error m | degrees | wrong and sure |")
    print("|---|---|---|---|---|---|")
    starts = sorted(rng.choice(scans_of(case), count, replace=False))
    sigmas = np.array([START_SIGMA[0], *START_SIGMA])
    for n, start in enumerate(starts):
        known = None
        if given_start:
            true = case.truth[start if given_start == "right" else starts[n - count // 2]]
            pose = pose2_from_row(compose(true, sigmas * rng.standard_normal(3)))
            known = Measured(pose, np.diag(sigmas**2))
        path_m, mapped_m, first, errors = run_from(case, int(start), known)
        good = first is not None and mapped_m <= WITHIN_M and first[0] <= RIGHT_M and first[1] <= RIGHT_RAD
        found += good
        confident_and_wrong += errors
        reported = "never | | |" if first is None else f"{path_m:.1f} | {mapped_m:.1f} | {first[0]:.3f} |"
        turn = "" if first is None else f"{np.degrees(first[1]):.2f}"
        print(f"| {start} | {reported} {turn} | {errors} |", flush=True)
    print(
        f"\nright within {WITHIN_M:g} m of mapped travel: {found} of {count}; "
        f"wrong and sure: {confident_and_wrong}"
    )


def run_from(
    case: Case, start: int, known: Measured | None = None
) -> tuple[float, float, tuple[float, float] | None, int]:
    """Travel and mapped travel until found, the error there, and wrong outputs in the 10 m after it."""
    localizer = Localizer(case.known_map, case.config, start=known)
    path_m = mapped_m = 0.0
    found: tuple[float, float, tuple[float, float]] | None = None
    errors, last = 0, case.truth[start]
    for n in range(start, len(case.log)):
        output = localizer.add(case.log[n])
        if output is None:
            continue
        step_m = float(np.hypot(*(case.truth[n] - last)[:2]))
        last = case.truth[n]
        path_m += step_m
        mapped_m += step_m * (case.mapped[n] >= MAPPED_SHARE)
        errors += wrong(output, case.truth[n])
        if found is None and output.state is State.TRACKING:
            found = path_m, mapped_m, error_of(output, case.truth[n])
        if (found is None and mapped_m > WITHIN_M) or (found is not None and path_m > found[0] + 10.0):
            break
    return (path_m, mapped_m, None, errors) if found is None else (*found, errors)


def tracking_trial(case: Case) -> None:
    """The rest of the log in one go."""
    localizer = Localizer(case.known_map, case.config)
    said, spent_s = list[tuple[int, LocalizerOutput]](), list[float]()
    for n in range(case.split, len(case.log)):
        began = time.process_time()
        output = localizer.add(case.log[n])
        if output is not None:
            said.append((n, output))
            spent_s.append(time.process_time() - began)
    tracked = [(n, output) for n, output in said if output.state is State.TRACKING]
    errors = np.array([error_of(output, case.truth[n]) for n, output in tracked])
    apart = [error_of(output, case.aligned[n])[0] for n, output in tracked]
    in_map = case.mapped[[n for n, _ in tracked]] >= MAPPED_SHARE
    print(
        f"\ntracking {len(tracked)} of {len(said)} scans: error {np.median(errors[:, 0]):.4f} m, "
        f"{np.degrees(np.median(errors[:, 1])):.3f} degrees median; "
        f"99 % {np.quantile(errors[:, 0], 0.99):.3f} m; "
        f"in the mapped part {np.median(errors[in_map, 0]):.4f} m; "
        f"against the full run as a whole {np.median(apart):.4f} m; "
        f"wrong and sure: {sum(wrong(output, case.truth[n]) for n, output in said)}"
    )
    honesty(case, said)
    tracking = np.array([output.state is State.TRACKING for _, output in said])
    spent = np.array(spent_s)
    print(
        f"{tracking.sum() / max(spent[tracking].sum(), 1e-9):.0f} scans a CPU second while tracking; "
        f"{spent[~tracking].mean() if not tracking.all() else 0.0:.3f} CPU s a scan while not, "
        f"{np.quantile(spent[~tracking], 0.99) if not tracking.all() else 0.0:.3f} for 99 %, "
        f"{spent[~tracking].max(initial=0.0):.2f} at most"
    )


def honesty(case: Case, said: list[tuple[int, LocalizerOutput]]) -> None:
    """What is said of all poses, of those that are tracked and of those that are confident, by the truth."""
    in_map = case.mapped[[n for n, _ in said]] >= MAPPED_SHARE
    tracked = np.array([output.state is State.TRACKING for _, output in said])
    confident = tracked & np.array([output.confidence >= CONFIDENT for _, output in said])
    known = np.array([output.pose is not None for _, output in said])
    errors_m, held = np.zeros(len(said)), np.zeros(len(said), np.bool_)
    for i in np.flatnonzero(known).tolist():
        n, output = said[i]
        assert output.pose is not None and output.covariance is not None
        offset = between(row_from_pose2(output.pose), case.truth[n])[:2]
        errors_m[i] = np.hypot(*offset)
        held[i] = offset @ np.linalg.solve(output.covariance[:2, :2], offset) <= gate(2, 0.95)
    off = known & (errors_m > OFF_M)
    print(
        f"\nmapped scans: {in_map.sum()} of {len(said)}, tracked {(tracked & in_map).sum()}; others tracked: "
        f"{(tracked & ~in_map).sum()}; confident: {confident.sum()}, worst error "
        f"{errors_m[confident].max(initial=0.0):.2f} m; the 95 % ellipse holds the truth: "
        f"{(held & tracked).sum()} of {tracked.sum()} tracked, {held.sum()} of {known.sum()} poses; over "
        f"{OFF_M:g} m off: {off.sum()}, of these excluded by the ellipse: {(off & ~held).sum()}"
    )


def teleport_trial(case: Case) -> None:
    """The robot is carried off twice, each time to a mapped place far away."""
    scans = [n for n in scans_of(case) if case.mapped[n] >= 0.9]
    pieces, at = [], scans[0]
    for _ in range(3):
        piece = piece_of(case, at, 25.0)
        pieces.append(piece)
        far = [n for n in scans if np.hypot(*(case.truth[n] - case.truth[piece[-1]])[:2]) > 6.0]
        if not far:
            break
        at = far[len(far) // 2]
    localizer = Localizer(case.known_map, case.config)
    reported, confident_and_wrong = [], 0
    for piece in pieces:
        path_m, found_m, last = 0.0, math.nan, piece[0]
        for n in piece:
            output = localizer.add(case.log[n])
            if output is None:
                continue
            path_m += float(np.hypot(*(case.truth[n] - case.truth[last])[:2]))
            last = n
            confident_and_wrong += wrong(output, case.truth[n])
            right = output.state is State.TRACKING and error_of(output, case.truth[n])[0] <= RIGHT_M
            if math.isnan(found_m) and right:
                found_m = path_m
        reported.append(f"{found_m:.1f} m")
    print(f"\ncarried off {len(pieces) - 1} times: found after {', '.join(reported)}", end="; ")
    print(f"wrong and sure: {confident_and_wrong}")


def piece_of(case: Case, start: int, path_m: float) -> list[int]:
    """Numbers of the readings from a start on, for so much travel."""
    steps = np.hypot(*np.diff(case.truth[start:, :2], axis=0).T)
    return list(range(start, start + int(np.searchsorted(np.cumsum(steps), path_m))))


def stranger_trial(case: Case, other: Case) -> None:
    """A log of another building."""
    localizer = Localizer(case.known_map, case.config)
    tracked = scans = 0
    for measurement in other.log:
        output = localizer.add(measurement)
        if output is not None:
            scans += 1
            tracked += output.state is State.TRACKING
    print(f"\n{other.name} in this map: tracking in {tracked} of {scans} scans (0 is right)")


if __name__ == "__main__":
    main()
