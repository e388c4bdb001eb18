"""Covariance of every keyframe in the map, calibrated so that ellipses contain the truth as often as stated.

The covariances of the graph weight its edges against each other. In three cases they are too small for the
error of the map, because they take correlated errors for independent ones:

- All edges that end at one keyframe come from one reading: a step and two loops share its noise, so each of
  the three counts as a third.
- A match past a keyframe placed by a guess may have been made to that keyframe, and then repeats the guess:
  it is left out.
- A step measured only by wheel odometry is as certain as the wheels usually are, or as they claim if they
  failed. It gets the covariance of this mixture; the loops have shown how often the wheels failed (Laplace's
  rule of succession).

In one case they are too large: matches to a local map drift less along a path than as many independent steps.
Where the path closes, it shows by how much: the variances of matches are scaled by their variance of unit
weight, the sum of squared whitened residuals divided by the redundancy (Foerstner 1979). The claimed variance
also counts, with the weight of as many readings as make a statistic; for lidar matches half of it, because
they claim the noise of both keyframes they connect, and along a path that is the noise of each keyframe
twice.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fusion.estimation import FEWEST
from slam.config import Config
from slam.graph.anchors import with_earth
from slam.graph.edge import Edge, EdgeKind
from slam.graph.held_graph import marginals
from slam.graph.influence import linearized
from slam.graph.keyframe_graph import unmeasured
from slam.measurements import BoolArray, FloatArray, Pose, logarithm, motion_between

_MATCHES = (EdgeKind.LIDAR, EdgeKind.RGBD, EdgeKind.LOOP)


def pose_covariances(
    poses: Sequence[Pose],
    bases: Sequence[Pose],
    edges: Sequence[Edge],
    kept: Sequence[bool] | BoolArray,
    config: Config,
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of the robot at every keyframe, and of every step between two.

    Parameters
    ----------
    poses, bases
        (n,) optimised poses of the nodes, and of the robot's base there.
    edges, kept
        All edges of the graph, and whether each is an inlier.

    Returns
    -------
    (n, d, d) and (n - 1, d, d), of the motion from each base to the next: GTSAM's tangent of the base where
    it ends. Node 0 is fixed: the others are relative to it.
    """
    nodes, scaled = with_earth(poses, used_edges(poses, edges, kept, config))
    information = np.zeros((len(poses) - 1, *_unknown(poses, config).shape))
    if of_steps := [edge for edge in scaled if edge.target == edge.source + 1]:
        each = np.linalg.inv([edge.covariance for edge in of_steps])
        np.add.at(information, [edge.source for edge in of_steps], each)
    # Between the last keyframe of a session and the first of the next nothing was measured.
    information[~information.any(axis=(1, 2))] = np.linalg.inv(_unknown(poses, config))
    offsets = map(motion_between, bases, poses)
    adjoints = np.array([offset.AdjointMap() for offset in offsets])
    turned = adjoints.transpose(0, 2, 1)
    covariances, steps = marginals(nodes, scaled)[: len(poses)], np.linalg.inv(information)
    return adjoints @ covariances @ turned, adjoints[1:] @ steps @ turned[1:]


def used_edges(
    poses: Sequence[Pose], edges: Sequence[Edge], kept: Sequence[bool] | BoolArray, config: Config
) -> list[Edge]:
    """Return the edges that `pose_covariances` uses: the inliers with their joint uncertainty."""
    held = [edge for edge, keep in zip(edges, kept, strict=True) if keep and not _may_repeat_a_guess(edge)]
    return _used(poses, held, _slips(edges, kept), config)


def _used(
    poses: Sequence[Pose], held: Sequence[Edge], slips: dict[int, FloatArray], config: Config
) -> list[Edge]:
    """Return the inlier edges with their joint uncertainty."""
    scale = _unit_variance(poses, held, config)
    partners: dict[int, set[int]] = defaultdict(set)
    for edge in held:
        if edge.kind in _MATCHES:
            partners[max(edge.source, edge.target)].add(min(edge.source, edge.target))
    scaled = []
    for edge in held:
        covariance = edge.covariance
        if edge.kind in _MATCHES:
            covariance = scale * len(partners[max(edge.source, edge.target)]) * covariance
        elif edge.kind is EdgeKind.WHEEL and not edge.trusted and edge.target == edge.source + 1:
            covariance = slips.get(edge.source, covariance)
        scaled.append(replace(edge, covariance=covariance))
    return scaled


def _may_repeat_a_guess(edge: Edge) -> bool:
    """Return whether an edge is a match past a keyframe with a guessed pose."""
    past = edge.kind is EdgeKind.LIDAR and edge.target - edge.source > 1
    return past and not edge.trusted


def _slips(edges: Sequence[Edge], kept: Sequence[bool] | BoolArray) -> dict[int, FloatArray]:
    """Return the covariance of each step measured only by wheels, by its source."""
    matched = {edge.source for edge in edges if edge.kind in _MATCHES and edge.target == edge.source + 1}
    loose: dict[int, NDArray[np.floating]] = {}
    wheels: dict[int, tuple[FloatArray, bool]] = {}
    for edge, keep in zip(edges, kept, strict=True):
        if edge.target != edge.source + 1 or edge.source in matched:
            continue
        if edge.kind is EdgeKind.ASSUMED:
            loose[edge.source] = np.linalg.inv(edge.covariance) + loose.get(edge.source, 0.0)
        elif edge.kind is EdgeKind.WHEEL and not edge.trusted:
            wheels[edge.source] = edge.covariance, bool(keep)
    alone = loose.keys() & wheels.keys()
    refused = sum(not wheels[source][1] for source in alone)
    wrong = (refused + 1) / (len(alone) + 2)
    return {key: (1.0 - wrong) * wheels[key][0] + wrong * np.linalg.inv(loose[key]) for key in alone}


def _unit_variance(poses: Sequence[Pose], held: Sequence[Edge], config: Config) -> float:
    """Return the variance of unit weight of matches: of steps measured twice, and of long loops."""
    far = config.match.local_map_keyframes
    matches = [
        edge for edge in held if edge.kind in _MATCHES and not 1 < abs(edge.target - edge.source) <= far
    ]
    if not matches:
        return 1.0
    found = [motion_between(poses[edge.source], poses[edge.target]) for edge in matches]
    offs = [motion_between(edge.T_source_target, off) for edge, off in zip(matches, found, strict=True)]
    covariances = np.array([edge.covariance for edge in matches])
    missed = np.array([logarithm(off) for off in offs])
    squares = np.einsum("ki,ki->k", missed, np.linalg.solve(covariances, missed[..., None])[..., 0])
    determined = np.sum(np.linalg.eigvalsh(covariances) < config.graph.lost_sigma_m**2, axis=1)
    steps: dict[int, list[tuple[float, int]]] = defaultdict(list)
    loops: dict[tuple[int, int], list[tuple[float, int]]] = defaultdict(list)
    for edge, square, numbers in zip(matches, squares.tolist(), determined.tolist(), strict=True):
        if abs(edge.target - edge.source) == 1:
            steps[edge.source].append((square, numbers))
        else:
            # All loops between the same two local maps count as one.
            loops[edge.source // far, edge.target // far].append((square, numbers))
    by_lidar = any(edge.kind is EdgeKind.LIDAR for edge in held)
    total, surplus = (0.5 if by_lidar else 1.0) * FEWEST, FEWEST
    for ones in steps.values():
        total += sum(square for square, _ in ones)
        surplus += sum(numbers for _, numbers in ones) - max(numbers for _, numbers in ones)
    # A loop past steps without a match first determines these steps.
    excess = -len(_unknown(poses, config)) * (len(poses) - 1 - len(steps))
    for ones in loops.values():
        total += sum(square for square, _ in ones) / len(ones)
        excess += max(numbers for _, numbers in ones)
    return total / (surplus + max(excess, 0))


def _unknown(poses: Sequence[Pose], config: Config) -> FloatArray:
    """Return (d, d) the covariance of an unmeasured step."""
    return unmeasured(config.graph, planar=isinstance(poses[0], gtsam.Pose2))


def joint_covariance(
    poses: Sequence[gtsam.Pose2], edges: Sequence[Edge], jacobian: sparse.csr_matrix | FloatArray
) -> FloatArray:
    """Return the covariance of functions of planar poses, by one factorisation of the information.

    Parameters
    ----------
    poses
        (n,) at which the edges are linearised; node 0 is held.
    edges
        The inliers with their joint uncertainty (`used_edges`).
    jacobian
        (m, 3 n) of m numbers by GTSAM's tangent of every pose: forward, left, turn in the pose's own frame.

    Returns
    -------
    (m, m)
    """
    linear, _ = linearized(*with_earth(poses, edges))
    free = sparse.csr_matrix(jacobian)[:, 3:].T.toarray()
    free = np.pad(free, ((0, linear.shape[1] - len(free)), (0, 0)))
    covariance = free.T @ sparse.linalg.splu((linear.T @ linear).tocsc()).solve(free)
    return np.asarray(0.5 * (covariance + covariance.T))
