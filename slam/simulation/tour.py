"""Plans a tour through all rooms of a home and back, for a differential drive."""

from __future__ import annotations

import itertools
import logging
import math
from dataclasses import dataclass

import numpy as np
from scipy import interpolate, sparse, spatial

from slam.errors import ConfigError
from slam.measurements import BoolArray, FloatArray
from slam.simulation.home_model import Home, Room
from slam.simulation.route import FloorMap, cheapest_paths, floor_map, smooth_path
from slam.simulation.steering import STEP_S, DriveLimits, advance, follow_path
from slam.simulation.true_grid import true_grid

log = logging.getLogger(__name__)

SHORTEST_S = 1.0

_CELL_M = 0.05
_DRIVEN_OVER_M = 0.012  # thresholds lower than this are no obstacle
_MARGIN_M = 0.05  # planned clearance beyond the robot's radius
_ROOMY_M = 0.40  # beyond the radius: more clearance is not preferred
_SPACING_M = 0.04
_REPEATED_M = 8.0  # length of the tour's start that is repeated at its end, so that a loop closes
_SECOND_STOP_M = 1.8  # a room this long has two stops
_LOOKAHEADS_M = (0.40, 0.30, 0.20, 0.12)  # shorter ones stay closer to the path, and are tried if needed
_BACK_M = 0.5
_CRUISE_M_S = 0.33  # mean speed, including corners and narrow places
_STREAM = 0x70  # separates the planner's random numbers from all others of the seed
_SLOWEST_SHARE = 0.6  # of the top speed, at the narrowest places


@dataclass(frozen=True, slots=True)
class Tour:
    """A drive in the map frame, exact at all times.

    Attributes
    ----------
    poses_xyt
        (N, 3) rows of x, y, yaw (radians, not wrapped), `STEP_S` apart, from time zero.
    twists
        (N, 2) speed and turn rate, constant from one row to the next.
    duration_s
        Duration of the drive.
    rooms
        Names of the rooms in the order of their first visit.
    lap_s
        Time when the robot first returns to its start; ``inf`` if never.
    clearance_m
        Smallest distance between the robot's centre and an obstacle.
    """

    poses_xyt: FloatArray
    twists: FloatArray
    duration_s: float
    rooms: tuple[str, ...]
    lap_s: float
    clearance_m: float

    def pose_at(self, time_s: float) -> tuple[float, float, float]:
        """x, y, yaw at a time; before and after the drive, the robot stands still."""
        inside = min(max(time_s, 0.0), self.duration_s)
        index = min(int(inside / STEP_S), len(self.poses_xyt) - 1)
        x, y, yaw = map(float, self.poses_xyt[index])
        speed, turn = map(float, self.twists[index])
        return advance(x, y, yaw, speed, turn, inside - index * STEP_S)

    def poses_at(self, times_s: FloatArray) -> FloatArray:
        """`pose_at` for many times, (N, 3)."""
        return np.array([self.pose_at(float(time_s)) for time_s in times_s]).reshape(-1, 3)

    def smooth_poses(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (N, 3, 3) and positions (N, 3) on the floor, twice differentiable in time.

        Poses are interpolated by a cubic spline, because an IMU would measure steps of acceleration as
        shocks.
        """
        stamps_s = STEP_S * np.arange(len(self.poses_xyt))
        x, y, yaw = interpolate.CubicSpline(stamps_s, self.poses_xyt)(times_s).T
        level = np.zeros_like(x)
        turns = spatial.transform.Rotation.from_rotvec(np.column_stack([level, level, yaw]))
        return turns.as_matrix(), np.column_stack([x, y, level])


def plan_tour(
    home: Home,
    robot_radius_m: float,
    robot_height_m: float,
    seed: int,
    duration_s: float | None = None,
    limits: DriveLimits | None = None,
) -> Tour:
    """Plan a tour of all rooms, back to the start, and again along its first part.

    The rooms are visited depth first through their doors, in a random order, so that the robot passes the
    corridor between any two of its rooms.

    Parameters
    ----------
    robot_radius_m, robot_height_m
        Size of the robot; it drives under higher objects, and over thresholds.
    duration_s
        Visit as many rooms as possible in this time, including the return, and repeat until the time is up;
        if it is too short for a single room, the drive ends before it. None: all rooms, and a part of the
        next lap.

    Raises
    ------
    ConfigError
        The robot does not fit at its start, or cannot follow any path without a collision.
    """
    if duration_s is not None and not SHORTEST_S <= duration_s < math.inf:
        raise ConfigError(f"duration_s is {duration_s}; give {SHORTEST_S:.0f} s or more")
    floor = drivable_floor(home, robot_radius_m, robot_height_m)
    laps = _laps(home, floor, np.random.default_rng([seed, _STREAM]))
    longest_m = math.inf if duration_s is None else _CRUISE_M_S * duration_s
    lap = next((lap for lap in laps if len(lap) * _SPACING_M <= longest_m), laps[0])
    poses, twists = _drive(home, floor, lap, robot_radius_m, limits or DriveLimits(), duration_s)
    return Tour(
        poses_xyt=poses,
        twists=twists,
        duration_s=(len(poses) - 1) * STEP_S if duration_s is None else duration_s,
        rooms=_visited(home, poses),
        lap_s=_back_s(poses, len(lap) * _SPACING_M),
        clearance_m=float(floor.clearance_at_m(poses).min()),
    )


def drivable_floor(home: Home, robot_radius_m: float, robot_height_m: float) -> FloorMap:
    """The floor that the robot can reach from its start.

    Raises
    ------
    ConfigError
        It does not fit at its start.
    """
    grid = true_grid(home, _DRIVEN_OVER_M, robot_height_m, _CELL_M)
    required, preferred = robot_radius_m + _MARGIN_M, robot_radius_m + _ROOMY_M
    return floor_map(grid.occupied, grid.resolution_m, grid.origin_xy, required, preferred)


def _drive(
    home: Home,
    floor: FloorMap,
    lap_m: FloatArray,
    robot_radius_m: float,
    limits: DriveLimits,
    duration_s: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Poses and twists with the first lookahead that avoids all obstacles."""
    closed = duration_s is not None
    path = lap_m[:-1] if closed else np.concatenate([lap_m, lap_m[1 : 1 + round(_REPEATED_M / _SPACING_M)]])
    roominess = floor.clearance_at_m(path) - floor.required_m
    share = np.clip(roominess / (floor.preferred_m - floor.required_m), _SLOWEST_SHARE, 1.0)
    # A path that can be followed takes at most a few times the duration at its allowed speed.
    patience_s = 60.0 + 6.0 * _SPACING_M * float(np.sum(1.0 / share)) / limits.speed_m_s
    longest_s = patience_s if duration_s is None else duration_s
    clearance = 0.0
    for lookahead_m in _LOOKAHEADS_M:
        poses, twists = follow_path(
            path, share, home.start_xy_yaw[2], limits, lookahead_m, longest_s, closed=closed
        )
        clearance = float(floor.clearance_at_m(poses).min())
        if clearance >= robot_radius_m:
            return poses, twists
    raise ConfigError(
        f"a robot of radius {robot_radius_m:.2f} m comes within {clearance:.2f} m of an obstacle on "
        "every path tried; use a smaller robot or another home"
    )


def _laps(home: Home, floor: FloorMap, rng: np.random.Generator) -> list[FloatArray]:
    """Smoothed closed paths (N, 2): through all rooms, all but the last, and so on.

    Each occurs twice, with two stops and with one stop per room; the longest is first; there is at least one.
    """
    start = floor.node_near(np.array(home.start_xy_yaw[:2]))
    if start < 0:
        raise ConfigError(f"no place for a robot with {floor.required_m:.2f} m about it; use a smaller robot")
    centres = floor.centres_m()
    parts = sparse.csgraph.connected_components(floor.graph, directed=False)[1]
    stops, groups = [start], []
    for room in _depth_first(home, rng):
        lap = _stops(room, floor, centres, parts == parts[start], rng)
        if not lap:
            log.warning("no way into room %s for a robot with %.2f m about it", room.name, floor.required_m)
        groups.append(list(range(len(stops), len(stops) + len(lap))))
        stops += lap
    costs, paths = cheapest_paths(floor, stops)
    laps: list[FloatArray] = []
    for last in range(len(groups), 0, -1):
        for stops_a_room in (2, 1):
            # With one stop per room, there is none in the robot's first room.
            order = _order(groups[2 - stops_a_room : last], stops_a_room, costs)
            pieces = [paths[a][b] for a, b in itertools.pairwise([*order, 0])]
            nodes = np.concatenate([piece[:-1] for piece in pieces if piece is not None] + [[start]])
            if len(nodes) > 1:
                laps.append(smooth_path(floor, centres[nodes], _SPACING_M))
    if not laps:
        raise ConfigError(
            f"a robot with {floor.required_m:.2f} m about it cannot leave its start; use a smaller one"
        )
    return laps


def _order(groups: list[list[int]], stops_a_room: int, costs: FloatArray) -> list[int]:
    """Stops in visiting order, from stop 0; of two in a room, the nearer one first."""
    order = [0]
    for group in groups:
        if stops_a_room == 1:
            order += group[-1:]
        else:
            order += sorted(group[:2], key=costs[order[-1]].__getitem__)
    return order


def _depth_first(home: Home, rng: np.random.Generator) -> list[Room]:
    """The rooms in depth-first order from the robot's first room, with random order of neighbours."""
    x, y, _ = home.start_xy_yaw
    by_name = {room.name: room for room in home.rooms}
    first = next((room.name for room in home.rooms if _inside(room, x, y)), home.rooms[0].name)
    order: list[str] = []
    pending = [first]
    while pending:
        name = pending.pop()
        if name in order or name not in by_name:
            continue
        order.append(name)
        beyond = [door.room_b if door.room_a == name else door.room_a for door in home.doors]
        touching = [name in (door.room_a, door.room_b) for door in home.doors]
        neighbours = sorted(other for other, touches in zip(beyond, touching, strict=True) if touches)
        pending += [neighbours[index] for index in rng.permutation(len(neighbours))]
    return [by_name[name] for name in order] + [room for room in home.rooms if room.name not in order]


def _stops(
    room: Room, floor: FloorMap, centres_m: FloatArray, reached: BoolArray, rng: np.random.Generator
) -> list[int]:
    """Reachable positions with clearance in a room: two far apart and one between, or only one.

    None if the room cannot be entered.
    """
    x0, y0, x1, y1 = room.rectangle
    inside = (centres_m > (x0, y0)).all(axis=1) & (centres_m < (x1, y1)).all(axis=1)
    nodes = np.flatnonzero(inside & reached)
    if not nodes.size:
        return []
    clearance = np.minimum(floor.clearance_m[floor.nodes >= 0][nodes], floor.preferred_m)
    roomy = nodes[clearance >= 0.75 * clearance.max()]
    first = int(rng.choice(roomy))
    # The farthest cell from a random one, and the farthest from that: nearly the largest distance.
    farthest = int(roomy[np.argmax(np.linalg.norm(centres_m[roomy] - centres_m[first], axis=1))])
    distances = np.linalg.norm(centres_m[roomy] - centres_m[farthest], axis=1)
    if distances.max() < _SECOND_STOP_M:
        return [first]
    other = int(roomy[np.argmax(distances)])
    middle = 0.5 * (centres_m[farthest] + centres_m[other])
    return [farthest, other, int(roomy[np.argmin(np.linalg.norm(centres_m[roomy] - middle, axis=1))])]


def _inside(room: Room, x: float, y: float) -> bool:
    """Whether a point is in a room."""
    x0, y0, x1, y1 = room.rectangle
    return x0 <= x <= x1 and y0 <= y <= y1


def _visited(home: Home, poses: FloatArray) -> tuple[str, ...]:
    """Names of the rooms in the order of their first visit."""
    first: dict[str, int] = {}
    for room in home.rooms:
        x0, y0, x1, y1 = room.rectangle
        inside = (poses[:, 0] > x0) & (poses[:, 0] < x1) & (poses[:, 1] > y0) & (poses[:, 1] < y1)
        if inside.any():
            first[room.name] = int(np.argmax(inside))
    return tuple(sorted(first, key=first.__getitem__))


def _back_s(poses: FloatArray, lap_m: float) -> float:
    """Time when most of a lap is driven and the start is close again."""
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    is_near = np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1) < _BACK_M
    back = np.flatnonzero(is_near & (driven > 0.8 * lap_m))
    return float(back[0] * STEP_S) if back.size else math.inf
