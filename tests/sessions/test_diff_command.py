"""scanweave diff: what moved between two maps is reported, what cannot be compared is refused."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import outcome_of, run
from PIL import Image
from session_runs import mirror_of, part_of

import slam
from slam.simulation import floor_plan
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_file import MAP_NAME

SECONDS = 48.0  # on its way back the robot sees the pillar again
# The pillar in the corridor, and where it stands on the other day: a corner, width and depth.
PILLAR, MOVED = (5.9, 3.1, 0.3, 0.3), (7.0, 4.6, 0.3, 0.3)


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with maps: monday, tuesday (nothing has changed), wednesday (the pillar has moved)."""
    folder = tmp_path_factory.mktemp("days")
    for seed, day in enumerate(("monday", "tuesday", "wednesday")):
        with pytest.MonkeyPatch.context() as patch:
            if day == "wednesday":
                boxes = [MOVED if one == PILLAR else one for one in floor_plan._BOXES]
                patch.setattr(floor_plan, "_BOXES", boxes)
            log = write_synthetic_log(folder / f"{day}-log", seed=seed, duration_s=SECONDS).log_path
        assert run("map", log, "-o", folder / day) == 0
    return folder


def test_a_pillar_that_moved_is_reported(
    days: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    done = outcome_of(capsys, "diff", days / "monday", days / "wednesday", "-o", tmp_path / "diff")
    assert done.code == 0, done
    # Met from other sides on the two days, it need not look like the same pillar.
    assert re.search(r"an object of 0\.[34] x 0\.[234] m from \(5\.0, -0\.7\)", done.out)
    assert re.search(r"(an object of 0\.[34] x 0\.[234] m at|to) \(6\.2, 0\.7\)", done.out)
    stated = json.loads((tmp_path / "diff" / "diff.json").read_text())
    kinds = sorted(thing["what"] for thing in stated["things"])
    assert kinds in (["moved"], ["appeared", "went"]) and done.out.count("probability") == len(kinds)
    assert stated["seen_m2"]["both"] > 20.0
    shapes = json.loads((tmp_path / "diff" / "diff.geojson").read_text())["features"]
    assert sorted(shape["properties"]["at"] for shape in shapes) == ["after", "before"]
    for shape in shapes:
        (ring,) = shape["geometry"]["coordinates"]
        assert ring[0] == ring[-1] and len(ring) >= 4
    picture = np.asarray(Image.open(io.BytesIO((tmp_path / "diff" / "diff.png").read_bytes())))
    assert picture.shape[2] == 3
    colors = {"appeared": (0x25, 0x63, 0xB8), "went": (0xC2, 0x35, 0x2B), "moved": (0xD9, 0x73, 0x0D)}
    assert all((picture == colors[kind]).all(axis=2).any() for kind in kinds)


def test_where_nothing_moved_nothing_is_reported(days: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = outcome_of(capsys, "diff", days / "monday", days / "tuesday", "--json")
    assert done.code == 0, done
    assert json.loads(done.out)["things"] == []
    done = outcome_of(capsys, "diff", days / "monday", days / "monday")
    assert "nothing changed in the area that both visits saw" in done.out


def test_two_sessions_of_one_map(days: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    log = days / "wednesday-log" / "scans.log"
    assert run("map", log, "--into", days / "monday", "-o", tmp_path / "both") == 0
    done = outcome_of(capsys, "diff", tmp_path / "both", "--sessions", 1, 2)
    assert done.code == 0, done
    assert re.search(r"(at|to) \(6\.2, 0\.7\)", done.out) and "from (5.0, -0.7)" in done.out
    back = outcome_of(capsys, "diff", tmp_path / "both", "--sessions", 2, 1)
    assert "from (6.2, 0.7)" in back.out and re.search(r"(at|to) \(5\.0, -0\.7\)", back.out)
    assert "1 to 2; name two of them, not 2 and 3" in (
        outcome_of(capsys, "diff", tmp_path / "both", "--sessions", 2, 3).error()
    )
    # One of the maps is a part of the other.
    assert "are in the map already" in (
        outcome_of(capsys, "diff", tmp_path / "both", days / "monday").error()
    )


def test_what_cannot_be_compared_is_refused(
    days: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monday = days / "monday"
    (tmp_path / MAP_NAME).write_bytes(b"no map")
    for other in (tmp_path, tmp_path / "missing", days / "monday-log" / "scans.log"):
        outcome_of(capsys, "diff", monday, other, "-o", tmp_path / "out").error()
        outcome_of(capsys, "diff", other, monday, "-o", tmp_path / "out").error()
    assert "or two sessions of one map" in outcome_of(capsys, "diff", monday).error()
    assert (
        "or two sessions of one map" in outcome_of(capsys, "diff", monday, monday, "--sessions", 1, 2).error()
    )
    log = days / "tuesday-log" / "scans.log"
    begin_s = next(iter(slam.open_dataset(log))).stamp_s
    mirrored = mirror_of(
        part_of(log, tmp_path / "part.log", begin_s, begin_s + 12.0), tmp_path / "mirrored.log"
    )
    assert run("map", mirrored, "-o", tmp_path / "mirrored") == 0
    refused = outcome_of(capsys, "diff", monday, tmp_path / "mirrored", "-o", tmp_path / "out").error()
    assert "does not connect" in refused
    assert not (tmp_path / "out").exists()
