"""Measure what the pose graph costs a keyframe as a walk through streets grows, and its final optimisation.

    python tools/graph_growth.py [--keyframes 2000 5000 10000] [--visits 3] [--final] [--profile]

A robot walks a grid of streets whose size goes with the number of keyframes, so that each street is passed
``--visits`` times. Every step has a match and a reading of the wheels; places that come near are joined by
loops, one in 50 of them false. CPU milliseconds a keyframe are given for the first and the last tenth of the
walk: of the search for relative uncertainty, and of the estimate's updates. ``--final`` adds the seconds of
the final optimisation, and its worst error.
"""

from __future__ import annotations

import argparse
import cProfile
import math
import resource
import time
from collections import defaultdict
from dataclasses import dataclass, field

import gtsam
import numpy as np

from slam.config.stages import GraphConfig, LoopConfig
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_closure import LoopCandidate
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row

STREET_M, STEP_M = 20.0, 0.25
MATCH = np.array([0.004, 0.004, 0.002])
WHEELS = np.array([0.04, 0.04, 0.03])
LOOP = np.array([0.01, 0.01, 0.005])
FALSE_SHARE = 0.02


def walk(keyframes: int, visits: float, rng: np.random.Generator) -> FloatArray:
    """(keyframes, 3) true poses along streets, the least passed one taken at each crossing."""
    metres = keyframes * STEP_M / visits
    side = max(1, round(math.sqrt(metres / (2.0 * STREET_M))))
    passed: dict[tuple[int, int, int, int], int] = defaultdict(int)
    at, heading, poses = (0, 0), 0, [np.zeros(3)]
    ways = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    while len(poses) < keyframes:
        choices = []
        for turn in (0, 1, -1):
            dx, dy = ways[(heading + turn) % 4]
            to = (at[0] + dx, at[1] + dy)
            if 0 <= to[0] <= side and 0 <= to[1] <= side:
                street = (*min(at, to), *max(at, to))
                choices.append((passed[street], rng.random(), turn, to, street))
        _, _, turn, to, street = min(choices)
        passed[street] += 1
        steps = 6 if turn else 0
        for _ in range(steps):
            poses.append(compose(poses[-1], np.array([0.0, 0.0, turn * math.pi / 2 / steps])))
        heading = (heading + turn) % 4
        # Each pass has a line of its own through the street.
        ahead = np.array([STREET_M * to[0], STREET_M * to[1]]) + rng.uniform(-0.8, 0.8, 2) - poses[-1][:2]
        count = max(1, round(math.hypot(*ahead) / STEP_M))
        turned = math.atan2(ahead[1], ahead[0]) - poses[-1][2]
        poses.append(compose(poses[-1], np.array([0.0, 0.0, turned])))
        for _ in range(count):
            poses.append(compose(poses[-1], np.array([math.hypot(*ahead) / count, 0.0, 0.0])))
        at = to
    return np.array(poses[:keyframes])


@dataclass
class Clock:
    """CPU seconds of every keyframe, by what was done."""

    rows: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def time(self, name: str, started: float) -> None:
        """Take the seconds since a moment."""
        self.rows[name].append(time.process_time() - started)

    def milliseconds(self, name: str, part: slice) -> float:
        """Mean of a part of the walk."""
        return 1e3 * float(np.mean(self.rows[name][part]))


class Drive:
    """The walk through a keyframe graph, as a front end would lead it."""

    def __init__(self, truth: FloatArray, rng: np.random.Generator, loops_a_keyframe: float) -> None:
        self.truth, self.rng, self.share = truth, rng, loops_a_keyframe
        self.config = LoopConfig()
        self.graph = KeyframeGraph(gtsam.Pose2(), GraphConfig())
        steps = np.diff(truth[:, :2], axis=0)
        self.travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
        self.clock = Clock()
        self.last_try_m = 0.0

    def run(self) -> None:
        """Keyframe after keyframe."""
        for key in range(1, len(self.truth)):
            edges = self.step(key)
            self.graph.add_keyframe(edges[0].T_source_target, edges)
            started = time.process_time()
            places = self.places(key)
            if len(places):
                self.graph.uncertainty.relative_covariances(key, places, self.graph.rows())
            self.clock.time("search", started)
            self.close(key, places)
            started = time.process_time()
            self.graph.update()
            self.clock.time("update", started)

    def measured(self, source: int, target: int, sigmas: FloatArray) -> FloatArray:
        """The true motion with noise."""
        return compose(between(self.truth[source], self.truth[target]), self.rng.normal(0.0, sigmas))

    def step(self, key: int) -> list[Edge]:
        """A match and the wheels."""
        return [
            Edge(
                key - 1, key, pose2_from_row(self.measured(key - 1, key, sigmas)), np.diag(sigmas**2), kind, t
            )
            for sigmas, kind, t in ((MATCH, EdgeKind.LIDAR, True), (WHEELS, EdgeKind.WHEEL, False))
        ]

    def places(self, key: int) -> np.ndarray:
        """As `LoopCloser` wants them: each near place that lies a while back, where a try is due."""
        if self.travelled[key] - self.last_try_m < self.config.every_m:
            return np.empty(0, np.int64)
        self.last_try_m = self.travelled[key]
        places = np.arange(0, key, self.config.half_keyframes)
        places = places[self.travelled[key] - self.travelled[places] > self.config.least_path_m]
        rows = self.graph.rows()
        away = np.hypot(*(rows[places, :2] - rows[key, :2]).T)
        return places[away <= self.config.reach_m + self.config.greatest_half_width_m]

    def close(self, key: int, places: np.ndarray) -> None:
        """Loops to the truly nearest place, and false ones."""
        away = np.hypot(*(self.truth[places, :2] - self.truth[key, :2]).T)
        turned = np.cos(self.truth[places, 2] - self.truth[key, 2])
        near = places[(away < self.config.reach_m)]
        if not len(near) or self.rng.random() > self.share * 4.0:
            return
        place = int(places[np.argmin(away - 0.1 * turned)])
        motion = self.measured(place, key, LOOP)
        if self.rng.random() < FALSE_SHARE:
            motion = compose(motion, self.rng.uniform(-1.0, 1.0, 3) * [2.0, 2.0, 0.3])
        certain = 0.9, 0.9, 0.01, True, False
        estimate = MotionEstimate(pose2_from_row(motion), np.diag(LOOP**2), *certain, np.zeros(3))
        self.graph.add_loop(LoopCandidate(place, key, 1.0, 0.1, 1.0, estimate, True, ""))


def measure(keyframes: int, options: argparse.Namespace) -> str:
    """One walk, as a line of the table."""
    rng = np.random.default_rng(options.seed)
    drive = Drive(walk(keyframes, options.visits, rng), rng, options.loops)
    drive.run()
    tenth = keyframes // 10
    figures = [f"{keyframes:7d} {len(drive.graph.loops):6d}"]
    for name in ("search", "update"):
        parts = [drive.clock.milliseconds(name, part) for part in (slice(tenth), slice(-tenth, None))]
        figures.append(f"{parts[0]:7.3f} {parts[1]:7.3f} {sum(drive.clock.rows[name]):7.1f}")
    rows = drive.graph.rows()
    figures.append(f"{float(np.hypot(*(rows - drive.truth)[:, :2].T).max()):7.3f}")
    if options.final:
        started = time.process_time()
        drive.graph.optimize(0.99)
        seconds = time.process_time() - started
        worst = float(np.hypot(*(drive.graph.rows() - drive.truth)[:, :2].T).max())
        refused = sum(not loop.accepted for loop in drive.graph.loops)
        figures.append(f"{seconds:7.2f} {worst:7.3f} {refused:5d}")
    figures.append(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:6.0f}")
    return "  ".join(figures)


def main() -> None:
    """Measure, and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, nargs="+", default=[2000, 5000, 10000])
    parser.add_argument("--visits", type=float, default=3.0, help="how often a street is passed")
    parser.add_argument("--loops", type=float, default=0.16, help="loops a keyframe, where a place is near")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--final", action="store_true")
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    print(
        "keyframes loops | search: first, last (ms), all (s) | update: the same | worst (m) | final ... | MB"
    )
    for keyframes in options.keyframes:
        if options.profile:
            with cProfile.Profile() as profile:
                print(measure(keyframes, options), flush=True)
            profile.dump_stats(f"graph_growth_{keyframes}.prof")
        else:
            print(measure(keyframes, options), flush=True)


if __name__ == "__main__":
    main()
