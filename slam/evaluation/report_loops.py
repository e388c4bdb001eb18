"""Section of a map's page about its loops: which were accepted, which rejected and why, and their effect."""

from __future__ import annotations

import math
from collections import Counter

from slam.config import Config
from slam.evaluation.pages import render
from slam.graph.closings import closings
from slam.graph.loop_candidate import LoopCandidate
from slam.storage.map_contents import MapContents

# With more rows than this, accepted loops are folded, too, so that the page stays readable.
_MOST_OPEN_ROWS = 40
_MOST_CLOSINGS = 10


def loop_section(saved: MapContents, config: Config, degenerate: int = 0) -> str:
    """Return HTML; ``degenerate`` counts keyframes whose match has an undetermined direction."""
    accepted = [_score_cells(loop, saved, config) for loop in saved.loops if loop.accepted]
    refused = [(*_score_cells(loop, saved, config), loop.reason) for loop in saved.loops if not loop.accepted]
    return render(
        "loops.html",
        closings=_closings(saved, config),
        degenerate=degenerate,
        matches=len(saved.readings),
        accepted=accepted,
        refused=refused,
        most_open=_MOST_OPEN_ROWS,
        reasons=[(why, f"{count:,}") for why, count in Counter(row[-1] for row in refused).most_common()],
    )


def _closings(saved: MapContents, config: Config) -> list[tuple[str, ...]]:
    """Return the loops that corrected the largest errors, one row each."""
    inliers = [factor.edge for factor in saved.factors if factor.kept]
    # Place claims support each other over this path length.
    reach_m = 2.0 * config.loops.least_path_m
    rows = closings(inliers, saved.node_poses, reach_m, _MOST_CLOSINGS)
    return [
        (
            f"{row.place} to {row.keyframe}",
            str(row.loops),
            f"{row.path_m:,.0f} m",
            f"{row.before_m:.2f} m",
            f"{row.after_m:.3f} m",
            f"{row.after_sigmas:.1f}",
            "nothing" if math.isinf(row.without_m) else f"{row.without_m:.2f} m",
        )
        for row in rows
    ]


def _score_cells(loop: LoopCandidate, saved: MapContents, config: Config) -> tuple[str, ...]:
    """Return the numbers of one loop as text; a loop that was rejected before scoring has a dash."""
    poses = saved.keyframe_poses
    x, y = (poses[loop.keyframe] - poses[loop.place])[:2]
    score = "–" if loop.motion is None else f"{loop.motion.inlier_share:.3f}"
    distance = f"{math.hypot(x, y):.2f} m"
    return str(loop.keyframe), str(loop.place), distance, score, f"{config.loops.least_inlier_share:.3f}"
