"""Edits of a finished map: what they change, what they leave, that they last, and that they can be undone."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
from edit_maps import box, changed_outside, content, name, occupied

import slam
from slam.errors import ScanweaveError
from slam.matching.planar import between
from slam.outputs.finished_map import Map, open_map
from slam.simulation.synthetic_log import write_synthetic_log


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A drive of a round and a half: loops close."""
    folder = tmp_path_factory.mktemp("house")
    log = write_synthetic_log(folder, duration_s=60.0).log_path
    return slam.map_log(log, out=folder / "map")


def test_a_map_made_anew_without_change_is_the_same_to_the_byte(house: Map) -> None:
    assert content(house.remap()) == content(house)


def test_a_forbidden_loop_is_gone_and_undo_brings_the_map_back_to_the_byte(house: Map) -> None:
    loop = next(loop for loop in house.loops if loop.accepted)
    pair = [name(house, loop.keyframe), name(house, loop.place)]  # in any order
    edited = house.edited({"loops": {"forbid": [pair]}})
    found = edited.loops[house.loops.index(loop)]
    assert not found.accepted and found.reason == "forbidden by hand"
    ends = {
        (factor.edge.source, factor.edge.target) for factor in edited.factors if factor.edge.loop is not None
    }
    assert (loop.place, loop.keyframe) not in ends and ends
    moved = np.abs(edited.keyframe_poses - house.keyframe_poses)[:, :2].max()
    assert 0.0 < moved < 0.2
    assert content(edited.undone()) == content(house)


def test_a_refused_loop_that_is_forced_holds(house: Map) -> None:
    loop = next(loop for loop in house.loops if loop.accepted)
    pair = [name(house, loop.place), name(house, loop.keyframe)]
    forced = house.edited({"loops": {"forbid": [pair]}}).edited({"loops": {"force": [pair]}})
    number = house.loops.index(loop)
    assert forced.loops[number].accepted
    assert [factor.edge.trusted for factor in forced.factors if factor.edge.loop == number] == [True]


def test_the_same_edits_give_the_same_bytes_and_survive_a_remap(house: Map) -> None:
    polygon = box(house)
    edits = {"erase": [{"polygon": polygon.tolist()}], "places": [{"name": "dock", "position": [0.5, 0.2]}]}
    assert occupied(house, polygon) > 10
    edited = house.edited(edits)
    assert content(house.edited(edits)) == content(edited)
    assert occupied(edited, polygon) == 0
    assert changed_outside(house, edited, polygon) == 0
    for resolution_m in (0.02, 0.1):
        anew = edited.remap([f"grid.resolution_m={resolution_m}"])
        assert anew.grid is not None and anew.grid.resolution_m == resolution_m
        assert occupied(anew, polygon) == 0
        assert anew.places["dock"] == pytest.approx([0.5, 0.2, 0.0], abs=1e-9)
    assert content(edited.undone()) == content(house)
    assert content(anew.undone()) == content(edited)


def test_a_turned_map_has_its_axes_elsewhere_and_is_else_the_same(house: Map) -> None:
    turned = house.edited({"turn": {"degrees": 30.0}, "origin": [1.0, 2.0]})
    back = gtsam.Pose2(1.0, 2.0, 0.0).compose(gtsam.Pose2(0.0, 0.0, -math.radians(30.0)))
    for before, after in zip(house.keyframe_poses[::20], turned.keyframe_poses[::20], strict=True):
        moved = back.compose(gtsam.Pose2(*after))
        assert [moved.x(), moved.y()] == pytest.approx(before[:2], abs=1e-9)
    ways = [np.diff(one.trajectory.positions_m, axis=0) for one in (house, turned)]
    assert np.linalg.norm(ways[0], axis=1) == pytest.approx(np.linalg.norm(ways[1], axis=1), abs=1e-9)
    # The covariances turn along: their greatest axis keeps its length.
    assert house.covariances is not None and turned.covariances is not None
    spreads = [np.linalg.eigvalsh(one.covariances[:, :2, :2]) for one in (house, turned)]
    assert spreads[0] == pytest.approx(spreads[1], rel=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 17.0, -40.0])
def test_a_map_is_turned_to_its_walls(house: Map, degrees: float) -> None:
    askew = house.edited({"turn": {"degrees": degrees}}) if degrees else house
    straight = askew.edited({"turn": {"to_walls": True}})
    turn = np.degrees(straight.keyframe_poses[0, 2]) % 90.0
    # The walls of the simulated building lie along the first pose's axes.
    assert min(turn, 90.0 - turn) < 0.2


def test_two_points_lie_along_x(house: Map) -> None:
    turned = house.edited({"turn": {"along_x": [[0.0, 0.0], [1.0, 2.0]]}})
    way = between(turned.keyframe_poses[0], house.keyframe_poses[0])
    assert way[2] == pytest.approx(math.atan2(2.0, 1.0), abs=1e-6)


def test_edits_in_place_keep_the_files_together(house: Map, tmp_path: Path) -> None:
    house.save(tmp_path)
    open_map(tmp_path).edited({"turn": {"degrees": 10}}, out=tmp_path).close()
    found = open_map(tmp_path)
    assert found.edits == ["turn: {degrees: 10.0}\n"]
    first = (tmp_path / "trajectory.tum").read_text().splitlines()[1].split()
    assert float(first[1]) == pytest.approx(found.trajectory.positions_m[0, 0], abs=1e-6)
    found.check()
    with pytest.raises(ScanweaveError, match="is another map"):
        house.edited({}, out=tmp_path)
