"""Edits when a session joins the map, or a run goes on: they stay, and can still be undone."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from edit_maps import box, content, occupied

import slam
from slam.app.progress import Progress
from slam.outputs.finished_map import Map, load_map
from slam.simulation.synthetic_log import write_synthetic_log


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("logs")
    lengths = {"first": 34.0, "later": 12.0}
    first, later = (
        write_synthetic_log(folder / part, seed=seed, duration_s=length).log_path
        for seed, (part, length) in enumerate(lengths.items(), start=1)
    )
    return first, later


@pytest.fixture(scope="module")
def house(logs: tuple[Path, Path]) -> Map:
    return slam.map_log(logs[0])


@pytest.fixture(scope="module")
def edited(house: Map, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The house turned, a box erased for good, a place named."""
    edits = {
        "erase": [{"polygon": box(house).tolist(), "later": True}],
        "turn": {"degrees": 90.0},
        "places": [{"name": "dock", "position": [0.5, 0.2]}],
    }
    return house.edited(edits, out=tmp_path_factory.mktemp("edited") / "map")


@pytest.fixture(scope="module")
def joined(edited: Map, logs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Map:
    return slam.join(edited, logs[1], out=tmp_path_factory.mktemp("joined") / "map").map


def test_edits_stay_when_a_session_joins_and_can_be_undone(
    house: Map, edited: Map, joined: Map, logs: tuple[Path, Path], tmp_path: Path
) -> None:
    polygon = box(house)
    turned = polygon @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert occupied(edited, turned) == 0
    assert len(joined.sessions) == 2 and joined.edits == edited.edits
    assert occupied(joined, turned) == 0
    assert joined.places["dock"] == pytest.approx([-0.2, 0.5, np.pi / 2], abs=0.05)
    first = len(house.keyframe_poses)
    assert joined.keyframe_poses[:first, :2] == pytest.approx(edited.keyframe_poses[:, :2], abs=0.1)
    before = joined.undone()
    assert len(before.sessions) == 2 and not before.edits
    assert occupied(before, polygon) > 10
    plainly = slam.join(house, logs[1], out=tmp_path / "plain").map
    assert before.keyframe_poses[:, :2] == pytest.approx(plainly.keyframe_poses[:, :2], abs=0.02)


def test_what_later_sessions_see_stays_unless_it_is_said(house: Map, logs: tuple[Path, Path]) -> None:
    polygon = box(house)
    edited = house.edited({"erase": [{"polygon": polygon.tolist()}]})
    joined = slam.join(edited, logs[1], out=edited.path.parent / "joined").map
    assert occupied(joined, polygon) > 0


def test_edits_stay_when_the_map_is_resumed(logs: tuple[Path, Path], tmp_path: Path) -> None:
    """A finished map that is gone on with by its log is as it was, edits and all."""
    out = tmp_path / "map"
    house = slam.map_log(logs[0], out=out)
    polygon = box(house)
    edited = house.edited({"erase": [{"polygon": polygon.tolist()}]}, out=out)
    before = content(edited)
    again = slam.map_log(logs[0], out=out, resume=True)
    assert content(again) == before and again.edits == edited.edits
    assert occupied(again, polygon) == 0 < occupied(again.undone(out=tmp_path / "undone"), polygon)


def test_edits_stay_when_an_interrupted_session_goes_on(
    house: Map, edited: Map, joined: Map, logs: tuple[Path, Path], tmp_path: Path
) -> None:
    """As if it had not been interrupted, to the byte; the map is as it was until then."""
    known = load_map(shutil.copytree(edited.path.parent, tmp_path / "known"))

    def interrupt(progress: Progress) -> None:
        if progress.stage == "mapping" and progress.readings > 25:
            raise KeyboardInterrupt

    before = content(known)
    with pytest.raises(KeyboardInterrupt):
        slam.join(known, logs[1], on_progress=interrupt)
    assert content(known) == before
    resumed = slam.join(load_map(known.path), logs[1], resume=True).map
    assert resumed.edits == known.edits
    assert content(resumed) == content(joined)
    assert occupied(resumed, box(house) @ np.array([[0.0, 1.0], [-1.0, 0.0]])) == 0
