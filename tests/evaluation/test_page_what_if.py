"""The tab "What if" of a map's page in Chromium: what is switched moves the map and is written down."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gtsam
import numpy as np
import pytest
import yaml
from browser import ready, visit
from ring_graphs import PLANE, RINGS, ring, solved

from slam.config import Config
from slam.estimates import MotionEstimate, Trajectory
from slam.evaluation.saved_page import saved_page
from slam.graph.edge import Edge, EdgeKind
from slam.graph.loop_candidate import LoopCandidate
from slam.outputs.finished_map import Map
from slam.storage.map_contents import MapContents, SavedFactor
from slam.storage.map_sessions import MapSession

pytestmark = pytest.mark.browser
LAPS = 4
FALSE, REFUSED = (5, 30), (8, 33)


def candidate(edge: Edge, *, accepted: bool) -> LoopCandidate:
    """What an edge was made of."""
    motion = MotionEstimate(edge.T_source_target, edge.covariance, 0.9, 0.9, 0.01, True, False, np.zeros(3))
    reason = "" if accepted else "too few points fit"
    return LoopCandidate(edge.source, edge.target, 1.0, 0.5, 1.0, motion, accepted, reason)


def contents() -> MapContents:
    """A ring with true loops, a false one that was accepted, and one that was refused but has a match."""
    poses, edges = ring(*RINGS["plane"], laps=LAPS)
    loops = [candidate(edge, accepted=True) for edge in edges if edge.loop is not None]
    off = gtsam.Pose2(0.5, -0.8, 0.3)
    wrong = Edge(*FALSE, poses[5].between(poses[30]).compose(off), PLANE, EdgeKind.LOOP, False, len(loops))
    edges.append(wrong)
    outside = replace(wrong, source=REFUSED[0], target=REFUSED[1], T_source_target=gtsam.Pose2(0.1, 0.1, 0.5))
    loops += [candidate(wrong, accepted=True), candidate(outside, accepted=False)]
    poses = solved(poses, edges)
    stamps_s, count = np.arange(len(poses), dtype=np.float64), len(poses)
    rows = np.array([[*pose.translation(), pose.theta()] for pose in poses])
    return MapContents(
        poses,
        stamps_s,
        10 * np.arange(count),
        Trajectory.from_planar(stamps_s, rows),
        factors=[SavedFactor(edge, True) for edge in edges],
        loops=loops,
        keyframe_scans=[None] * count,
        measured_scans=[None] * count,
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The page of that map; no test leaves anything switched."""
    found = contents()
    session = MapSession("monday", "0" * 64, len(found.node_poses), len(found.trajectory))
    saved = SimpleNamespace(
        contents=found,
        config=Config(),
        path=Path("house/map.db"),
        sessions=[session],
        digest="0" * 64,
        warnings=[],
        notes=[],
    )
    file = tmp_path_factory.mktemp("page") / "map.html"
    file.write_text("".join(saved_page(cast(Map, saved))), encoding="utf-8")
    with visit(file) as seen:
        yield ready(seen).page
        assert seen.complaints == []
        assert seen.requests[:1] == [file.as_uri()]


def tab(page: Any, name: str) -> None:
    """Open it."""
    page.click(f"#tabs button:has-text('{name}')")


def select_loop(page: Any, number: int) -> None:
    """As a click on its row does."""
    page.evaluate("index => Scanweave.select.set({kind: 'loop', index})", number)


def stated(page: Any) -> str:
    """What the tab says."""
    text: str = page.inner_text("#panel-what-if")
    return text


def edits(page: Any) -> Any:
    """edits.yaml."""
    return yaml.safe_load(page.evaluate("Scanweave.editsText()"))


def test_a_loop_switched_off_moves_the_map_as_stated_and_back(page: Any) -> None:
    found = contents()
    number = len(found.loops) - 2
    select_loop(page, number)
    assert "Without it the map moves" in page.inner_text(".what-if")
    page.click(".what-if .switch")
    tab(page, "What if")
    held = [factor.edge for factor in found.factors][:-1]
    exact = solved(found.node_poses, held)
    shift = max(
        np.linalg.norm(a.translation() - b.translation())
        for a, b in zip(exact, found.node_poses, strict=True)
    )
    assert shift > 0.1
    assert f"moved by at most {shift:.2f} m" in stated(page)
    shown = np.array(page.evaluate("Array.from(Scanweave.plan.poses)")).reshape(-1, 3)
    assert shown[:, :2] == pytest.approx(np.array([pose.translation() for pose in exact]), abs=1e-4)
    pair = [{"session": 1, "reading": 10 * node} for node in FALSE]
    assert edits(page) == {"loops": {"forbid": [pair]}}
    page.click("#what-if-reset")
    assert not page.evaluate("Scanweave.plan.moved")
    assert edits(page) is None


def test_a_refused_loop_is_forced_on_by_a_key(page: Any) -> None:
    select_loop(page, len(contents().loops) - 1)
    assert "With it the map would move" in page.inner_text(".what-if")
    page.keyboard.press("x")
    assert page.evaluate("Scanweave.plan.moved")
    pair = [{"session": 1, "reading": 10 * node} for node in REFUSED]
    assert edits(page) == {"loops": {"force": [pair]}}
    page.keyboard.press("x")
    assert not page.evaluate("Scanweave.plan.moved")


def test_the_worst_are_switched_off_until_none_is_doubtful(page: Any) -> None:
    tab(page, "What if")
    # The false loop bends the map so that true ones are doubtful, too; it is the worst.
    assert "Doubtful loops: 6\noff frame 50 – frame 300" in stated(page)
    page.click("#snoop")
    page.wait_for_selector("text=Doubtful loops: 0")
    pair = [{"session": 1, "reading": 10 * node} for node in FALSE]
    assert edits(page) == {"loops": {"forbid": [pair]}}
    with page.expect_download() as download:
        page.click("#edits-download")
    assert download.value.suggested_filename == "edits.yaml"
    assert yaml.safe_load(Path(download.value.path()).read_text()) == edits(page)
    page.click("#what-if-reset")


def test_a_step_that_alone_holds_the_map_says_so(page: Any) -> None:
    page.evaluate("Scanweave.select.set({kind: 'edge', index: 0})")
    page.click(".what-if .switch")
    tab(page, "What if")
    assert "Changes to odometry edges are not saved" in stated(page)
    assert edits(page) is None
    page.click("#what-if-reset")
    page.evaluate("Scanweave.whatIf.on.fill(0); Scanweave.whatIf.update()")
    assert "would be disconnected" in stated(page)
    page.click("#what-if-reset")


def test_loops_are_sorted_by_what_they_do(page: Any) -> None:
    tab(page, "Loops")
    for name in ("moves", "removed"):
        page.click(f".row.head button:has-text('{name}')")
        assert page.get_attribute(".rows .row >> nth=0", "data-loop") == str(len(contents().loops) - 2)
