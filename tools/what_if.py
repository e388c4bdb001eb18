"""What the page says of a map that is solved again, against GTSAM: how exact, and how fast in Chromium.

    python tools/what_if.py MAP [MAP ...] [--loops 40] [--forced 20] [--chromium /usr/bin/chromium]

Of each map some loops are left out one at a time, half of them those that move the map most, the others
evenly chosen; and some refused candidates are forced in, those that the map misses least. Each time GTSAM
solves the graph again, to the last digit. Told are:

- the first-order influence (`slam.graph.influence`) over GTSAM's shift, of loops left out;
- the page's solver (`templates/page/solver.js`): its time, and how far any keyframe lies from GTSAM's.

Needs Playwright and Chromium. Of the page only the parts of its solver are loaded.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

import slam
from slam.evaluation.page_data import pose_rows
from slam.graph.edge import Edge
from slam.graph.held_graph import held_graph
from slam.graph.influence import Influences, LinearMap, all_edges, elimination_order
from slam.measurements import BoolArray, FloatArray, Pose
from slam.storage.tum import upper_triangles

PAGE = Path(slam.__file__).parent / "evaluation" / "templates" / "page"
PARTS = ("sparse", "lie", "solver")
SETUP = """({planar, poses, measured, covariance, source, target, order, on}) => {
  const began = performance.now();
  const edges = {source: Int32Array.from(source), target: Int32Array.from(target),
    measured: Float64Array.from(measured), covariance: Float64Array.from(covariance)};
  globalThis.solver = new Scanweave.Solver({planar, poses: Float64Array.from(poses), edges, order});
  globalThis.on = Uint8Array.from(on);
  globalThis.base = globalThis.solver.solve(globalThis.on).poses;
  return performance.now() - began;
}"""
SWITCH = """edge => {
  const {solver, on, base} = globalThis;
  on[edge] ^= 1;
  const {poses, milliseconds, loose} = solver.solve(on, base);
  on[edge] ^= 1;
  return {poses: Array.from(solver.rows(poses)), milliseconds, loose};
}"""


@dataclass(frozen=True)
class Graph:
    """A map's nodes and all edges that may hold it."""

    planar: bool
    poses: Sequence[Pose]
    edges: Sequence[Edge]
    kept: BoolArray

    def solved(self, kept: BoolArray) -> FloatArray:
        """(n, 2 or 3) where GTSAM puts the nodes."""
        exact = gtsam.LevenbergMarquardtParams()
        exact.setRelativeErrorTol(1e-14)
        exact.setAbsoluteErrorTol(1e-14)
        held = [edge for edge, keep in zip(self.edges, kept, strict=True) if keep]
        values = gtsam.LevenbergMarquardtOptimizer(*held_graph(self.poses, held), exact).optimize()
        at = values.atPose2 if self.planar else values.atPose3
        return np.array([at(node).translation() for node in range(len(self.poses))])

    def switched(self, edge: int) -> BoolArray:
        """Which edges hold, with one switched."""
        kept = self.kept.copy()
        kept[edge] ^= True
        return kept

    def page(self) -> dict[str, Any]:
        """For the page's solver."""
        return {
            "planar": self.planar,
            "poses": pose_rows(self.poses).ravel().tolist(),
            "measured": pose_rows([edge.T_source_target for edge in self.edges]).ravel().tolist(),
            "covariance": upper_triangles(np.array([edge.covariance for edge in self.edges]))
            .ravel()
            .tolist(),
            "source": [edge.source for edge in self.edges],
            "target": [edge.target for edge in self.edges],
            "order": elimination_order(len(self.poses), self.edges).tolist(),
            "on": self.kept.astype(int).tolist(),
        }


def main() -> None:
    """A row of each map, twice."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--loops", type=int, default=40, help="left out, of each map")
    parser.add_argument("--forced", type=int, default=20, help="refused candidates forced in, of each map")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    print(
        "| map | nodes | edges | loops | CPU s | in 15 % | worst | ms | worst | mm | forced ms | worst | mm |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=options.chromium, args=["--no-sandbox"])
        for path in options.maps:
            page = browser.new_page()
            page.evaluate("globalThis.Scanweave = {}")
            for part in PARTS:
                page.add_script_tag(path=PAGE / f"{part}.js")
            print(row(path, options, page.evaluate), flush=True)
            page.close()
        browser.close()


def row(path: Path, options: Namespace, evaluate: Callable[..., Any]) -> str:
    """Of one map."""
    found = slam.load_map(path)
    factors = found.factors
    edges = all_edges([factor.edge for factor in factors], found.loops)
    kept = np.array([factor.kept for factor in factors] + [False] * (len(edges) - len(factors)))
    graph = Graph(found.planar, found.contents.node_poses, edges, kept)
    began = time.process_time()
    effect = LinearMap(graph.poses, edges, kept).influences(
        [n for n, one in enumerate(edges) if one.loop is not None]
    )
    seconds = time.process_time() - began
    evaluate(SETUP, graph.page())
    base = graph.solved(kept)
    ratios, left_out = measure(graph, left_out_loops(effect, kept, options.loops), base, effect, evaluate)
    _, forced = measure(graph, refused_loops(effect, kept, options.forced), base, effect, evaluate)
    off = np.abs(ratios - 1.0)
    cells = [path.name, len(graph.poses), len(edges), len(effect.edges), f"{seconds:.2f}"]
    cells += [f"{np.mean(off <= 0.15):.0%}", f"{off.max():.1%}", *times(left_out), *times(forced)]
    found.close()
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def left_out_loops(effect: Influences, kept: BoolArray, count: int) -> list[int]:
    """Half are the strongest, the others evenly taken from what is left."""
    inside = [n for n in np.argsort(-effect.shifts_m) if kept[effect.edges[n]]]
    strong, rest = inside[: count // 2], inside[count // 2 :]
    even = rest[:: max(1, len(rest) // max(count - len(strong), 1))]
    return [int(n) for n in [*strong, *even]]


def refused_loops(effect: Influences, kept: BoolArray, count: int) -> list[int]:
    """Those that the map misses least."""
    outside = [n for n in np.argsort(effect.left_out) if not kept[effect.edges[n]]]
    return [int(n) for n in outside[:count]]


def measure(
    graph: Graph, chosen: Sequence[int], base: FloatArray, effect: Influences, evaluate: Callable[..., Any]
) -> tuple[FloatArray, FloatArray]:
    """Ratios of first order to GTSAM, and (n, 2) milliseconds and millimetres of the page."""
    ratios, rows = [], []
    for n in chosen:
        edge = int(effect.edges[n])
        exact = graph.solved(graph.switched(edge))
        ratios.append(effect.shifts_m[n] / distances(exact, base).max())
        answer = evaluate(SWITCH, edge)
        poses = np.array(answer["poses"]).reshape(len(exact), -1)[:, : exact.shape[1]]
        rows.append((answer["milliseconds"], 1e3 * distances(poses, exact).max()))
    return np.array(ratios), np.array(rows).reshape(-1, 2)


def distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """(n,) between rows."""
    apart: NDArray[np.float64] = np.linalg.norm(one - other, axis=1)
    return apart


def times(rows: FloatArray) -> list[str]:
    """Median and worst milliseconds, worst millimetres."""
    if not len(rows):
        return ["–"] * 3
    return [f"{np.median(rows[:, 0]):.0f}", f"{rows[:, 0].max():.0f}", f"{rows[:, 1].max():.4f}"]


if __name__ == "__main__":
    main()
