"""The whole way: experiment file, runs on a local cluster, tables, results for evo, the command."""

from __future__ import annotations

import csv
import sys
import tempfile
import threading
import time
import zipfile
from dataclasses import asdict
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
from command_line import Scanweave, assert_one_line_error, scanweave
from tiny_comparison import Tiny

from slam.comparison.compare import compare
from slam.comparison.drives import drives_of
from slam.comparison.experiment import Simulation, load_experiment
from slam.comparison.isolation import STOPPING
from slam.comparison.perform import record_drive
from slam.comparison.recording import record_comparison
from slam.comparison.runs import plan_of
from slam.comparison.store import ResultStore
from slam.evaluation.trajectory_error import compare_with_truth
from slam.storage.tum import read_tum

__all__ = ["scanweave"]


def test_every_run_is_one_row_whatever_became_of_it(tiny: Tiny) -> None:
    ended = {row["configuration"]: (row["status"], row["reason"]) for row in tiny.done.rows}
    assert {name: status for name, (status, _) in ended.items()} == {
        "full": "ok",
        "wheels only": "ok",
        "theirs": "ok",
        "absent": "failed",
    }
    assert "absent-flat.tum" in ended["absent"][1]
    assert tiny.done.done_now == len(tiny.done.rows) == 4


def test_the_figures_are_those_of_the_trajectory(tiny: Tiny) -> None:
    row = next(row for row in tiny.done.rows if row["configuration"] == "full")
    folder = ResultStore(tiny.out).of(row["key"])
    error = compare_with_truth(
        read_tum(folder / "trajectory.tum"), read_tum(tiny.folder / "theirs.tum")
    ).error
    assert row["figures"]["ate_m"] == error.translation_m.rmse < 0.05
    assert {"rpe_1m_m", "loops", "real_time_factor", "cpu_s", "peak_mb"} <= set(row["figures"])
    by_name = {row["configuration"]: row["figures"] for row in tiny.done.rows}
    assert by_name["theirs"]["ate_m"] < 1e-9 < by_name["full"]["ate_m"] < by_name["wheels only"]["ate_m"]
    assert "cpu_s" not in by_name["theirs"]  # nobody knows what theirs cost


def test_both_tables_hold_the_same_rows(tiny: Tiny) -> None:
    with (tiny.out / "results.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    table = pq.read_table(tiny.out / "results.parquet").to_pylist()
    assert len(lines) == len(table) == 4
    assert len({line["key"] for line in lines}) == 4
    for line, reported in zip(lines, table, strict=True):
        assert line["configuration"] == reported["configuration"] and line["status"] == reported["status"]
        assert (float(line["ate_m"]) if line["ate_m"] else None) == reported["ate_m"]


def test_evo_reads_what_is_written_for_it(tiny: Tiny) -> None:
    from evo.tools.file_interface import load_res_file

    zips = sorted((tiny.out / "evo").glob("*.zip"))
    assert len(zips) == 3
    found = load_res_file(next(path for path in zips if "full" in path.name), load_trajectories=True)
    row = next(row for row in tiny.done.rows if row["configuration"] == "full")
    assert found.stats["rmse"] == pytest.approx(row["figures"]["ate_m"], rel=1e-9)
    assert np.sqrt(np.mean(found.np_arrays["error_array"] ** 2)) == pytest.approx(found.stats["rmse"])
    sizes = {len(found.np_arrays[name]) for name in ("error_array", "timestamps", "seconds_from_start")}
    assert len(sizes) == 1 and found.np_arrays["seconds_from_start"][0] == 0.0
    assert found.trajectories["estimate"].num_poses == len(
        read_tum(ResultStore(tiny.out).of(row["key"]) / "trajectory.tum")
    )
    with zipfile.ZipFile(zips[0]) as archive:
        assert {info.date_time[0] for info in archive.infolist()} == {1980}


def test_resume_runs_only_what_is_missing(tiny: Tiny, scanweave: Scanweave) -> None:
    wheels = next(row for row in tiny.done.rows if row["configuration"] == "wheels only")
    before = {row["key"]: ResultStore(tiny.out).row(row["key"]) for row in tiny.done.rows}
    ResultStore(tiny.out).forget(wheels["key"])
    outcome = scanweave("compare", tiny.file, "-o", tiny.out, "--resume", "--workers", "1")
    assert outcome.code == 0
    assert "4 runs, 1 of them now, 1 without a result" in outcome.out
    assert outcome.err.count("\n") == 1 and "[1/1] flat, wheels only, seed 0: ok" in outcome.err
    after = {row["key"]: ResultStore(tiny.out).row(row["key"]) for row in tiny.done.rows}
    assert {key for key in before if before[key] != after[key]} <= {wheels["key"]}
    assert after[wheels["key"]] is not None


def test_where_nothing_has_a_result_the_command_says_so(tmp_path: Path, scanweave: Scanweave) -> None:
    (tmp_path / "x.yaml").write_text(
        "{name: x, commands: [{name: c, command: [no-such-program]}], timeout_s: 60}"
    )
    outcome = scanweave("compare", tmp_path / "x.yaml", "-o", tmp_path / "out")
    assert outcome.code == 1
    assert "no run has a result; the first: cannot start no-such-program" in outcome.err
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_recording_shows_every_result_beside_the_truth(tiny: Tiny) -> None:
    viewer = Mock()
    record_comparison(viewer, tiny.done.rows, ResultStore(tiny.out))
    shown = {call.args[0]: call.args[1] for call in viewer.polyline.call_args_list}
    shown |= {f"grid {call.args[0]}": call.args[1] for call in viewer.grid.call_args_list}
    ways = {name for name in shown if not name.startswith("grid")}
    assert ways == {f"flat/{name}/seed 0" for name in ("full", "wheels only", "theirs")}
    assert "grid flat/full/seed 0" in shown
    truth = read_tum(tiny.folder / "theirs.tum")
    np.testing.assert_allclose(shown["flat/theirs/seed 0"], truth.positions_m, atol=1e-9)


def test_a_missing_extra_names_the_command_that_installs_it(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, scanweave: Scanweave
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    outcome = scanweave("compare", tiny.file, "-o", tiny.folder / "none")
    assert_one_line_error(outcome, "compare needs pyarrow", "pip install 'scanweave[compare]'")
    assert not (tiny.folder / "none").exists()


def test_wrong_usage_and_a_silent_scheduler(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, scanweave: Scanweave
) -> None:
    both = ("--workers", "2", "--scheduler", "tcp://127.0.0.1:9")
    assert scanweave("compare", tiny.file, "-o", tiny.folder / "none", *both).code == 2
    monkeypatch.setattr("slam.comparison.cluster._CONNECT_S", 0.3)
    outcome = scanweave("compare", tiny.file, "-o", tiny.folder / "none", "--scheduler", "tcp://127.0.0.1:9")
    assert_one_line_error(outcome, "no Dask scheduler answers at tcp://127.0.0.1:9", "dask scheduler")


def test_drives_are_simulated_once_and_shared(tmp_path: Path) -> None:
    (drive,) = drives_of(Simulation(rig="sick2d", homes=[1], duration_s=2.0))
    folder = tmp_path / "drives" / drive.folder_name
    made_ns = set()
    for _ in range(2):
        assert record_drive(asdict(drive), str(folder), 300.0, 4000.0) == ""
        made_ns.add((folder / "groundtruth.txt").stat().st_mtime_ns)
    assert len(made_ns) == 1
    assert list((tmp_path / "drives").iterdir()) == [folder]
    assert (folder / "truth" / "grid_robot.npz").is_file() and (folder / "scans.log").is_file()


def test_a_drive_that_is_stopped_leaves_no_file(tmp_path: Path) -> None:
    (drive,) = drives_of(Simulation(rig="sick2d", homes=[1], duration_s=60.0))
    folder = tmp_path / "drives" / drive.folder_name

    def stop() -> None:
        while not list(tmp_path.glob("drives/.*/.*.part/*")) and not list(tmp_path.glob("drives/.*.part/*")):
            time.sleep(0.01)
        STOPPING.set()

    thread = threading.Thread(target=stop, daemon=True)
    thread.start()
    try:
        assert record_drive(asdict(drive), str(folder), 300.0, 4000.0) == "was interrupted"
    finally:
        STOPPING.clear()
    assert list((tmp_path / "drives").iterdir()) == []


def test_runs_without_their_drive_are_rows(tmp_path: Path) -> None:
    simulate = "{rig: sick2d, homes: [1], duration_s: 2}"
    text = f"{{name: x, datasets: [{{simulate: {simulate}}}], baselines: [wheels], timeout_s: 0.05}}"
    (tmp_path / "x.yaml").write_text(text)
    (row,) = compare(tmp_path / "x.yaml", tmp_path / "out", workers=1).rows
    assert row["status"] == "failed"
    assert "its data set could not be made: took longer than 0.05 s" in row["reason"]


def test_an_interrupt_ends_the_runs_at_once_and_resume_repeats_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (temporary := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    long, short = ("['{python}', -c, 'import time; time.sleep(600)']", "['{python}', -V]")
    (tmp_path / "x.yaml").write_text(
        f"{{name: x, commands: [{{name: long, command: {long}}}, {{name: short, command: {short}}}]}}"
    )

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare(tmp_path / "x.yaml", tmp_path / "out", workers=2, on_row=interrupt)
    assert psutil.Process().children(recursive=True) == []
    assert not STOPPING.is_set() and list(temporary.iterdir()) == []
    store = ResultStore(tmp_path / "out")
    plan = plan_of(load_experiment(tmp_path / "x.yaml"), tmp_path, tmp_path)
    ended = {run.configuration: store.row(run.key) for run in plan.runs}
    assert ended["short"] is not None and ended["short"]["status"] == "ok"
    assert ended["long"] is None or ended["long"]["reason"] == "was interrupted"
    assert store.missing([run.key for run in plan.runs], resume=True) == {plan.runs[0].key}
