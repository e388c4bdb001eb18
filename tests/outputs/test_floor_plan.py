"""Floor plans of tiny worlds whose rooms are known exactly, and their files read back."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import ezdxf
import gtsam
import numpy as np
import pytest

from slam.app.parts import grid_of_scans
from slam.config import Config
from slam.errors import ScanweaveError
from slam.estimates import Trajectory
from slam.graph.edge import Edge, EdgeKind
from slam.graph.held_graph import marginals
from slam.graph.pose_covariances import joint_covariance
from slam.mapping.floor_plan import FloorPlan
from slam.mapping.occupancy_grid import FREE
from slam.mapping.polygons import inside
from slam.mapping.room_outline import area_m2, room_outlines, seen_from
from slam.mapping.rooms import RoomMap
from slam.mapping.wall_segments import wall_points
from slam.measurements import LaserScan
from slam.outputs.exports import Exports
from slam.outputs.floorplan import floor_plan
from slam.simulation.floor_plan import cast_rays
from slam.storage.map_contents import OCCUPANCY, MapContents, SavedFactor
from slam.storage.nav2 import read_nav2_map
from slam.storage.plan_files import plan_geojson

STEP_RAD = np.radians(1.0)


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


# Two rooms of 4 x 3 and 3 x 3 m; a wall 0.12 m thick with a door of 0.9 m between them.
TWO_ROOMS = [
    (0.0, 0.0, 7.12, 0.0), (7.12, 0.0, 7.12, 3.0), (7.12, 3.0, 0.0, 3.0), (0.0, 3.0, 0.0, 0.0),
    *box(4.0, 0.0, 4.12, 1.0), *box(4.0, 1.9, 4.12, 3.0),
]  # fmt: skip
# 5 x 4 m without a corner of 2.5 x 2 m.
L_SHAPE = [
    (0.0, 0.0, 5.0, 0.0), (5.0, 0.0, 5.0, 2.0), (5.0, 2.0, 2.5, 2.0),
    (2.5, 2.0, 2.5, 4.0), (2.5, 4.0, 0.0, 4.0), (0.0, 4.0, 0.0, 0.0),
]  # fmt: skip
WAYS = {
    "two": [(1.0, 1.0), (3.0, 1.45), (5.0, 1.45), (6.2, 2.0)],
    "L": [(1.0, 3.2), (1.2, 1.0), (4.2, 1.0)],
    "open": [(1.0, 1.0), (3.0, 1.5)],
}


def mapped(
    segments: list[tuple[float, float, float, float]],
    way: list[tuple[float, float]],
    *,
    turned: float = 0.0,
    sigma_m: float = 0.005,
    range_max_m: float = 10.0,
) -> MapContents:
    """A map of scans that were taken along a way, every 0.2 m, with a graph as sure as scans are."""
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [
            np.linspace(a, b, max(2, int(np.hypot(*np.subtract(b, a)) / 0.2)), endpoint=False)
            for a, b in pairwise(way)
        ]
    )
    turn = gtsam.Pose2(0.0, 0.0, turned)
    poses, scans = [], []
    for stamp, (x, y) in enumerate(points):
        bearings = -np.pi + STEP_RAD * np.arange(360)
        ranges = cast_rays(np.array(segments), np.array([x, y]), bearings) + rng.normal(0.0, sigma_m, 360)
        ranges[ranges > range_max_m] = np.inf
        scans.append(LaserScan(float(stamp), ranges.astype(np.float32), -np.pi, STEP_RAD, range_max_m))
        poses.append(turn.compose(gtsam.Pose2(x, y, 0.0)))
    rows = np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
    covariance = np.diag([0.003, 0.003, 0.001]) ** 2
    factors = [
        SavedFactor(Edge(k, k + 1, a.between(b), covariance, EdgeKind.LIDAR, True), True)
        for k, (a, b) in enumerate(pairwise(poses))
    ]
    stamps = np.arange(len(poses), dtype=np.float64)
    return MapContents(
        node_poses=poses,
        stamps_s=stamps,
        readings=np.arange(len(poses)),
        trajectory=Trajectory.from_planar(stamps, rows),
        factors=factors,
        measured_scans=scans,
        keyframe_scans=scans,
        grids={OCCUPANCY: grid_of_scans(scans, rows)},
    )


@pytest.fixture(scope="module")
def two_rooms() -> MapContents:
    return mapped(TWO_ROOMS, WAYS["two"])


@pytest.fixture(scope="module")
def plan(two_rooms: MapContents) -> FloorPlan:
    return floor_plan(two_rooms, Config())


def test_two_rooms_and_the_door_between_them(plan: FloorPlan) -> None:
    assert [len(room.walls) for room in plan.rooms] == [4, 4]
    assert [room.area_m2 for room in plan.rooms] == pytest.approx([12.0, 9.0], abs=0.05)
    sizes = [sorted(length.length_m for length in room.lengths) for room in plan.rooms]
    assert np.allclose(sizes, [[3.0, 4.0], [3.0, 3.0]], atol=0.01)
    (door,) = plan.doors
    assert door.rooms == (1, 2)
    assert door.driven
    assert door.width_m == pytest.approx(0.9, abs=0.11)
    assert door.middle_m == pytest.approx([4.06, 1.45], abs=0.06)
    assert all(room.entered for room in plan.rooms)


def test_furniture_along_a_wall_does_not_join_the_rooms_beside_it() -> None:
    cupboards = [*box(4.12, 0.0, 4.8, 0.88), *box(4.12, 2.02, 4.8, 3.0)]
    found = floor_plan(mapped([*TWO_ROOMS, *cupboards], WAYS["two"]), Config())
    assert [room.area_m2 for room in found.rooms] == pytest.approx([12.0, 9.0], abs=0.1)


def test_the_truth_lies_in_the_intervals(plan: FloorPlan) -> None:
    for room, area in zip(plan.rooms, (12.0, 9.0), strict=True):
        assert room.area_half_interval_m2 is not None
        # One in twenty may lie outside, by little.
        assert abs(room.area_m2 - area) < 1.5 * room.area_half_interval_m2
        assert room.area_half_interval_m2 < 0.15
        for length in room.lengths:
            assert abs(length.length_m - round(length.length_m)) < 1.5 * length.half_interval_m
            assert 0.0 < length.half_interval_m < 0.03


def test_an_l_shaped_room_keeps_its_corner() -> None:
    (room,) = floor_plan(mapped(L_SHAPE, WAYS["L"]), Config()).rooms
    assert len(room.walls) == 6
    assert room.area_m2 == pytest.approx(15.0, abs=0.08)
    assert sorted(length.length_m for length in room.lengths) == pytest.approx([4.0, 5.0], abs=0.01)


def test_a_side_that_was_not_seen_is_dashed_and_without_an_interval() -> None:
    far = [*box(0.0, 0.0, 30.0, 3.0)]
    (room,) = floor_plan(mapped(far, WAYS["open"], range_max_m=6.0), Config()).rooms
    unseen = [wall for wall in room.walls if wall.sigma_m is None]
    assert len(unseen) == 1
    assert not unseen[0].pieces()[0][2]
    assert room.area_half_interval_m2 is None
    # Across it both walls were seen.
    assert [length.length_m for length in room.lengths] == pytest.approx([3.0], abs=0.01)


def test_no_place_lies_in_two_rooms() -> None:
    # Free cells in a corner of 7 x 3 m are said to be another room's, with nothing between.
    contents = mapped(box(0.0, 0.0, 7.0, 3.0), WAYS["two"])
    grid = contents.grid
    assert grid is not None
    points = wall_points(contents.measured_scans, contents.keyframe_poses, (0.1, 10.0), 4)
    labels = (grid.states() == FREE).astype(np.int32)
    rooms = RoomMap(labels, grid.resolution_m, grid.T_map_grid)
    at = rooms.middles(*np.nonzero(labels))
    labels[labels > 0] = 1 + ((at[:, 0] > 6.0) & (at[:, 1] > 2.0))
    way = contents.trajectory.positions_m[:, :2]
    owners = seen_from(rooms, points)
    own = {label: points.chosen((owners == label).any(axis=0)) for label in (1, 2)}
    large, small = room_outlines(rooms, own, set(rooms.at(way).tolist())).values()
    assert [area_m2(one.corners_m) for one in (large, small)] == pytest.approx([20.0, 1.0], abs=0.3)
    places = np.random.default_rng(0).uniform((0.0, 0.0), (7.0, 3.0), (20_000, 2))
    assert not (inside(places, large.corners_m) & inside(places, small.corners_m)).any()


@pytest.mark.parametrize("turned", [0.4, -1.3])
def test_a_turned_map_has_the_same_areas(plan: FloorPlan, turned: float) -> None:
    other = floor_plan(mapped(TWO_ROOMS, WAYS["two"], turned=turned), Config())
    assert [room.area_m2 for room in other.rooms] == pytest.approx(
        [room.area_m2 for room in plan.rooms], abs=0.05
    )
    assert len(other.doors) == 1
    assert (other.yaw_rad - turned + np.pi / 4.0) % (np.pi / 2.0) == pytest.approx(np.pi / 4.0, abs=0.01)


def test_furniture_cuts_no_room_and_takes_none_of_it() -> None:
    # Two cupboards that leave 1 m between them, and a table.
    cupboards = [*box(2.0, 0.0, 2.6, 1.0), *box(2.0, 2.0, 2.6, 3.0), *box(5.0, 2.2, 5.6, 3.0)]
    plan = floor_plan(mapped([*TWO_ROOMS, *cupboards], WAYS["two"]), Config())
    assert [room.area_m2 for room in plan.rooms] == pytest.approx([12.0, 9.0], abs=0.06)


def test_no_wall_makes_no_room() -> None:
    nothing = mapped([(50.0, 50.0, 51.0, 50.0)], WAYS["open"])
    plan = floor_plan(nothing, Config())
    assert not plan.doors
    assert all(room.area_half_interval_m2 is None for room in plan.rooms)
    with pytest.raises(ScanweaveError, match="holds none"):
        floor_plan(replace(nothing, measured_scans=[None] * len(nothing.node_poses)), Config())


def test_a_joint_covariance_is_that_of_the_marginals() -> None:
    rng = np.random.default_rng(3)
    poses = [gtsam.Pose2(*rng.normal(0.0, 2.0, 3)) for _ in range(6)]

    def edge(a: int, b: int) -> Edge:
        root = rng.normal(0.0, 0.05, (3, 3))
        covariance = root @ root.T + 1e-4 * np.eye(3)
        return Edge(a, b, poses[a].between(poses[b]), covariance, EdgeKind.LIDAR, True)

    edges = [edge(k, k + 1) for k in range(5)] + [edge(0, 4), edge(1, 5)]
    whole = joint_covariance(poses, edges, np.eye(18))
    for node, expected in enumerate(marginals(poses, edges)[1:], 1):
        assert whole[3 * node : 3 * node + 3, 3 * node : 3 * node + 3] == pytest.approx(expected, abs=1e-6)
    assert not whole[:3].any()


def test_drawings_are_read_back(two_rooms: MapContents, plan: FloorPlan, tmp_path: Path) -> None:
    exports = Exports(two_rooms, Config())
    for name in ("svg", "dxf", "geojson"):
        exports.write(name, tmp_path)
    svg = ET.parse(tmp_path / "floorplan.svg").getroot()
    assert sum(element.tag.endswith("polygon") for element in svg.iter()) == 2
    texts = [element.text or "" for element in svg.iter() if element.tag.endswith("text")]
    assert any("±" in text and "m²" in text for text in texts)
    assert svg.attrib["width"].endswith("mm")

    drawing = ezdxf.readfile(tmp_path / "floorplan.dxf")
    assert not drawing.audit().errors
    assert drawing.units == ezdxf.units.M
    rooms = list(drawing.modelspace().query('LWPOLYLINE[layer=="ROOMS"]'))
    assert len(rooms) == 2
    corners = np.array([point[:2] for point in rooms[0].get_points()])
    assert corners == pytest.approx(plan.rooms[0].corners_m, abs=1e-9)
    used = {entity.dxf.layer for entity in drawing.modelspace()}
    assert used <= {"WALLS", "UNOBSERVED", "DOORS", "ROOMS", "TEXT"}
    assert {"WALLS", "DOORS", "ROOMS", "TEXT"} <= used

    found = json.loads((tmp_path / "floorplan.geojson").read_text())
    kinds = [feature["properties"]["kind"] for feature in found["features"]]
    assert kinds.count("room") == 2
    assert kinds.count("door") == 1
    assert (found["frame"], found["unit"]) == ("map", "metre")
    ring = found["features"][0]["geometry"]["coordinates"][0]
    assert ring[0] == ring[-1]


def test_a_line_has_two_ends(plan: FloorPlan) -> None:
    """Of a wall that is seen up to a micrometre before its end; GIS programs call it invalid."""
    room = plan.rooms[0]
    seen = [replace(wall, seen_m=np.array([[0.0, wall.length_m - 1e-6]])) for wall in room.walls]
    found = plan_geojson(replace(plan, rooms=[replace(room, walls=seen)]))["features"]
    lines = [one["geometry"]["coordinates"] for one in found if one["geometry"]["type"] == "LineString"]
    assert len(lines) == 4 + len(plan.doors) and all(begin != end for begin, end in lines)


def test_zones_are_read_as_nav2_does(two_rooms: MapContents, tmp_path: Path) -> None:
    Exports(two_rooms, Config()).write("nav2-zones", tmp_path)
    keepout, speed = (read_nav2_map(tmp_path / f"{name}.yaml") for name in ("keepout", "speed"))

    def at(mask: object, x: float, y: float) -> int:
        values, corner = keepout.values if mask is keepout else speed.values, keepout.T_map_grid
        return int(values[int((y - corner.y()) / 0.05), int((x - corner.x()) / 0.05)])

    assert [at(keepout, 1.0, 1.0), at(keepout, 4.06, 1.45), at(keepout, 4.06, 0.5)] == [0, 0, 100]
    assert [at(speed, 1.0, 1.0), at(speed, 4.06, 1.45)] == [0, 50]
    graph = json.loads((tmp_path / "route.geojson").read_text())["features"]
    nodes = {f["properties"]["id"]: f for f in graph if f["geometry"]["type"] == "Point"}
    edges = [f for f in graph if f["geometry"]["type"] == "MultiLineString"]
    names = {node["properties"].get("metadata", {}).get("name") for node in nodes.values()}
    assert {"door 1-2", "room 1", "room 2"} <= names
    ids = [f["properties"]["id"] for f in graph]
    assert len(set(ids)) == len(ids)
    for edge in edges:
        ends = [nodes[edge["properties"][key]]["geometry"]["coordinates"] for key in ("startid", "endid")]
        assert edge["geometry"]["coordinates"][0] == ends
        assert edge["properties"]["cost"] == pytest.approx(np.hypot(*np.subtract(*ends)), abs=2e-3)


def test_a_person_reads_it(plan: FloorPlan) -> None:
    text = plan.text()
    assert text.startswith("2 rooms, 1 doors, 1 of them driven through")
    assert "door 1-2" in text
