"""How uncertain is what many keyframes tell together: lengths, areas, anything linear in their poses."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy import sparse

from slam.graph.edge import Edge
from slam.graph.relative_uncertainty import inverse
from slam.measurements import FloatArray


def joint_covariance(
    poses: Sequence[gtsam.Pose2], edges: Sequence[Edge], jacobian: sparse.csr_matrix | FloatArray
) -> FloatArray:
    """Covariance of what depends on the poses of a planar graph, by one factorisation of its information.

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
    count = len(poses)
    rows = np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
    source, target = (
        np.array([getattr(edge, end) for edge in edges], dtype=np.int64) for end in ("source", "target")
    )
    whitening = np.linalg.cholesky(np.linalg.inv([edge.covariance for edge in edges])).transpose(0, 2, 1)
    # Log(measured^-1 source^-1 target) moves with the target, and against the source as the target sees it.
    adjoints = _adjoints(rows[target], rows[source])
    blocks = np.concatenate([-(whitening @ adjoints), whitening], axis=2)
    at = 3 * np.arange(len(edges))[:, None, None] + np.arange(3)[:, None] + np.zeros((1, 6), np.int64)
    nodes = np.concatenate([3 * source[:, None] + np.arange(3), 3 * target[:, None] + np.arange(3)], axis=1)
    whole = sparse.coo_matrix(
        (blocks.ravel(), (at.ravel(), np.broadcast_to(nodes[:, None, :], blocks.shape).ravel())),
        shape=(3 * len(edges), 3 * count),
    ).tocsr()[:, 3:]
    free = sparse.csr_matrix(jacobian)[:, 3:]
    solved = sparse.linalg.splu((whole.T @ whole).tocsc()).solve(free.T.toarray())
    covariance = np.asarray(free @ solved)
    return np.asarray(0.5 * (covariance + covariance.T))


def _adjoints(frames: FloatArray, others: FloatArray) -> FloatArray:
    """(N, 3, 3) from the tangent of each pose to that of a frame which sees it."""
    seen = inverse(frames)
    cos, sin = np.cos(frames[:, 2]), np.sin(frames[:, 2])
    x = seen[:, 0] + cos * others[:, 0] + sin * others[:, 1]
    y = seen[:, 1] - sin * others[:, 0] + cos * others[:, 1]
    turn = others[:, 2] - frames[:, 2]
    adjoint = np.zeros((len(frames), 3, 3))
    adjoint[:, 0, 0] = adjoint[:, 1, 1] = np.cos(turn)
    adjoint[:, 1, 0], adjoint[:, 0, 1] = np.sin(turn), -np.sin(turn)
    adjoint[:, 0, 2], adjoint[:, 1, 2], adjoint[:, 2, 2] = y, -x, 1.0
    return adjoint
