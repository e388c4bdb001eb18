"""Covariance of quantities that are linear in many keyframe poses: lengths, areas and others."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy import sparse

from slam.graph.edge import Edge
from slam.graph.influence import linearized
from slam.measurements import FloatArray


def joint_covariance(
    poses: Sequence[gtsam.Pose2], edges: Sequence[Edge], jacobian: sparse.csr_matrix | FloatArray
) -> FloatArray:
    """Return the covariance of functions of planar poses, by one factorisation of the information.

    Parameters
    ----------
    poses
        (n,) at which the edges are linearised; node 0 is held.
    edges
        That hold all of them together, as uncertain as they are (`slam.graph.pose_covariances.told_edges`).
    jacobian
        (m, 3 n) of m numbers by GTSAM's tangent of every pose: forward, left, turn in the pose's own frame.

    Returns
    -------
    (m, m)
    """
    linear, _ = linearized(poses, edges)
    free = sparse.csr_matrix(jacobian)[:, 3:]
    solved = sparse.linalg.splu((linear.T @ linear).tocsc()).solve(free.T.toarray())
    covariance = np.asarray(free @ solved)
    return np.asarray(0.5 * (covariance + covariance.T))
