"""What the page needs to solve the map again: what each loop does to it, and an order of elimination."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.estimation import gate
from slam.config import Config
from slam.graph.influence import all_edges, elimination_order, influences
from slam.heap import give_back
from slam.storage.map_contents import MapContents


def what_if_data(found: MapContents, config: Config) -> dict[str, Any]:
    """Influence and order of elimination, see `slam.graph.influence`.

    Edges are those of the graph, and after them the matched loop candidates that never came into it, in
    order: so they are numbered in the page, too.
    """
    factors = [factor.edge for factor in found.factors]
    edges = all_edges(factors, found.loops)
    kept = [factor.kept for factor in found.factors] + [False] * (len(edges) - len(factors))
    size = 3 if found.planar else 6
    told = influences(found.node_poses, edges, kept)
    give_back()
    return {
        "influence": {
            "edge": told.edges.astype(np.int32),
            "shift_m": told.shifts_m.astype(np.float32),
            "node": told.nodes.astype(np.int32),
            "residual": told.residuals.astype(np.float32),
            "left_out": told.left_out.astype(np.float32),
            # Squared sigmas that one in a thousand true loops is beyond: of one loop, of two and so on.
            "gates": np.array([gate(size * n) for n in range(1, max(len(told.edges), 1) + 1)], np.float32),
            # Loops that lie within a local map of each other at both ends are one claim.
            "reach": config.match.local_map_keyframes,
        },
        "order": elimination_order(len(found.node_poses), edges).astype(np.int32),
    }
