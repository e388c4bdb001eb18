"""Edits of a finished map: what they change, what they leave, that they last, and that they can be undone."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml
from edit_maps import box, changed_outside, content, name, occupied

import slam
from slam.app.map_folder import finished_map
from slam.config.edits import dump_edits, edits_of
from slam.edits.remaking import solved
from slam.errors import ScanweaveError
from slam.graph.edge import Edge, EdgeKind
from slam.matching.planar import between
from slam.outputs.finished_map import Map, load_map
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_contents import SavedFactor
from slam.storage.map_file import MapFile
from slam.storage.nav2 import read_nav2_map
from slam.storage.nav2_zones import without_keep_out


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


def test_a_verdict_that_no_edit_touches_stays(house: Map) -> None:
    """A loop that fits, and that the run refused all the same, is not taken in because of another."""
    numbers = [n for n, factor in enumerate(house.factors) if factor.edge.loop is not None]
    factors = [replace(one, kept=n != numbers[2]) for n, one in enumerate(house.factors) if n != numbers[0]]
    found, poses = solved(house.contents.node_poses, factors, house.config, house.config)
    assert [one.kept for one in found] == [one.kept for one in factors]
    moved = [a.translation() - b.translation() for a, b in zip(poses, house.contents.node_poses, strict=True)]
    assert 0.0 < np.abs(moved).max() < 0.05


def test_what_a_false_loop_had_kept_out_comes_back(house: Map) -> None:
    """A false loop that is certain breaks the map; without it the true ones hold again."""
    loops = [loop for loop in house.loops if loop.accepted]
    last = max(loops, key=lambda loop: loop.keyframe - loop.place)
    assert last.motion is not None
    off = last.motion.T_reference_base.compose(gtsam.Pose2(1.5, 1.0, 0.5))  # type: ignore[arg-type]
    false = SavedFactor(Edge(last.place, last.keyframe, off, 1e-6 * np.eye(3), EdgeKind.LOOP, True), True)
    broken, poses = solved(house.contents.node_poses, [*house.factors, false], house.config, house.config)
    refused = sum(not factor.kept for factor in broken)
    assert refused > sum(not factor.kept for factor in house.factors)
    mended, back = solved(poses, broken[:-1], house.config, house.config)
    assert sum(not factor.kept for factor in mended) < refused
    moved = [a.translation() - b.translation() for a, b in zip(back, house.contents.node_poses, strict=True)]
    assert np.abs(moved).max() < 0.1


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
    load_map(tmp_path).edited({"turn": {"degrees": 10}}, out=tmp_path).close()
    found = load_map(tmp_path)
    assert found.edits == ["turn: {degrees: 10.0}\n"]
    first = (tmp_path / "trajectory.tum").read_text().splitlines()[1].split()
    assert float(first[1]) == pytest.approx(found.trajectory.positions_m[0, 0], abs=1e-6)
    found.check()
    with pytest.raises(ScanweaveError, match="is another map"):
        house.edited({}, out=tmp_path)


def test_a_loop_is_added_by_a_match_or_refused_with_the_reason(house: Map) -> None:
    loop = next(loop for loop in house.loops if loop.accepted)
    pair = [name(house, loop.keyframe), name(house, loop.place)]
    apart = between(house.keyframe_poses[loop.keyframe], house.keyframe_poses[loop.place])
    for guess in ({}, {"guess": (apart + np.array([0.2, -0.1, 0.1])).tolist()}):
        added = house.edited({"loops": {"add": [{"pair": pair, **guess}]}})
        assert len(added.loops) == len(house.loops) + 1 and added.loops[-1].accepted
        motion = added.loops[-1].motion
        assert motion is not None and loop.motion is not None
        off = loop.motion.T_reference_base.localCoordinates(motion.T_reference_base)  # type: ignore[arg-type]
        assert np.abs(off).max() < 0.05
        assert [factor.edge.loop for factor in added.factors][-1] == len(house.loops)
    far = [name(house, 0), name(house, len(house.keyframe_poses) // 3)]
    with pytest.raises(ScanweaveError, match=r"no loop between session 1, reading 0 and .*: \w+"):
        house.edited({"loops": {"add": [{"pair": far}]}})


def test_a_crop_leaves_the_inside_as_it_was(house: Map) -> None:
    assert house.grid is not None
    rows, cols = house.grid.steps.shape
    corner, cell = house.grid.T_map_grid, house.grid.resolution_m
    low = np.array([corner.x(), corner.y()]) + cell * np.array([cols // 4, rows // 4])
    high = np.array([corner.x(), corner.y()]) + cell * np.array([3 * cols // 4, 3 * rows // 4])
    box_ = [low.tolist(), [high[0], low[1]], high.tolist(), [low[0], high[1]]]
    cropped = house.edited({"crop": box_})
    assert cropped.grid is not None
    whole = house.grid.steps[rows // 4 : 3 * rows // 4, cols // 4 : 3 * cols // 4]
    assert abs(np.array(cropped.grid.steps.shape) - whole.shape).max() <= 1
    smallest = np.minimum(cropped.grid.steps.shape, whole.shape)
    both = [one[1 : smallest[0] - 1, 1 : smallest[1] - 1] for one in (cropped.grid.steps, whole)]
    assert (both[0] == both[1]).mean() > 0.999


def test_zones_become_masks_and_the_planner_keeps_out(house: Map, tmp_path: Path) -> None:
    start, goal = house.keyframe_poses[0, :2], house.keyframe_poses[len(house.keyframe_poses) // 4, :2]
    wall = (start + goal) / 2.0 + 0.4 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    edits = {
        "keep_out": [{"name": "hole", "polygon": wall.tolist()}],
        "slow": [{"name": "door", "polygon": (wall + 1.0).tolist(), "percent": 40.0}],
    }
    kept = house.edited(edits, out=tmp_path / "kept")
    assert kept.zones()["hole"] == pytest.approx(wall)
    mask = read_nav2_map(tmp_path / "kept" / "keepout_mask.yaml")
    assert 0.5 < (mask.values == 100).sum() * mask.resolution_m**2 / 0.64 < 1.5
    speed = read_nav2_map(tmp_path / "kept" / "speed_mask.yaml")
    assert set(np.unique(speed.values)) == {0, 40}
    driving = tmp_path / "kept" / "map.yaml"
    values = without_keep_out(read_nav2_map(driving), driving)
    assert (values[mask.values == 100] == 100).all()
    kept.undone(out=tmp_path / "kept")
    assert not list((tmp_path / "kept").glob("*_mask.*"))


def test_what_takes_the_log_is_refused_by_its_name(house: Map) -> None:
    with pytest.raises(ScanweaveError, match=r"keyframes\.distance_m = 0\.3 takes the log"):
        house.remap(["keyframes.distance_m=0.3"])
    with pytest.raises(ScanweaveError, match=r"did you mean 'grid\.resolution_m'"):
        house.remap(["grid.resolutoin_m=0.3"])
    none = house.remap(["loops.enabled=false"])
    assert not any(loop.accepted for loop in none.loops)
    assert all(factor.edge.loop is None for factor in none.factors)
    strict = house.remap(["loops.least_inlier_share=0.99"])
    accepted = sum(loop.accepted for loop in house.loops)
    assert sum(loop.accepted for loop in strict.loops) < accepted
    back = strict.remap(["loops.least_inlier_share=0.6"])
    assert sum(loop.accepted for loop in back.loops) == accepted
    assert content(back.undone().undone()) == content(house)
    doubting = house.remap(["loops.inlier_probability=0.01"])
    assert sum(factor.kept for factor in doubting.factors) < sum(factor.kept for factor in house.factors)


def test_a_setting_that_later_versions_lack_is_not_applied_again(
    house: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = house.remap(["grid.resolution_m=0.1", "layers.climb_m=0.02"])
    monkeypatch.setattr("slam.storage.map_edits._REMOVED", ("layers.climb_m=",))
    with load_map(fine.path) as again:
        assert again.contents.edits[0].settings == ("grid.resolution_m=0.1",)


def test_no_step_of_an_edited_map_is_forgotten_when_it_is_resumed(house: Map, tmp_path: Path) -> None:
    """A finished map that is resumed stays as it is, other settings and all."""
    fine = house.remap(["grid.resolution_m=0.1"], out=tmp_path)
    assert finished_map(tmp_path, house.identity)
    assert content(load_map(tmp_path)) == content(fine)


BOX = [[0, 0], [1, 0], [1, 1]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("erase: [{polygon: [[.nan, 0], [1, 0], [1, 1]]}]", "erase.0.polygon.0.0 = NaN"),
        ("erase: [{polygon: [[1e300, 0], [1, 0], [1, 1]]}]", "less than or equal to"),
        ("erase: [{polygon: [[0, 0], [1, 1]]}]", "at least 3 items"),
        ("erase: [{polygon: [" + "[0, 0], " * 5_000 + "[1, 1]]}]", "at most 1000 items"),
        ("erase: [{polygon: [" + "[0.12345, 0.12345], " * 1_000_000 + "[1, 1]]}]", "letters of YAML"),
        ("eraze: []", "unknown key 'eraze'; did you mean 'erase'?"),
        ("loops: {forbid: [[{reading: 1}, {reading: 99999}]]}", "there is no keyframe of session 1, reading"),
        ("loops: {forbid: [[{session: 7, reading: 1}, {reading: 2}]]}", "the map has 1 session"),
        ("loops: {forbid: [[{reading: 0}, {reading: 0}]]}", "not session 1, reading 0 with itself"),
        ("turn: {degrees: 5, to_walls: true}", "give one of to_walls"),
        ("turn: {along_x: [[1, 1], [1, 1]]}", "two different points"),
        ("settings: {keyframes.distance_m: 1.0}", "takes the log"),
        ("settings: {grid: {resolution_m: 1.0}}", "dotted names"),
        ("- erase", "holds a list"),
        ("places: [{name: x, position: [2020-01-01, 0]}]", 'places.0.position.0 = "2020-01-01"'),
        ("a: &a [*a]", "aliases are not read"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(house: Map, tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "edits.yaml"
    file.write_text(text)
    with pytest.raises(ScanweaveError) as caught:
        house.edited(file)
    assert said in str(caught.value) and len(str(caught.value)) < 400


def test_a_polygon_that_crosses_itself_has_an_inside(house: Map) -> None:
    x, y = house.keyframe_poses[0, :2]
    bow = [[x - 3, y - 3], [x + 3, y + 3], [x + 3, y - 3], [x - 3, y + 3]]
    edited = house.edited({"erase": [{"polygon": bow}]})
    assert edited.contents.edits[0].regions[0].points(house.keyframe_poses) == pytest.approx(np.array(bow))
    assert content(edited.undone()) == content(house)


def test_edits_are_read_back_as_they_were_written() -> None:
    edits = edits_of(
        {
            "loops": {"forbid": [[{"reading": 1}, {"session": 2, "reading": 3}]]},
            "erase": [{"polygon": BOX, "later": True}],
            "slow": [{"name": "ß <b>", "polygon": BOX, "percent": 10}],
            "turn": {"along_x": [[0, 0], [1, 0]]},
            "origin": [1, 2],
            "settings": {"grid.resolution_m": 0.1},
        },
        "here",
    )
    assert edits_of(yaml.safe_load(dump_edits(edits)), "there") == edits


def test_the_example_of_the_docs_is_understood() -> None:
    page = (Path(__file__).parents[2] / "docs" / "edits.md").read_text()
    edits = edits_of(yaml.safe_load(page.split("```yaml\n")[1].split("```")[0]), "the docs")
    assert set(edits.model_dump(exclude_defaults=True)) == set(type(edits).model_fields)


def test_a_damaged_edit_is_blamed_by_its_row(house: Map, tmp_path: Path) -> None:
    house.edited({"turn": {"degrees": 10}}, out=tmp_path).close()
    with sqlite3.connect(tmp_path / "map.db") as connection:
        connection.execute("UPDATE edits SET content = x'00' WHERE number = 0")
    connection.close()
    with pytest.raises(ScanweaveError, match="table edits, row 0: its checksum is wrong"):
        load_map(tmp_path)


def test_a_map_of_an_older_version_is_edited(house: Map, tmp_path: Path) -> None:
    """Schema 3 had neither edits nor covariances."""
    path = tmp_path / "map.db"
    path.write_bytes(content(house))
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE edits")
        connection.execute("DROP TABLE covariances")
        connection.execute("PRAGMA user_version = 3")
        connection.execute("DELETE FROM meta WHERE key = 'seal'")
    connection.close()
    file = MapFile.resume(path)
    assert file is not None
    file.seal()
    old = load_map(path)
    turned = old.edited({"turn": {"degrees": 90}})
    assert turned.covariances is not None  # they follow from the graph
    assert turned.undone().covariances is None
    assert turned.undone().keyframe_poses == pytest.approx(old.keyframe_poses, abs=0.0)
