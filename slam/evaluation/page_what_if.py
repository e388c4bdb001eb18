"""What the page needs to solve the map again: what each loop does to it, and an order of elimination."""

from __future__ import annotations

from typing import Any

import numpy as np

from slam.graph.influence import LinearMap, all_edges, elimination_order
from slam.storage.map_contents import MapContents


def what_if_data(found: MapContents) -> dict[str, Any]:
    """Influence and order of elimination, see `slam.graph.influence`.

    Edges are those of the graph, and after them the matched loop candidates that never came into it, in
    order: so they are numbered in the page, too.
    """
    factors = [factor.edge for factor in found.factors]
    edges = all_edges(factors, found.loops)
    loops = [number for number, edge in enumerate(edges) if edge.loop is not None]
    kept = [factor.kept for factor in found.factors] + [False] * (len(edges) - len(factors))
    told = LinearMap(found.node_poses, edges, kept).influences(loops)
    return {
        "influence": {
            "edge": told.edges.astype(np.int32),
            "shift_m": told.shifts_m.astype(np.float32),
            "node": told.nodes.astype(np.int32),
            "residual": told.residuals.astype(np.float32),
            "left_out": told.left_out.astype(np.float32),
        },
        "order": elimination_order(len(found.node_poses), edges).astype(np.int32),
    }
