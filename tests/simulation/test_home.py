"""Generated homes: passable, reproducible, closed meshes, and an exact plan."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.errors import ConfigError
from slam.simulation.home import Home, Part, Thing, assemble, generate_home, rooms_out_of_reach, true_grid
from slam.simulation.true_grid import drivable_cells, largest_region

ROBOT_RADIUS_M = 0.25


def of_parts(*parts: Part) -> Home:
    return assemble([Thing("box", (part,)) for part in parts], [], [], (0.0, 0.0, 0.0))


@pytest.mark.parametrize("kind", ["home", "office"])
@pytest.mark.parametrize("seed", range(6))
def test_a_robot_gets_into_every_room(seed: int, kind: str) -> None:
    home = generate_home(seed, kind)
    assert rooms_out_of_reach(home, ROBOT_RADIUS_M) == []
    assert min(door.width_m for door in home.doors) >= 0.85
    names = {room.name for room in home.rooms}
    assert len(names) == len(home.rooms)
    assert all({door.room_a, door.room_b} <= names for door in home.doors)


def test_a_wardrobe_in_the_doorway_is_noticed() -> None:
    home = generate_home(3)
    name, corridor = home.doors[0].room_a, home.rooms[-1].name
    shut = [
        Thing("plug", (Part(door.center_xy, (0.5 * door.width_m, 0.5 * door.width_m), 0.0, 2.0),))
        for door in home.doors
        if name in (door.room_a, door.room_b)
    ]
    things = [
        Thing(o.kind, tuple(p for p, i in zip(home.parts, home.obstacle_of_part, strict=True) if i == o.id))
        for o in home.obstacles
    ]
    blocked = assemble([*things, *shut], home.rooms, home.doors, home.start_xy_yaw)
    out_of_reach = rooms_out_of_reach(blocked, ROBOT_RADIUS_M)
    assert name in out_of_reach
    assert corridor not in out_of_reach


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not() -> None:
    one, same, other = generate_home(11), generate_home(11), generate_home(12)
    assert one.vertices.tobytes() == same.vertices.tobytes()
    assert one.color_of_triangle.tobytes() == same.color_of_triangle.tobytes()
    assert one.vertices.tobytes() != other.vertices.tobytes()
    assert generate_home(11, "office").vertices.tobytes() != one.vertices.tobytes()


def test_rooms_sets_the_size() -> None:
    assert [len(generate_home(5, rooms=n).rooms) for n in (2, 3, 9)] == [3, 4, 10]


def test_what_the_issue_names_is_there() -> None:
    homes = [generate_home(seed) for seed in range(8)]
    kinds = {obstacle.kind for home in homes for obstacle in home.obstacles}
    wanted = {"wall", "floor", "ceiling", "low_cupboard", "chair", "bed", "sofa", "glass", "window"}
    assert wanted | {"dark_cabinet", "threshold", "wall_shelf", "table"} <= kinds
    assert all("glass" in {obstacle.kind for obstacle in home.obstacles} for home in homes)
    tops = np.array([o.box[1, 2] for home in homes for o in home.obstacles if o.kind == "low_cupboard"])
    assert (tops < 0.25).any() and ((tops > 0.25) & (tops < 0.31)).any()
    thresholds = [o.box[1, 2] for home in homes for o in home.obstacles if o.kind == "threshold"]
    assert 0.0 < max(thresholds) < 0.01


def test_every_solid_is_closed_and_faces_outward() -> None:
    home = generate_home(2)
    corners = home.vertices[home.triangles].astype(float)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    exact = [4.0 * p.half_xy[0] * p.half_xy[1] * (p.z_high_m - p.z_low_m) for p in home.parts]
    np.testing.assert_allclose(volume.reshape(-1, 12).sum(axis=1), exact, rtol=1e-3, atol=1e-4)


def test_furniture_stands_apart_and_inside_the_building() -> None:
    home = generate_home(4)
    walls = np.stack([o.box for o in home.obstacles if o.kind == "wall"])
    for obstacle in home.obstacles:
        assert (obstacle.box[0, :2] >= walls[:, 0, :2].min(axis=0) - 1e-9).all()
        assert (obstacle.box[1, :2] <= walls[:, 1, :2].max(axis=0) + 1e-9).all()


@pytest.mark.parametrize("arguments", [{"kind": "castle"}, {"rooms": 1}, {"rooms": 41}])
def test_a_home_that_cannot_be_is_refused(arguments: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        generate_home(0, **arguments)  # type: ignore[arg-type]


def test_the_grid_of_boxes_is_exact() -> None:
    floor = Part((0.0, 0.0), (1.0, 0.5), -0.1, 0.0)
    box = Part((0.35, -0.15), (0.15, 0.05), 0.0, 0.4)  # x 0.2-0.5, y -0.2--0.1: whole cells of 0.1
    sliver = Part((-0.55, 0.25), (0.001, 0.001), 0.2, 0.4)
    grid = true_grid(of_parts(floor, box, sliver), 0.0, 1.0, 0.1)
    assert grid.origin_xy == (-1.0, -0.5)
    assert grid.occupied.shape == (10, 20)
    expected = np.full((10, 20), -1)
    expected[3, 12:15] = 1  # row 0 is the lowest y
    expected[7, 4] = 2
    np.testing.assert_array_equal(grid.obstacle_id, expected)
    np.testing.assert_array_equal(grid.occupied, expected >= 0)


def test_a_band_takes_only_what_reaches_into_it() -> None:
    floor = Part((0.0, 0.0), (1.0, 1.0), -0.1, 0.0)
    low, shelf = Part((-0.5, 0.0), (0.1, 0.1), 0.0, 0.25), Part((0.5, 0.0), (0.1, 0.1), 1.0, 1.1)
    home = of_parts(floor, low, shelf)
    seen = [set(np.unique(true_grid(home, a, b, 0.1).obstacle_id)) - {-1} for a, b in BANDS]
    assert seen == [{1}, set(), {2}, {1, 2}, set()]
    with pytest.raises(ConfigError):
        true_grid(home, 0.5, 0.5, 0.1)


BANDS = [(0.2, 0.3), (0.25, 0.5), (1.05, 1.06), (0.1, 2.0), (1.1, 2.0)]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, 0.25 * math.pi, -1.2])
def test_the_grid_of_a_turned_box_agrees_with_sampling(yaw_rad: float) -> None:
    floor = Part((0.0, 0.0), (1.0, 1.0), -0.1, 0.0)
    box = Part((0.13, -0.07), (0.52, 0.21), 0.0, 1.0, yaw_rad)
    grid = true_grid(of_parts(floor, box), 0.1, 0.2, 0.05)
    # Dense points of the box: every cell that holds one is occupied; the rest only touch a corner.
    a, b = np.meshgrid(np.linspace(-0.52, 0.52, 801), np.linspace(-0.21, 0.21, 401))
    x = 0.13 + math.cos(yaw_rad) * a - math.sin(yaw_rad) * b
    y = -0.07 + math.sin(yaw_rad) * a + math.cos(yaw_rad) * b
    sampled = np.zeros_like(grid.occupied)
    inner = 1e-6 * np.sign([a, b])  # points on a border belong to neither cell
    cols = np.floor((x - inner[0] - grid.origin_xy[0]) / 0.05).astype(int)
    rows = np.floor((y - inner[1] - grid.origin_xy[1]) / 0.05).astype(int)
    sampled[rows, cols] = True
    assert not (sampled & ~grid.occupied).any()
    assert np.count_nonzero(grid.occupied & ~sampled) <= 2


def test_drivable_cells_keep_the_radius() -> None:
    occupied = np.zeros((40, 60), dtype=bool)
    occupied[:, 30] = True
    drivable = drivable_cells(occupied, 0.05, 0.25)
    assert drivable[20, 24] and not drivable[20, 25]  # 0.275 and 0.225 m from the face of the wall
    assert drivable[5, 10] and not drivable[4, 10]  # the outside is a wall
    region = largest_region(drivable)
    assert region[20, 10] != region[20, 50]
    assert not largest_region(np.zeros((3, 3), dtype=bool)).any()


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_moved_furniture_is_reported_and_all_else_stays(seed: int) -> None:
    before, after = generate_home(seed), generate_home(seed, moved=6, day=1)
    gone = [part for one in after.changes if one.before for part in one.before.parts]
    new = [part for one in after.changes if one.after for part in one.after.parts]
    assert len(after.changes) == 6
    assert {*before.parts} - {*after.parts} == {*gone}
    assert {*after.parts} - {*before.parts} == {*new}
    for one in after.changes:
        if one.before and one.after:
            pairs = zip(one.before.parts, one.after.parts, strict=True)
            assert all(
                np.allclose((*a.half_xy, a.z_low_m, a.z_high_m), (*b.half_xy, b.z_low_m, b.z_high_m))
                for a, b in pairs
            )
    assert rooms_out_of_reach(after, ROBOT_RADIUS_M) == []
    assert generate_home(seed, moved=6, day=2).changes != after.changes
