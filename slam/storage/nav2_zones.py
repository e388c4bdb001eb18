"""Zones for nav2: those that the user drew, as masks beside the navigation map, and those of a floor plan.

The keep-out mask is 100 where the robot must not go (KeepoutFilter). The speed mask holds percent of the
usual speed, and 0, which is no limit, elsewhere (SpeedFilter of type 1, base 0, multiplier 1).

Of a floor plan: keep-out zones, speed zones and the route graph. nav2's map server and costmap filters
read the masks; their parameters are in ``zones.yaml``. The GeoJsonGraphFileLoader of nav2_route reads the
graph (format of release 1.3).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import ScanweaveError
from slam.mapping.floor_plan import FloorPlan
from slam.mapping.layered_map import LayeredMap
from slam.mapping.navigation import FreeSpace, free_space, shortest_path
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.mapping.polygons import cells_inside
from slam.measurements import FloatArray
from slam.storage.files import make_folder, write_lines
from slam.storage.nav2 import Nav2Map, read_nav2_map, write_nav2_map
from slam.storage.nav2_layers import remove_maps, write_raw
from slam.storage.plan_files import feature

KEEP_OUT, SPEED = "keepout_mask", "speed_mask"
_WHAT = {
    KEEP_OUT: "Where the robot must not go, for nav2's KeepoutFilter.",
    SPEED: "Percent of the usual speed, 0 without a limit, for nav2's SpeedFilter of type 1.",
}

# Share of the speed through doors.
_DOOR_PERCENT = 50
# Radius of the robot for the paths of the route graph, as in `scanweave plan`.
_RADIUS_M = 0.2

_KEEPOUT = "Keep-out mask (costmap filter type 0): all but rooms and the doors between them."
_SPEED = "Speed mask (costmap filter type 1): the greatest speed in percent before doors, 0 for no limit."


def write_zones(
    folder: Path, layers: LayeredMap, keep_out: Iterable[FloatArray], slow: Iterable[tuple[FloatArray, float]]
) -> list[Path]:
    """Write the masks, as large as the map; a mask without a zone is removed.

    Returns the yaml files; MapFileError if one cannot be written.

    Parameters
    ----------
    keep_out
        (n, 2) corners of each zone, map frame.
    slow
        The same, with percent of the usual speed; where zones overlap the least counts.
    """
    masks: dict[str, StateArray] = {}
    size, place = layers.states("decision").shape, (layers.resolution_m, layers.T_map_grid)
    for polygon in keep_out:
        mask = masks.setdefault(KEEP_OUT, np.full(size, FREE, np.int8))
        mask[cells_inside(polygon, size, *place)] = OCCUPIED
    for polygon, percent in slow:
        mask = masks.setdefault(SPEED, np.zeros(size, np.int8))
        within = cells_inside(polygon, size, *place) & ((mask == 0) | (mask > percent))
        mask[within] = max(round(percent), 1)
    remove_maps(folder, {KEEP_OUT, SPEED} - masks.keys())
    written = []
    for name, mask in masks.items():
        states = np.where(mask == OCCUPIED, mask, np.int8(FREE))
        written.append(write_nav2_map(folder / name, states, *place, _WHAT[name])[0])
        if name == SPEED:
            write_raw(folder / name, mask, written[-1], _WHAT[name])
    return written


def without_keep_out(grid: Nav2Map, path: Path) -> StateArray:
    """Return the values of a map, with the cells of its keep-out mask occupied.

    Parameters
    ----------
    path
        The yaml of the map; the mask, if any, is beside it.

    Raises
    ------
    MapFileError
        If the mask cannot be read.
    """
    mask_path = path.with_name(f"{KEEP_OUT}.yaml")
    if not mask_path.is_file():
        return grid.values
    mask = read_nav2_map(mask_path)
    same = mask.values.shape == grid.values.shape and mask.T_map_grid.equals(grid.T_map_grid, 1e-6)
    return np.where(mask.values == OCCUPIED, np.int8(OCCUPIED), grid.values) if same else grid.values


def write_room_zones(folder: Path, plan: FloorPlan, layers: LayeredMap) -> list[Path]:
    """Write ``keepout.yaml``, ``speed.yaml``, ``zones.yaml`` and ``route.geojson``.

    Raises
    ------
    ScanweaveError
        If the plan has no room, or a file cannot be written.
    """
    if not plan.rooms:
        raise ScanweaveError("the map shows no room, so there are no zones to write")
    make_folder(folder)
    keepout, speed = zones(plan, layers)
    place = (layers.resolution_m, layers.T_map_grid)
    written = [write_nav2_map(folder / "keepout", keepout, *place, _KEEPOUT)[0]]
    written.append(write_raw(folder / "speed", speed, written[0], _SPEED))
    write_lines(folder / "zones.yaml", _parameters())
    space = free_space(layers.states("decision"), *place, _RADIUS_M)
    write_lines(folder / "route.geojson", [json.dumps(route_graph(plan, space), indent=1)])
    return [*written, folder / "zones.yaml", folder / "route.geojson"]


def zones(plan: FloorPlan, layers: LayeredMap) -> tuple[StateArray, StateArray]:
    """Return (rows, cols) keep-out, 100 or 0, and speed limit in percent or 0."""
    place = layers.shape, layers.resolution_m, layers.T_map_grid
    free = np.zeros(layers.shape, np.bool_)
    slow = np.zeros(layers.shape, np.bool_)
    for room in plan.rooms:
        free |= cells_inside(room.corners_m, *place)
    for door in plan.doors:
        along = door.end_m - door.begin_m
        across = 0.5 * np.array([-along[1], along[0]])
        around = [door.begin_m + across, door.end_m + across, door.end_m - across, door.begin_m - across]
        # The area between two rooms is as deep as a wall is thick, and belongs to neither.
        box = cells_inside(np.array(around), *place)
        free |= box
        slow |= box
    speed = np.where(slow & free, _DOOR_PERCENT, 0).astype(np.int8)
    return np.where(free, FREE, OCCUPIED).astype(np.int8), speed


def route_graph(plan: FloorPlan, space: FreeSpace) -> dict[str, Any]:
    """Return nodes in rooms, doors and path corners; edges in both directions, with length as cost.

    A room or a door that the robot cannot reach is left out.
    """
    graph = _Graph()
    places = {room.number: _roomy(space, room.middle_m) for room in plan.rooms}
    for door in plan.doors:
        middle = _roomy(space, door.middle_m)
        for room in door.rooms:
            goal = places[room]
            if middle is None or goal is None:
                continue
            path = shortest_path(space, middle, goal)
            if path is not None:
                graph.add(path.points_map, f"door {door.rooms[0]}-{door.rooms[1]}", f"room {room}", space)
    # Nodes and edges share one numbering.
    for number, edge in enumerate(graph.edges, len(graph.nodes)):
        edge["properties"]["id"] = number
    return {"type": "FeatureCollection", "name": "graph", "features": [*graph.nodes, *graph.edges]}


class _Graph:
    """Features in the format of nav2_route."""

    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.edges: list[dict[str, Any]] = []
        self._nodes: dict[tuple[float, float], int] = {}

    def add(self, points_map: FloatArray, begin: str, end: str, space: FreeSpace) -> None:
        """Add a path by its corners."""
        corners = _corners(points_map, space)
        names = [begin, *[""] * (len(corners) - 2), end]
        ids = [self._node(point, name) for point, name in zip(corners.tolist(), names, strict=True)]
        for one, other, a, b in zip(ids, ids[1:], corners, corners[1:], strict=False):
            for source, target, from_, to in ((one, other, a, b), (other, one, b, a)):
                cost = round(float(np.hypot(*(to - from_))), 3)
                properties = {"id": 0, "startid": source, "endid": target, "cost": cost, "overridable": True}
                line = [from_.round(3).tolist(), to.round(3).tolist()]
                self.edges.append(feature("MultiLineString", [line], **properties))

    def _node(self, point: list[float], name: str) -> int:
        """Return the number of a node, created if needed."""
        key = (round(point[0], 3), round(point[1], 3))
        if key not in self._nodes:
            self._nodes[key] = len(self._nodes)
            properties: dict[str, Any] = {"id": self._nodes[key], "frame": "map"}
            if name:
                properties["metadata"] = {"name": name}
            self.nodes.append(feature("Point", list(key), **properties))
        return self._nodes[key]


def _corners(points_map: FloatArray, space: FreeSpace) -> FloatArray:
    """Return the corners of a path of cells: straight as far as the robot fits."""
    kept = [0]
    while kept[-1] < len(points_map) - 1:
        last = len(points_map) - 1
        while last > kept[-1] + 1 and not _open(points_map[kept[-1]], points_map[last], space):
            last = kept[-1] + max(1, (last - kept[-1]) * 3 // 4)
        kept.append(last)
    return points_map[kept]


def _open(begin_m: FloatArray, end_m: FloatArray, space: FreeSpace) -> bool:
    """Return whether the robot fits along a whole line."""
    count = 2 + int(2.0 * np.hypot(*(end_m - begin_m)) / space.resolution_m)
    return all(
        space.allowed[space.cell_of((float(x), float(y)))] for x, y in np.linspace(begin_m, end_m, count)
    )


def _roomy(space: FreeSpace, at_m: FloatArray) -> tuple[float, float] | None:
    """Return the nearest point with room for the robot, connected to most of the floor."""
    sizes = np.bincount(space.region.ravel())
    if len(sizes) < 2:
        return None
    sizes[0] = 0
    cells = np.argwhere(space.region == np.argmax(sizes))
    middles = space.middle_of(cells)
    x, y = middles[np.argmin(np.hypot(*(middles - at_m).T))]
    return float(x), float(y)


def _parameters() -> list[str]:
    """Return the parameters of the servers of both masks and of the route server."""
    lines = []
    for name, kind in (("keepout", 0), ("speed", 1)):
        lines += [
            f"{name}_filter_mask_server:",
            "  ros__parameters:",
            f"    yaml_filename: {name}.yaml",
            f"    topic_name: {name}_filter_mask",
            f"{name}_costmap_filter_info_server:",
            "  ros__parameters:",
            f"    type: {kind}",
            f"    filter_info_topic: {name}_costmap_filter_info",
            f"    mask_topic: {name}_filter_mask",
            "    base: 0.0",
            "    multiplier: 1.0",
        ]
    return [*lines, "route_server:", "  ros__parameters:", "    graph_filepath: route.geojson"]
