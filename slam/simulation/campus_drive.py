"""Plans a long drive through a campus: the path, the motion along it, and the times of the scans."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from slam.measurements import FloatArray
from slam.simulation.campus_plan import Campus
from slam.simulation.route import chain, resample
from slam.simulation.steering import STEP_S, DriveLimits, follow_path

IntArray = NDArray[np.int64]

_LIMITS = DriveLimits(speed_m_s=1.0)
_SLOWEST_SHARE = 0.35
_SPACING_M, _LOOKAHEAD_M = 0.1, 0.6
_ASIDE_M, _WALL_M = 0.35, 0.75  # lateral offset of the robot from the middle, and its distance from the walls
_STOP_EVERY_M, _STOP_S = 45.0, 12.0  # mean distance between two stops, mean duration of one
_LONGEST_LEG_S = 3600.0
# A scan is due by distance (3700 evenly over the drive), by rotation, or by time.
_SCANS_BY_WAY, _SCAN_RAD, _SCAN_S = 3700, 0.35, 4.0
_GAP_S = (5.0, 28.0)


def plan_route(campus: Campus, rng: np.random.Generator, length_m: float) -> list[int]:
    """Plan the junctions of a drive: first the whole ring, then rarely seen corridors, up to a length."""
    pairs = [corridor.junctions for corridor in campus.corridors]
    ends, count = np.array(pairs), len(campus.junctions_m)
    lengths = [corridor.length_m for corridor in campus.corridors]
    graph = sparse.csr_array((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))
    far_m, before = sparse.csgraph.dijkstra(graph, directed=False, return_predecessors=True)
    number = {frozenset(pair): index for index, pair in enumerate(pairs)}
    visits = np.zeros(len(pairs))
    route, goals, driven_m = [campus.ring[0]], [*campus.ring[1:], campus.ring[0]], 0.0
    while goals or driven_m < length_m:
        here = route[-1]
        if not goals:
            # Prefer rarely seen and near corridors, and turning on the spot only if all others are a detour.
            reach_m = far_m[here, ends].min(axis=1)
            back = [len(route) > 1 and {here, route[-2]} == set(pair) for pair in pairs]
            cost = 60.0 * visits + reach_m + 40.0 * np.array(back) + rng.uniform(0.0, 30.0, len(pairs))
            goals = sorted(pairs[int(np.argmin(cost))], key=far_m[here].__getitem__)
        goal = goals.pop(0)
        nodes = chain(before[here], here, goal)
        assert nodes is not None
        route += nodes[1:].tolist()
        driven_m += float(far_m[here, goal])
        for pair in itertools.pairwise(nodes.tolist()):
            visits[number[frozenset(pair)]] += 1
    return route


def drive_route(campus: Campus, route: list[int], rng: np.random.Generator) -> FloatArray:
    """Return true poses on a path, (N, 3) rows of x, y, yaw (not wrapped), `STEP_S` apart, with stops."""
    path, share = _path(campus, route, rng)
    stops = np.cumsum(5.0 + rng.exponential(_STOP_EVERY_M - 5.0, len(path))) / _SPACING_M
    cuts = [0, *stops[stops < len(path) - 20].astype(int).tolist(), len(path) - 1]
    ahead = path[5] - path[0]
    poses = [np.array([[*path[0], math.atan2(ahead[1], ahead[0])]])]
    for first, last in itertools.pairwise(cuts):
        here = poses[-1][-1]
        leg = np.concatenate([here[None, :2], path[first + 1 : last + 1]])
        driven, _ = follow_path(
            leg, share[first : last + 1], here[2], _LIMITS, _LOOKAHEAD_M, _LONGEST_LEG_S, closed=False
        )
        stands = 1 + int(rng.exponential(_STOP_S) / STEP_S)
        poses += [driven[1:], np.repeat(driven[-1:], stands, axis=0)]
    return np.concatenate(poses)


def _path(campus: Campus, route: list[int], rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 2) along a path with varying lateral offset; and the shares of the top speed."""
    widths = {frozenset(corridor.junctions): corridor.width_m for corridor in campus.corridors}
    points, shares = [], []
    for a, b in itertools.pairwise(route):
        start, step = campus.junctions_m[a], campus.junctions_m[b] - campus.junctions_m[a]
        along = step / np.linalg.norm(step)
        aside_m = rng.uniform(-1.0, 1.0) * min(_ASIDE_M, 0.5 * widths[frozenset((a, b))] - _WALL_M)
        aside = aside_m * np.array([-along[1], along[0]])
        corners = [start, start + 3.0 * along + aside, start + step - 3.0 * along + aside, start + step]
        points.append(resample(np.array(corners), _SPACING_M)[:-1])
        shares.append(np.full(len(points[-1]), rng.uniform(_SLOWEST_SHARE, 1.0)))
    path = ndimage.gaussian_filter1d(np.concatenate(points), 2.0, axis=0, mode="nearest")
    return path, ndimage.gaussian_filter1d(np.concatenate(shares), 10.0, mode="nearest")


def scan_steps(poses_xyt: FloatArray, gaps: int, rng: np.random.Generator) -> IntArray:
    """Return the steps at which the lidar fires, ascending, with a number of gaps of 5 to 28 s each."""
    driven_m, yaws = travelled_m(poses_xyt).tolist(), poses_xyt[:, 2].tolist()
    fired, spacing_m = [0], driven_m[-1] / _SCANS_BY_WAY
    due_m = spacing_m
    for step in range(1, len(yaws)):
        last = fired[-1]
        turned = abs(yaws[step] - yaws[last]) >= _SCAN_RAD
        if turned or driven_m[step] - driven_m[last] >= due_m or (step - last) * STEP_S >= _SCAN_S:
            fired.append(step)
            due_m = spacing_m * rng.uniform(0.85, 1.15)
    steps = np.array(fired)
    for low, high in itertools.pairwise(np.linspace(0.0, len(yaws) - 1.0, gaps + 1)):
        length = math.ceil(rng.uniform(*_GAP_S) / STEP_S)
        begin = round(rng.uniform(low, high - length))
        steps = np.union1d(steps[(steps < begin) | (steps > begin + length)], [begin, begin + length])
    return steps


def travelled_m(poses_xyt: FloatArray) -> FloatArray:
    """Return (N,) the distance driven up to each pose (N, 3)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses_xyt[:, :2], axis=0), axis=1))])
