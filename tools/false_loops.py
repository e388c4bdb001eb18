"""Inject false loops among the true ones of a log, and measure what they do to the map.

    python tools/false_loops.py [--data ../shared/data] [--log fr079] [--count 30] [--seeds 2] [--set k=v]
    python tools/false_loops.py --log CAMPUS/scans.log --kind mixed --count 100
    python tools/false_loops.py --finished MAP [--finished MAP] [--count 30] [--seeds 2]

The false loops carry the covariances of true ones and come through the door of the true ones,
`slam.mapper.mapper.Mapper.add_loop`. Four kinds:

- ``random``: two keyframes far apart, a relative pose anywhere in the building;
- ``alike``: two keyframes far apart, said to be nearly the same place, as where two rooms look alike;
- ``runs``: five keyframes in a row said to be one other place, and agreeing with each other;
- ``mixed``: twenty such keyframes in a row, the rest at random.

They come at the end, just before the final optimisation, or while mapping, as soon as their keyframe is
there, where they also bend the estimate that later loops are proposed from.
Exit code 1 where the error grows by the limit of ``--limit`` or more.

With ``--finished`` they are forced into the graph of a finished map, and nothing refuses them: how soon are
they found? Loops are ranked at the bent map, by how far it moves without each, by how far it misses each, and
by how far the map without each misses it; and by data snooping, where the last of these is asked again after
the worst loop has been left out and the map solved again: one loop after the other, or also all loops between
the same two stretches of the way as one. Told is how many of the false are among so many first of the ranking
as there are false ones and a tenth, and a half; and how many loops, true ones too, were left out until none
was beyond the gate.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import gate
from slam import load_map
from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.estimates import MotionEstimate
from slam.evaluation.relations import Relations, read_relations, score_relations
from slam.graph.closings import loop_groups
from slam.graph.edge import Edge
from slam.graph.held_graph import held_graph
from slam.graph.influence import LinearMap
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.map_result import MapResult
from slam.mapper.mapper import Mapper
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, LaserScan, Pose, pose2_from_row
from slam.storage.map_contents import MapContents

KINDS = ("random", "alike", "runs", "mixed")
MOMENTS = ("end", "mapping")
RUN_LENGTH, LONG_RUN_LENGTH = 5, 20
RUN_STRIDE = 4  # keyframes from one false loop of a run to the next: as far apart as true ones
FAR_M = 5.0  # a claim at least so wrong is false
ALIKE_SIGMAS = np.array([0.3, 0.3, 0.1])


@dataclass(frozen=True)
class Outcome:
    """What one set of false loops did; errors are means over the relations, ``moved_m`` is of the worst."""

    kind: str
    moment: str
    seed: int
    injected: int
    refused: int
    reported: int
    true_accepted: int
    true_accepted_before: int
    translation_m: float
    rotation_deg: float
    translation_growth: float
    rotation_growth: float
    moved_m: float


def main() -> None:
    """Map once as it is, then once for every kind, moment and seed; or search in finished maps."""
    options = parse_options()
    if options.finished:
        search(options)
        return
    log = Path(options.log)
    if not log.is_file():
        log = options.data / "lidar2d" / options.log / f"{options.log}.log.gz"
    relations = read_relations(next(log.parent.glob("*.relations")))
    config = load_config(None, options.set)
    before = map_log(log, config, [], None)
    score = errors(before, relations)
    accepted = sum(loop.accepted for loop in before.map.loops)
    print(f"{options.log}: {accepted} of {len(before.map.loops)} loops accepted", end=", ")
    print(f"{score[0]:.4f} m, {score[1]:.3f} deg\n")
    print(
        "| false loops | come | seed | refused | reported | true loops | m | growth | deg | growth | by m |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    outcomes = []
    for kind in options.kind or KINDS:
        for moment in options.moment or MOMENTS:
            for seed in range(options.seeds):
                rng = np.random.default_rng(seed)
                false = false_loops(kind, options.count, before.map, rng)
                # Loops do not touch the tracking: the keyframes are the same scans in every run.
                come_at = before.map.readings if moment == "mapping" else None
                after = map_log(log, config, false, come_at)
                outcomes.append(judge(kind, moment, seed, false, before, after, relations))
                print(row(outcomes[-1]), flush=True)
    if options.json:
        options.json.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=2) + "\n")
    worst = max(outcome.translation_growth for outcome in outcomes)
    print(f"\ngreatest growth of the translation error {worst:+.1%}, limit {options.limit:.0%}")
    unreported = sum(outcome.injected - outcome.reported for outcome in outcomes)
    if worst >= options.limit or unreported:
        sys.exit(1)


def parse_options() -> Namespace:
    """The command line."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    default_data = Path(__file__).parents[1] / ".." / "shared" / "data"
    parser.add_argument("--data", type=Path, default=default_data, help="folder that holds lidar2d/")
    parser.add_argument("--log", default="fr079", help="a name, or a file with a .relations beside it")
    parser.add_argument("--count", type=int, default=30, help="false loops a run")
    parser.add_argument("--seeds", type=int, default=2, help="this many seeds, from 0")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this kind; repeatable")
    parser.add_argument("--moment", action="append", choices=MOMENTS, help="only then; repeatable")
    parser.add_argument("--finished", type=Path, action="append", help="a map; repeatable")
    parser.add_argument("--limit", type=float, default=0.1, help="greatest growth of the error allowed")
    parser.add_argument("--set", action="append", default=[], help="as in scanweave map --set")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    return parser.parse_args()


def map_log(
    log: Path, config: Config, false: list[LoopCandidate], come_at: NDArray[np.int64] | None
) -> MapResult:
    """Map a log with false loops, each added after the scan ``come_at[keyframe]``, or all at the end."""
    mapper = Mapper(config, PlanarRobot(config))
    waiting = sorted(false, key=lambda loop: loop.keyframe, reverse=True)
    for measurement in open_dataset(log):
        mapper.add(measurement)
        if isinstance(measurement, LaserScan):
            while come_at is not None and waiting and come_at[waiting[-1].keyframe] < mapper.scan_count:
                mapper.add_loop(waiting.pop())
    while waiting:
        mapper.add_loop(waiting.pop())
    return mapper.finish()


def false_loops(kind: str, count: int, true: MapContents, rng: np.random.Generator) -> list[LoopCandidate]:
    """``count`` false loops with the covariances of true ones."""
    if kind == "mixed":
        long = min(LONG_RUN_LENGTH, count)
        singles = false_loops("random", count - long, true, rng)
        return singles + _false_runs("runs", long, long, true, rng)
    return _false_runs(kind, count, RUN_LENGTH if kind == "runs" else 1, true, rng)


def _false_runs(
    kind: str, count: int, length: int, true: MapContents, rng: np.random.Generator
) -> list[LoopCandidate]:
    """The same in runs of a length; the last may be shorter."""
    poses, span = true.keyframe_poses, max(length, RUN_LENGTH) * RUN_STRIDE
    models = [loop.motion for loop in true.loops if loop.accepted and loop.motion is not None]
    loops: list[LoopCandidate] = []
    while len(loops) < count:
        place, keyframe = sorted(rng.integers(0, len(poses) - span, 2).tolist())
        claim = claimed_pose(kind, poses, place, rng)
        wrong = between(claim, poses[keyframe])
        if keyframe - place < span or np.hypot(wrong[0], wrong[1]) < FAR_M:
            continue
        for step in range(min(length, count - len(loops))):
            member = keyframe + step * RUN_STRIDE
            # The members of a run agree: each moves from the claim as the robot truly moved.
            pose = compose(claim, between(poses[keyframe], poses[member]))
            model = models[rng.integers(len(models))]
            loops.append(candidate(place, member, between(poses[place], pose), model))
    return loops


def claimed_pose(kind: str, poses: FloatArray, place: int, rng: np.random.Generator) -> FloatArray:
    """Where a false loop says that its keyframe is, (3,) in the map frame."""
    if kind == "random":
        low, high = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
        return np.array([*rng.uniform(low, high), rng.uniform(-np.pi, np.pi)])
    return compose(poses[place], ALIKE_SIGMAS * rng.standard_normal(3))


def candidate(place: int, keyframe: int, pose: FloatArray, model: MotionEstimate) -> LoopCandidate:
    """A false loop that looks as certain as the true one whose trust it borrows."""
    motion = replace(model, T_reference_base=pose2_from_row(pose))
    return LoopCandidate(place, keyframe, 1.0, 0.3, 1.0, motion, True, "")


def search(options: Namespace) -> None:
    """Force false loops into finished maps, and tell how soon they are found."""
    few, more = round(1.1 * options.count), round(1.5 * options.count)
    names = ("shift", "residual", "left out", "one by one", "and by stretches")
    print(f"false ones among the first {few}, {more}\n")
    print(
        "| map | false loops | seed | " + " | ".join(names) + " | left out, of them true | and by stretches |"
    )
    print("|---|---|---|" + "---|" * (len(names) + 2))
    for path in options.finished:
        found = load_map(path)
        true = [factor.edge for factor in found.factors if factor.kept]
        for kind in options.kind or KINDS:
            for seed in range(options.seeds):
                false = false_loops(kind, options.count, found.contents, np.random.default_rng(seed))
                edges = true + [loop.edge(len(found.loops) + n) for n, loop in enumerate(false)]
                cells = [str(path), kind, str(seed)]
                rankings, gates = ranked(
                    found.contents.node_poses, edges, found.config.match.local_map_keyframes, more
                )
                for ranking in rankings:
                    cells.append(", ".join(str(np.sum(ranking[:most] >= len(true))) for most in (few, more)))
                for left in gates:
                    cells.append(f"{len(left)}, {np.sum(left < len(true))}")
                print("| " + " | ".join(cells) + " |", flush=True)
        found.close()


def ranked(
    found: Sequence[Pose], edges: Sequence[Edge], keyframes: int, most: int
) -> tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]:
    """The numbers of loops by each ranking, and what snooping leaves out up to its gate."""
    kept = np.ones(len(edges), np.bool_)
    poses = solved(found, edges)
    loops = np.array([number for number, edge in enumerate(edges) if edge.loop is not None])
    effect = LinearMap(poses, edges, kept).influences(loops)
    rankings = [loops[np.argsort(-values)] for values in (effect.shifts_m, effect.residuals, effect.left_out)]
    ends = np.array([(edges[loop].source, edges[loop].target) for loop in loops])
    gates = []
    for reach in (0, keyframes):
        order, within = snooped(poses, edges, loops, ends, reach, most)
        rankings.append(order)
        gates.append(order[:within])
    return rankings, gates


def snooped(
    poses: Sequence[Pose],
    edges: Sequence[Edge],
    loops: NDArray[np.int64],
    ends: NDArray[np.int64],
    reach: int,
    most: int,
) -> tuple[NDArray[np.int64], int]:
    """Loops in the order in which they are left out, and how many before the first within its gate.

    As ``S.snoop`` in ``templates/page/influence.js``: each time the loop, or all those whose ends lie within
    a reach of each other, that the map without them is farthest off, against their gate.
    """
    kept, within = np.ones(len(edges), np.bool_), None
    order: list[int] = []
    while len(order) < len(loops) and (len(order) < most or within is None):
        linear, left = LinearMap(poses, edges, kept), np.flatnonzero(kept[loops])
        units = [left[[n]] for n in range(len(left))]
        if reach:
            units += [
                left[group] for group in loop_groups(ends[left].astype(np.float64), reach) if len(group) > 1
            ]
        shares = [
            float(linear.influences(loops[unit][None]).left_out[0]) ** 2 / gate(3 * len(unit))
            for unit in units
        ]
        worst = int(np.argmax(shares))
        if within is None and shares[worst] <= 1.0:
            within = len(order)
        kept[loops[units[worst]]] = False
        order += loops[units[worst]].tolist()
        poses = solved(poses, [edge for edge, keep in zip(edges, kept, strict=True) if keep])
    return np.array(order), len(order) if within is None else within


def solved(poses: Sequence[Pose], edges: Sequence[Edge]) -> list[Pose]:
    """Where plain least squares puts the nodes in the plane."""
    values = gtsam.LevenbergMarquardtOptimizer(*held_graph(poses, edges)).optimize()
    return [values.atPose2(node) for node in range(len(poses))]


def errors(result: MapResult, relations: Relations) -> tuple[float, float]:
    """Mean errors over the relations: metres, degrees."""
    score = score_relations(result.map.trajectory, relations).all
    return score.translation_m.mean, float(np.degrees(score.rotation_rad.mean))


def judge(
    kind: str,
    moment: str,
    seed: int,
    false: list[LoopCandidate],
    before: MapResult,
    after: MapResult,
    relations: Relations,
) -> Outcome:
    """Count and score a run with false loops against the run without."""
    # A candidate is replaced when it is refused; its motion goes along.
    injected = {id(loop.motion) for loop in false}
    found = [loop for loop in after.map.loops if id(loop.motion) in injected]
    (old_m, old_deg), (new_m, new_deg) = errors(before, relations), errors(after, relations)
    return Outcome(
        kind=kind,
        moment=moment,
        seed=seed,
        injected=len(false),
        refused=sum(not loop.accepted and bool(loop.reason) for loop in found),
        reported=len(found),
        true_accepted=sum(loop.accepted for loop in after.map.loops) - sum(loop.accepted for loop in found),
        true_accepted_before=sum(loop.accepted for loop in before.map.loops),
        translation_m=new_m,
        rotation_deg=new_deg,
        translation_growth=new_m / old_m - 1.0,
        rotation_growth=new_deg / old_deg - 1.0,
        moved_m=float(
            np.linalg.norm(after.map.trajectory.positions_m - before.map.trajectory.positions_m, axis=1).max()
        ),
    )


def row(outcome: Outcome) -> str:
    """One line of the table."""
    return (
        f"| {outcome.kind} | {outcome.moment} | {outcome.seed} | {outcome.refused} of {outcome.injected} "
        f"| {outcome.reported} | {outcome.true_accepted} (before {outcome.true_accepted_before}) "
        f"| {outcome.translation_m:.4f} | {outcome.translation_growth:+.1%} "
        f"| {outcome.rotation_deg:.3f} | {outcome.rotation_growth:+.1%} | {outcome.moved_m:.3f} |"
    )


if __name__ == "__main__":
    main()
