"""scanweave localize: its files, and its errors in one line."""

import csv
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from slam.cli.commands import app
from slam.errors import MapFileError
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.tum import read_tum


def test_a_log_is_localised_in_a_saved_map(tmp_path: Path) -> None:
    mapped = write_synthetic_log(tmp_path / "mapped", seed=1, duration_s=30.0)
    driven = write_synthetic_log(tmp_path / "driven", seed=2, duration_s=16.0)
    run = CliRunner().invoke
    folder, out = tmp_path / "map", tmp_path / "out"
    assert run(app, ["map", str(mapped.log_path), "-o", str(folder)]).exit_code == 0
    before = (folder / "map.db").read_bytes()
    result = run(app, ["localize", str(folder), str(driven.log_path), "-o", str(out)])
    assert result.exit_code == 0, result.output
    assert (folder / "map.db").read_bytes() == before, "the map was changed"

    trajectory = read_tum(out / "trajectory.tum")
    rows = list(csv.DictReader((out / "trajectory.csv").read_text().splitlines()))
    live = [row for row in rows if row["source"] == "live"]
    assert len(live) == driven.scan_count
    tracked = [row for row in rows if row["state"] == "tracking"]
    assert len(trajectory) == len(tracked) > 0.5 * driven.scan_count
    assert all(float(row["cov_x_x"]) > 0.0 for row in live if row["state"] == "tracking")
    # The map begins where the tour does, at rest and level with it.
    truth = driven.truth.to_planar()
    at = np.abs(driven.truth.stamps_s[None] - trajectory.stamps_s[:, None]).argmin(axis=1)
    wrong = np.hypot(*(truth[at, :2] - [1.0, 4.0] - trajectory.positions_m[:, :2]).T)
    assert np.median(wrong) < 0.05
    page = (out / "report.html").read_text()
    assert "tracking" in page and "searching" in page and "connect-src &#39;none&#39;" in page
    assert "not found" not in result.output
    short = tmp_path / "short.log"
    short.write_text("".join(driven.log_path.read_text().splitlines(keepends=True)[:20]))
    strict = ["--set", "localization.confident_probability=0.9999"]
    for given, remedy in (
        ([], "its initial pose (--start)"),
        (["--start", "90", "90", "0"], "another --start"),
    ):
        lost = run(app, ["localize", str(folder), str(short), "-o", str(tmp_path / "lost"), *strict, *given])
        assert lost.exit_code == 0
        assert f"the robot was not found in the map; a longer log or {remedy} may help" in lost.output


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    log = write_synthetic_log(tmp_path / "driven", seed=2, duration_s=12.0).log_path
    result = CliRunner().invoke(app, ["localize", str(tmp_path / "none"), str(log), "-o", str(tmp_path)])
    assert isinstance(result.exception, MapFileError)
    assert "no map at" in str(result.exception) and "\n" not in str(result.exception)


@pytest.mark.parametrize("arguments", [["localize"], ["localize", "map"]])
def test_wrong_usage(arguments: list[str]) -> None:
    assert CliRunner().invoke(app, arguments).exit_code == 2
