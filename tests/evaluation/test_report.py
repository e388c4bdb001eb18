"""The report is one file, shows every loop, escapes every text and draws the map the right way up."""

from __future__ import annotations

import base64
import hashlib
import io
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from reading_pages import page_data

from slam.config import Config
from slam.datasets import ReadReport
from slam.estimates import MotionEstimate, Trajectory
from slam.evaluation.map_report import ReportData, RunCost
from slam.evaluation.report import write_report
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.map_result import MapResult
from slam.mapper.scan_record import ScanRecord
from slam.mapping.layered_map import OCCUPANCY
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import LaserScan
from slam.storage.map_contents import MapContents


class Page(HTMLParser):
    """What a browser would be asked to do."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [
            value or "" for name, value in attrs if name in {"src", "href", "srcset", "action"}
        ]

    def handle_data(self, data: str) -> None:
        self.text += data


def loop(number: int, *, accepted: bool, reason: str = "", score: float | None = 0.5) -> LoopCandidate:
    """Between two of a hundred keyframes that are 50 cm apart."""
    motion = None
    if score is not None:
        motion = MotionEstimate(gtsam.Pose2(), np.eye(3), score, 0.9, 0.01, True, False, np.zeros(3))
    return LoopCandidate(number % 50, number % 50 + 50, 1.0, 0.5, 1.0, motion, accepted, reason)


def grid_of(states: NDArray[np.int8]) -> OccupancyGrid:
    odds = np.select([states == 100, states == 0], [4.0, -4.0]).astype(np.float32)
    return OccupancyGrid.of_log_odds(odds, 0.05, gtsam.Pose2())


def known_room() -> NDArray[np.int8]:
    """A floor of 40 x 60 cells with a wall at its upper end, in the middle of what is unknown."""
    states = np.full((60, 80), -1, np.int8)
    states[10:50, 10:70] = 0
    states[49, 10:70] = 100
    return states


@pytest.fixture
def data() -> ReportData:
    generator = np.random.default_rng(0)
    stamps_s = 5.0 + 125.0 / 399.0 * np.arange(400)
    along = np.linspace(1.0, 3.0, 400)
    places = np.arange(100) // 50
    result = MapResult(
        MapContents(
            node_poses=[gtsam.Pose2(0.3 * place, -0.4 * place, 0.0) for place in places],
            stamps_s=stamps_s[::8],
            readings=np.arange(0, 400, 8),
            trajectory=Trajectory.from_planar(
                stamps_s, np.column_stack([along, 0.0 * along + 1.0, 0.0 * along])
            ),
            loops=[loop(3, accepted=True, score=0.871), loop(4, accepted=False, reason="too little overlap")],
            keyframe_scans=[LaserScan(0.0, np.ones(3, np.float32), -1.0, 1.0, 10.0)],
            grids={OCCUPANCY: grid_of(known_room())},
        ),
        scans=ScanRecord(
            stamps_s,
            generator.uniform(0.001, 0.002, 400),
            generator.uniform(0.8, 1.0, 400),
            generator.uniform(0.01, 0.02, 400),
            (np.arange(400) % 80 == 0).astype(float),
            *(np.full(400, np.nan) for _ in range(3)),
        ),
        stage_seconds={"match": 3.5, "optimise": 0.25},
        warnings=["the clock ran backward"],
    )
    reading = ReadReport()
    for number in range(785):
        reading.note("clock steps backward", number)
    return ReportData("fr079.log.gz", reading, result, Config(), RunCost(6.25, 7.94))


def having(data: ReportData, **changes: Any) -> ReportData:
    """A run whose map is another."""
    return replace(data, result=replace(data.result, map=replace(data.result.map, **changes)))


@pytest.fixture
def written(tmp_path: Path):
    def write(data: ReportData) -> str:
        write_report(tmp_path / "report.html", data)
        return (tmp_path / "report.html").read_text(encoding="utf-8")

    return write


def test_the_page_shows_what_it_was_given(data: ReportData, written) -> None:
    text = Page(written(data)).text
    expected = ["fr079.log.gz", "2.0 m", "2 min 05 s", "7.9 s", "6.2 s", "20.0 ×", " MB", "1 of 2"]
    expected += [
        "0.871",
        "0.50 m",
        "too little overlap",
        "785",
        "3.50 s",
        "the clock ran backward",
        "seed: 0",
        version("gtsam"),
    ]
    expected += ["5 of 50 matches left a direction undetermined"]
    assert [part for part in expected if part not in text] == []


def test_every_text_is_escaped(data: ReportData, written) -> None:
    evil = "<script>alert('&')</script>\""
    data.reading.note(evil, 1)
    refused = loop(1, accepted=False, reason=evil)
    evils = having(data, loops=[refused])
    evils.result.stage_seconds[evil], evils.result.warnings[:] = 1.0, [evil]
    html = written(replace(evils, log_name=evil))
    page, plain = Page(html), Page(written(data))
    assert page.tags.count("script") == plain.tags.count("script")
    assert page.text.count(evil) == 2 + 2 + 1 + 1 + 1  # title, heading, loops twice, notes, stages, warnings


def test_thousands_of_loops_are_all_there_and_folded(data: ReportData, written) -> None:
    refused = [loop(i, accepted=False, reason=f"reason {i % 3}", score=None) for i in range(6000)]
    accepted = [loop(i, accepted=True) for i in range(300)]
    html = written(having(data, loops=[*refused, *accepted]))
    folds = re.findall(r"<details>(.*?)</details>", html, flags=re.DOTALL)
    assert [fold.count("<tr><td>") for fold in folds] == [300, 6000, 0]
    assert "<td>99<td>49<td>0.50 m<td>–<td>" in folds[1] and "<td>reason 2" in folds[1]
    assert [f"<tr><td>reason {i}<td>2,000" in html for i in range(3)] == [True] * 3
    assert len(html) < 2_000_000


def test_a_few_accepted_loops_stand_open(data: ReportData, written) -> None:
    html = written(having(data, loops=[loop(i, accepted=True) for i in range(5)]))
    assert "accepted loops</summary>" not in html


def test_a_run_without_results_still_has_a_report(data: ReportData, written) -> None:
    empty = {
        "trajectory": Trajectory.from_planar(np.zeros(0), np.zeros((0, 3))),
        "readings": np.zeros(0, np.int64),
    }
    nothing = having(data, **empty, loops=[], grids={}).result.map
    html = written(replace(data, result=MapResult(nothing, ScanRecord(*(np.zeros(0) for _ in range(8))))))
    assert "0 accepted, 0 refused" in html
    assert "Warnings" not in html


def test_the_same_run_gives_the_same_bytes(data: ReportData, written, monkeypatch) -> None:
    monkeypatch.setattr(RunCost, "peak_memory_mb", staticmethod(lambda: 350.0))
    assert written(data) == written(data)


def test_a_failure_leaves_the_old_report(data: ReportData, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    monkeypatch.setattr(ReportData, "notes", property(lambda data: 1 / 0))
    with pytest.raises(ZeroDivisionError):
        write_report(path, data)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_asked_of_the_network_and_only_the_named_scripts_run(data: ReportData, written) -> None:
    html = written(data)
    page = Page(html)
    assert {"link", "iframe", "object", "base", "img"}.isdisjoint(page.tags)
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', html)
    assert policy is not None
    rules = unescape(policy[1])
    assert rules.startswith("default-src 'none'; ") and "connect-src 'none'" in rules
    scripts = re.findall(r"<script>(.*?)</script>", html, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in scripts]
    assert len(scripts) > 5 and all(f"'sha256-{one}'" in rules for one in hashes)
    assert not re.search(r"\son\w+=|javascript:", re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL))


def test_the_data_of_the_page_decodes_to_what_it_was_given(data: ReportData, written) -> None:
    found = page_data(written(data))
    assert found["planar"] and found["unit"] == "scan" and found["title"] == "fr079.log.gz"
    np.testing.assert_allclose(found["nodes"]["poses"][[0, 99]], [[0.0, 0.0, 0.0], [0.3, -0.4, 0.0]])
    np.testing.assert_array_equal(found["nodes"]["readings"], np.arange(0, 400, 8))
    assert found["loops"]["accepted"].tolist() == [1, 0]
    assert found["loops"]["reasons"][found["loops"]["reason"][1]] == "too little overlap"
    np.testing.assert_allclose(found["loops"]["score"], [0.871, 0.5], atol=1e-6)
    assert found["scans"]["first"].tolist()[:2] == [0, 3]
    layer = found["layers"][0]
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(layer["png"].split(",")[1]))))
    # 40 x 60 known cells and eight on each side; the wall at the upper end is at the top of the picture.
    assert image.shape == (layer["rows"], layer["cols"]) == (56, 76)
    assert layer["corner"] == pytest.approx([2 * 0.05, 2 * 0.05, 0.0])
    assert (image[8, 8:68] == 3).all() and (image[9:48, 8:68] == 1).all() and (image[:8] == 0).all()
    assert [chart["title"] for chart in found["charts"]][-1] == "Time per scan, ms"
