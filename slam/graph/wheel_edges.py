"""Covariance of chain steps that only wheel odometry measured.

Long stretches measured by both wheels and matches show the usual error of the wheels. It is smaller than the
claimed one, which must also cover jumps. So a step from wheels alone is two edges: one with the usual error,
which may be rejected, and one with the claimed error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from fusion.estimation import FEWEST, ROUNDS, median_to_sigma
from slam.config.stages import GraphConfig
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph, row_of, together, unmeasured
from slam.graph.relative_uncertainty import composed, inverse, seen_from
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row


def calibrate_wheel_edges(
    graph: KeyframeGraph, least_m: float, poses: FloatArray, stamps_s: FloatArray, config: GraphConfig
) -> None:
    """Give steps measured only by wheels the error that wheels have shown, unless loops reject that.

    Then the stated error; if loops reject that, too, the error of an unmeasured step. The error is measured
    on long stretches with matches throughout. If scans are so far apart that these are rare, single steps of
    ``least_m`` or more count, in directions that a match determines better, also along corridors.

    ``poses`` (n, 3) are the keyframe poses by wheels alone at ``stamps_s`` (n,).
    """
    edges = graph.graph.edges
    alone = [n for n, edge in enumerate(edges) if edge.kind is EdgeKind.WHEEL and edge.trusted]
    steps = np.zeros(len(graph), np.bool_)
    steps[[edges[n].source for n in alone]] = True
    longer = [
        edge
        for edge in edges
        if edge.kind is EdgeKind.WHEEL
        and edge.target - edge.source > 1
        and not steps[edge.source : edge.target].any()
    ]
    sparse = len(longer) < FEWEST
    errors = _calibrated_by_steps(edges, poses, least_m) if sparse else _errors_of_stretches(graph, longer)
    if not alone or len(errors) < FEWEST:
        return
    counts = np.isfinite(errors).sum(axis=0)
    errors[:, counts < FEWEST] = np.inf
    scale = np.minimum(median_to_sigma() * np.nanmedian(np.abs(errors), axis=0), 1.0)
    for n, edge in enumerate(edges[:-1] if sparse else []):
        # In a corridor, the first of the two measures the translation only, the next one the rotation.
        if edge.kind is EdgeKind.WHEEL and edge.covariance[2, 2] > math.pi**2:
            for k, shares in ((n, [*scale[:2], 1.0]), (n + 1, [1.0, 1.0, scale[2]])):
                edges[k] = replace(edges[k], covariance=edges[k].covariance * np.outer(shares, shares))
    for n in alone:
        edge = edges[n]
        edges[n] = replace(edge, covariance=edge.covariance * np.outer(scale, scale), trusted=False)
        free = unmeasured(config, max(abs(stamps_s[edge.target] - stamps_s[edge.source]), 1.0), planar=True)
        # Both together have the stated covariance; with distant scans, too few loops test a step.
        claimed = edge.covariance @ np.linalg.solve(free, edge.covariance + free)
        noises = [(edge.covariance, True)] if sparse else [(edge.covariance + free, True), (claimed, False)]
        for covariance, trusted in noises:
            graph.add_edge(replace(edge, kind=EdgeKind.ASSUMED, covariance=covariance, trusted=trusted))


def _errors_of_stretches(graph: KeyframeGraph, longer: Sequence[Edge]) -> FloatArray:
    """Return (K, 3) errors of wheels on long stretches, in stated sigmas."""
    rows = graph.rows()
    ends = np.array([(edge.source, edge.target) for edge in longer])
    claimed = np.array([row_of(edge.T_source_target) for edge in longer])
    errors = seen_from(claimed, composed(inverse(rows[ends[:, 0]]), rows[ends[:, 1]]))
    return errors / np.sqrt([np.diag(edge.covariance) for edge in longer])


def _calibrated_by_steps(edges: list[Edge], poses: FloatArray, least_m: float) -> FloatArray:
    """Calibrate wheels by single matched steps: scale, and yaw error per metre and per rotation.

    Unequal radii add yaw with distance, a wrong wheel base with rotation: with distant scans, this bends a
    map more than all noise. Returns (K, 3) remaining errors on steps of ``least_m`` or more, in stated
    sigmas; NaN if the match is less certain.
    """
    single = [edge for edge in edges if edge.target == edge.source + 1]
    wheels = together(edge for edge in single if edge.kind is EdgeKind.WHEEL)
    matches = together(edge for edge in single if edge.kind is EdgeKind.LIDAR)
    pairs = [(wheels[ends], match) for ends, match in matches.items() if ends in wheels]
    if sum(math.hypot(*match.pose[:2]) >= least_m for _, match in pairs) < FEWEST:
        return np.zeros((0, 3))
    # Values estimated during mapping have changed with it.
    alone = seen_from(poses[:-1], poses[1:])
    odo = alone[[source for source, target in matches if (source, target) in wheels]]
    exact = np.array([match.pose for _, match in pairs])
    variances, known = (
        np.array([np.diag(motion.covariance) for motion in motions]) for motions in zip(*pairs, strict=True)
    )
    step_m = np.hypot(odo[:, 0], odo[:, 1])
    longer_m = np.hypot(exact[:, 0], exact[:, 1]) - step_m
    (stretch,) = _fitted(step_m[:, None], longer_m, known[:, :2].sum(axis=1))
    # Regress on the matched motion, which is nearly exact: noise in the regressor would bias the result.
    by_m, by_rad = _fitted(np.column_stack([step_m, exact[:, 2]]), seen_from(exact, odo)[:, 2], known[:, 2])

    def calibrated(steps: FloatArray) -> FloatArray:
        turned = (steps[:, 2] - by_m * np.hypot(steps[:, 0], steps[:, 1])) / (1.0 + by_rad)
        half = np.pad(0.5 * (turned - steps[:, 2])[:, None], ((0, 0), (2, 0)))
        return composed(composed(half, steps * [1.0 + stretch, 1.0 + stretch, 1.0]), half)

    steps = np.zeros_like(alone)
    sources = [source for source, _ in wheels]
    steps[sources] = alone[sources]
    path = list(accumulate(calibrated(steps), compose, initial=np.zeros(3)))
    for n, edge in enumerate(edges):
        if edge.kind is EdgeKind.WHEEL:
            step = pose2_from_row(between(path[edge.source], path[edge.target]))
            edges[n] = replace(edge, T_source_target=step)
    errors = np.where(known < variances, seen_from(calibrated(odo), exact) / np.sqrt(variances), np.nan)
    return errors[np.hypot(exact[:, 0], exact[:, 1]) >= least_m]


def _fitted(design: FloatArray, measured: FloatArray, variances: FloatArray) -> FloatArray:
    """Fit small factors by least squares, with Cauchy weights at the scale of the most certain residuals."""
    values: FloatArray = np.zeros(design.shape[1])
    precise = variances <= np.median(variances)
    for _ in range(ROUNDS):
        residuals = measured - design @ values
        scale = median_to_sigma() * float(np.median(np.abs(residuals[precise])))
        weighted = design / (scale**2 + residuals**2 + variances)[:, None]
        # Undetermined factors have a prior of one in so many.
        information = weighted.T @ design + FEWEST**2 * np.eye(len(values))
        values = np.asarray(np.linalg.solve(information, weighted.T @ measured), np.float64)
    return values
