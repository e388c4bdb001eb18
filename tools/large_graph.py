"""Measure the cost of the pose graph of a very long drive: updates, final optimisation, covariances.

    python tools/large_graph.py [--keyframes 100000]

A robot drives at random through the streets of a town of 1 km by 1 km, with one keyframe per metre; at
revisited places, three in five keyframes close a loop, of which one in fifty is false. Nothing is matched:
only the graph is measured. CPU milliseconds per keyframe are means over the 5,000 before each line.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import gtsam
import numpy as np

from slam import heap
from slam.graph.edge import Edge, EdgeKind
from slam.graph.held_graph import marginals
from slam.graph.pose_graph import PoseGraph
from slam.measurements import FloatArray

BLOCK_M, BLOCKS = 50, 20
STEP = np.array([0.01, 0.01, 0.002])
LOOP = np.array([0.02, 0.02, 0.005])
EVERY = 5000


def main() -> None:
    """Drive, and print a line from time to time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=100_000)
    count = parser.parse_args().keyframes
    rng = np.random.default_rng(1)
    truth = streets(rng, count)
    graph, last_seen, false = PoseGraph(truth[0]), dict[tuple[float, float], int](), list[int]()
    loops, begun_s = 0, time.process_time()
    for key in range(1, count):
        step = noisy(rng, truth[key - 1], truth[key], STEP)
        graph.add_node(graph.pose(key - 1) * step)
        graph.add_edge(Edge(key - 1, key, step, np.diag(STEP**2), EdgeKind.LIDAR, True))
        place = round(truth[key].x()), round(truth[key].y())
        before = last_seen.get(place, key)
        if key - before > 100 and rng.random() < 0.6:
            measured = noisy(rng, truth[before], truth[key], LOOP)
            if rng.random() < 0.02:
                false.append(len(graph.edges))
                measured = gtsam.Pose2(*rng.normal(0.0, 1.0, 3))
            graph.add_edge(Edge(before, key, measured, np.diag(LOOP**2), EdgeKind.LOOP, False, loop=loops))
            loops += 1
        last_seen[place] = key
        graph.update()
        if key % EVERY == 0:
            each_ms = 1e3 * (time.process_time() - begun_s) / EVERY
            print(
                f"{key} keyframes, {loops} loops: {each_ms:.2f} ms a keyframe, {peak_mb():.0f} MB", flush=True
            )
            begun_s = time.process_time()
    begun_s = time.process_time()
    kept = graph.optimize().kept
    took_s = time.process_time() - begun_s
    off_m = np.linalg.norm(graph.planar_poses()[:, :2] - [[pose.x(), pose.y()] for pose in truth], axis=1)
    wrongly, refused = int(kept[false].sum()), int((~kept).sum())
    print(
        f"optimised in {took_s:.1f} CPU s, {peak_mb():.0f} MB; {np.sqrt(np.mean(off_m**2)):.2f} m off, worst "
        f"{off_m.max():.2f}; {wrongly} of {len(false)} false loops kept, {refused - len(false) + wrongly} of "
        f"{loops - len(false)} true ones refused"
    )
    heap.give_back()
    begun_s = time.process_time()
    marginals(
        [graph.pose(key) for key in range(count)],
        [edge for edge, keep in zip(graph.edges, kept, strict=True) if keep],
    )
    print(f"covariances in {time.process_time() - begun_s:.1f} CPU s, {peak_mb():.0f} MB")


def streets(rng: np.random.Generator, count: int) -> list[gtsam.Pose2]:
    """One pose per metre of a drive without U-turns."""
    corner, way, found = np.array([BLOCKS // 2, BLOCKS // 2]), np.array([1, 0]), list[gtsam.Pose2]()
    while len(found) < count:
        ways = [np.array(one) for one in ((1, 0), (-1, 0), (0, 1), (0, -1)) if (np.array(one) != -way).any()]
        inside = [one for one in ways if (corner + one).min() >= 0 and (corner + one).max() <= BLOCKS]
        way = inside[rng.integers(len(inside))]
        along: FloatArray = corner * BLOCK_M + np.arange(BLOCK_M)[:, None] * way
        found += [gtsam.Pose2(x, y, math.atan2(way[1], way[0])) for x, y in along.tolist()]
        corner = corner + way
    return found[:count]


def noisy(rng: np.random.Generator, one: gtsam.Pose2, other: gtsam.Pose2, sigmas: FloatArray) -> gtsam.Pose2:
    """The relative pose of two poses, with noise."""
    return one.between(other) * gtsam.Pose2(*rng.normal(0.0, sigmas))


def peak_mb() -> float:
    """Peak memory of this process so far."""
    (line,) = (one for one in Path("/proc/self/status").read_text().splitlines() if one.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    main()
