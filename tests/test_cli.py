"""The command line: exit codes, one-line errors, files, and what each command prints."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from slam.cli import main
from slam.config import load_config
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log
from slam.storage.tum import read_tum

COMMANDS = ("map", "inspect", "evaluate", "config", "simulate", "demo")
RESULTS = {"trajectory.tum", "graph.g2o", "map.yaml", "map.pgm", "map.db", "report.html"}


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str


Scanweave = Callable[..., Outcome]


@pytest.fixture
def scanweave(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Scanweave:
    """The command, in this process."""
    monkeypatch.setenv("TERMINAL_WIDTH", "200")

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["scanweave", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            code: object = 0
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        assert isinstance(code, int)
        return Outcome(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    return write_synthetic_log(tmp_path_factory.mktemp("log"), duration_s=12.0)


@pytest.fixture(scope="module")
def mapped(log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with default settings."""
    out = tmp_path_factory.mktemp("mapped") / "made" / "where missing"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["scanweave", "map", str(log.log_path), "-o", str(out)])
        with pytest.raises(SystemExit) as stop:
            main()
    assert not stop.value.code
    return out


def assert_one_line_error(outcome: Outcome, *parts: str) -> None:
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("scanweave: ")
    assert [part for part in parts if part not in outcome.err] == []


class TestMap:
    def test_it_writes_what_it_promises_and_nothing_else(self, mapped: Path) -> None:
        assert {path.name for path in mapped.iterdir()} == RESULTS

    def test_it_says_what_it_did(self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path) -> None:
        outcome = scanweave("map", log.log_path, "-o", tmp_path)
        assert (outcome.code, outcome.err) == (0, "")
        first, second = outcome.out.splitlines()
        assert first.startswith(f"{log.scan_count} scans, ")
        assert " 0 records dropped, " in first
        assert [name for name in RESULTS if str(tmp_path / name) not in second] == []

    def test_a_second_run_replaces_the_first(
        self, scanweave: Scanweave, log: SyntheticLog, mapped: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "trajectory.tum").write_text("old")
        (tmp_path / "mine.txt").write_text("mine")
        assert scanweave("map", log.log_path, "-o", tmp_path).code == 0
        for name in RESULTS - {"report.html"}:
            assert (tmp_path / name).read_bytes() == (mapped / name).read_bytes(), name
        assert {path.name for path in tmp_path.iterdir()} == RESULTS | {"mine.txt"}

    def test_the_report_is_one_file(self, mapped: Path) -> None:
        html = (mapped / "report.html").read_text(encoding="utf-8")
        page = _Page(html)
        assert {"script", "link", "iframe", "object", "base"}.isdisjoint(page.tags)
        assert page.addresses and all(address.startswith("data:") for address in page.addresses)
        assert not re.search(r"https?://|@import|url\(", re.sub(r"base64,[^\"]*", "", html))
        assert "resolution_m: 0.05" in html

    @pytest.mark.parametrize(
        ("arguments", "shown"),
        [
            (["--no-odometry"], "use_wheel_odometry: false"),
            (["--set", "lidar_odometry.method=kiss_icp"], "method: kiss_icp"),
            (["--no-loops"], "enabled: false"),
            (["--set", "grid.resolution_m=0.2", "-s", "seed=7"], "resolution_m: 0.2"),
        ],
        ids=lambda value: value[-1] if isinstance(value, list) else "",
    )
    def test_options_reach_the_run(
        self,
        scanweave: Scanweave,
        log: SyntheticLog,
        mapped: Path,
        tmp_path: Path,
        arguments: list[str],
        shown: str,
    ) -> None:
        outcome = scanweave("map", log.log_path, "-o", tmp_path, *arguments)
        assert outcome.code == 0
        assert shown in (tmp_path / "report.html").read_text(encoding="utf-8")
        truth, poses = log.truth.positions_m, read_tum(tmp_path / "trajectory.tum").positions_m
        assert np.linalg.norm(poses[-1] - (truth[-1] - truth[0])) < 0.1
        if "grid" in arguments[-1]:
            assert (tmp_path / "map.yaml").read_text() != (mapped / "map.yaml").read_text()

    def test_a_configuration_file(self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path) -> None:
        (tmp_path / "mine.yaml").write_text("grid:\n  resolution_m: 0.25\n")
        outcome = scanweave("map", log.log_path, "-o", tmp_path, "--config", tmp_path / "mine.yaml")
        assert outcome.code == 0
        assert "resolution: 0.25" in (tmp_path / "map.yaml").read_text()

    def test_verbose_names_every_loop(
        self,
        scanweave: Scanweave,
        log: SyntheticLog,
        tmp_path: Path,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        # A small house and short ways round: candidates even in this short drive.
        settings = ["--set", "loops.least_path_m=2.0", "--set", "loops.every_m=0.5"]
        with caplog.at_level(logging.INFO, logger="slam"):
            outcome = scanweave("-v", "map", log.log_path, "-o", tmp_path, *settings)
        found = re.search(r"(\d+) of (\d+) loops accepted", outcome.out)
        assert found is not None and int(found[2]) > 0
        lines = [record.getMessage() for record in caplog.records if record.name.startswith("slam.graph")]
        assert len([line for line in lines if re.match(r"loop \d+ -> \d+: (accepted|refused)", line)]) == int(
            found[2]
        )


class TestBadInput:
    @pytest.mark.parametrize("command", [["map", "-o", "out"], ["inspect"]], ids=["map", "inspect"])
    @pytest.mark.parametrize(
        ("make", "parts"),
        [
            (lambda path: None, ["does not exist", "CARMEN"]),
            (lambda path: path.mkdir(), ["directory"]),
            (lambda path: path.touch(), ["is empty"]),
            (lambda path: path.write_bytes(b"\x1f\x8b\x08\x00garbage"), ["damaged"]),
            (lambda path: path.write_bytes(bytes(range(256)) * 40), ["known format"]),
            (lambda path: path.write_text("# only comments\n"), ["no odometry and no scan"]),
        ],
        ids=["missing", "directory", "empty", "damaged gzip", "binary", "comments"],
    )
    def test_a_log_that_is_none(
        self,
        scanweave: Scanweave,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        command: list[str],
        make: Callable[[Path], object],
        parts: list[str],
    ) -> None:
        monkeypatch.chdir(tmp_path)
        path = Path("it.log")
        make(path)
        assert_one_line_error(scanweave(command[0], path, *command[1:]), "it.log", *parts)

    def test_odometry_only(self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path) -> None:
        lines = [line for line in log.log_path.read_text().splitlines() if not line.startswith("FLASER")]
        (tmp_path / "wheels.log").write_text("\n".join(lines) + "\n")
        outcome = scanweave("map", tmp_path / "wheels.log", "-o", tmp_path / "out")
        assert_one_line_error(outcome, "no scan or frame", "scanweave inspect")

    def test_damaged_records_are_counted_and_skipped(
        self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path
    ) -> None:
        damaged = tmp_path / "damaged.log"
        lines = log.log_path.read_text().splitlines()
        scans = [number for number, line in enumerate(lines) if line.startswith("FLASER")]
        lines[scans[10]] = lines[scans[10]][:500]
        lines[scans[20]] = lines[scans[20]].replace("FLASER 361", "FLASER 99999")
        lines[scans[30] - 1] = "ODOM nan 0 0 0 0 0 1006.0 synthetic 6.0"
        damaged.write_text("\n".join(lines) + "\n")
        outcome = scanweave("map", damaged, "-o", tmp_path / "out")
        assert outcome.code == 0
        assert "3 records dropped" in outcome.out
        assert outcome.out.startswith(f"{log.scan_count - 2} scans")
        assert "dropped: " in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        inspected = json.loads(scanweave("inspect", damaged, "--json").out)
        assert sum(tally["count"] for tally in inspected["dropped"].values()) == 3

        for command in (["map", damaged, "-o", tmp_path / "strict"], ["inspect", damaged]):
            stopped = scanweave(*command, "--strict")
            assert_one_line_error(stopped, f"damaged.log, line {scans[10] + 1}: ", "--strict")
        assert not list((tmp_path / "strict").glob("*"))

    @pytest.mark.parametrize("below", ["", "sub"])
    def test_a_file_where_the_folder_should_be(
        self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path, below: str
    ) -> None:
        (tmp_path / "file").write_text("mine")
        outcome = scanweave("map", log.log_path, "-o", tmp_path / "file" / below)
        assert_one_line_error(outcome, "folder", str(tmp_path / "file"))
        assert (tmp_path / "file").read_text() == "mine"

    @pytest.mark.parametrize(
        ("setting", "parts"),
        [
            ("grid.resolutoin_m=0.1", ["unknown key", "grid.resolution_m"]),
            ("grid.resolution_m=-1", ["grid.resolution_m", "greater than 0"]),
            ("grid.resolution_m=wide", ["grid.resolution_m", "wide"]),
            ("lidar_odometry.method=magic", ["lidar_odometry.method", "surfel"]),
            ("grid", ["section.field=value"]),
        ],
    )
    @pytest.mark.parametrize("command", ["map", "config"])
    def test_a_bad_setting(
        self,
        scanweave: Scanweave,
        log: SyntheticLog,
        tmp_path: Path,
        command: str,
        setting: str,
        parts: list[str],
    ) -> None:
        arguments = [log.log_path, "-o", tmp_path / "out"] if command == "map" else []
        assert_one_line_error(scanweave(command, *arguments, "--set", setting), *parts)
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("name", ["lidar2", "nowhere.yaml"])
    def test_a_preset_that_is_none(self, scanweave: Scanweave, name: str) -> None:
        assert_one_line_error(scanweave("config", "--config", name), name, "lidar2d")

    def test_a_disk_that_refuses(
        self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(self: Path, target: Path) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Path, "replace", refuse)
        outcome = scanweave("map", log.log_path, "-o", tmp_path)
        assert_one_line_error(outcome, "No space left on device", "trajectory.tum")
        # Once there is room, --resume needs no mapping.
        assert [path.name for path in tmp_path.iterdir()] == ["map.db"]


class TestUsage:
    @pytest.mark.parametrize("command", COMMANDS)
    def test_help(self, scanweave: Scanweave, command: str) -> None:
        outcome = scanweave(command, "--help")
        assert (outcome.code, outcome.err) == (0, "")
        assert "Usage" in outcome.out and command in outcome.out

    def test_help_lists_every_command(self, scanweave: Scanweave) -> None:
        out = scanweave("--help").out
        assert [command for command in COMMANDS if f" {command} " not in out] == []

    @pytest.mark.parametrize(
        "arguments",
        [
            [],
            ["fly"],
            ["map"],
            ["map", "x.log"],
            ["map", "x.log", "-o", "out", "--no-such-option"],
            ["inspect"],
            ["demo", "--seed", "-1"],
            ["evaluate", "x.tum"],
            ["evaluate", "x.tum", "--relations", "a", "--groundtruth", "b"],
            ["evaluate", "x.tum", "--groundtruth", "b", "--delta", "much"],
            ["evaluate", "x.tum", "--groundtruth", "b", "--tolerance", "-1"],
        ],
        ids=" ".join,
    )
    def test_wrong_usage(
        self, scanweave: Scanweave, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        outcome = scanweave(*arguments)
        assert outcome.code == 2
        assert "Traceback" not in outcome.err
        assert list(tmp_path.iterdir()) == []


class TestInspect:
    def test_json(self, scanweave: Scanweave, log: SyntheticLog) -> None:
        outcome = scanweave("inspect", log.log_path, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        told = json.loads(outcome.out)
        assert {sensor["sensor"]: sensor["count"] for sensor in told["sensors"]} == {
            "FLASER": log.scan_count,
            "odometry": log.odometry_count,
        }
        assert told["duration_s"] == pytest.approx(12.0)

    def test_text(self, scanweave: Scanweave, log: SyntheticLog) -> None:
        outcome = scanweave("inspect", log.log_path)
        assert outcome.code == 0
        assert "FLASER" in outcome.out and str(log.odometry_count) in outcome.out


class TestEvaluate:
    @pytest.fixture
    def relations(self, log: SyntheticLog, tmp_path: Path) -> Path:
        """Two true relations, and one of another day."""
        path = tmp_path / "true.relations"
        first, last = log.truth.to_planar()[[0, -1]]
        assert np.allclose(first[2], 0.0)
        dx, dy, yaw = last - first
        path.write_text(
            f"1000.0 1012.0 {dx} {dy} 0 0 0 {yaw}\n"
            f"1000.0 1012.0 {dx + 1.0} {dy} 0 0 0 {yaw}\n"
            "5000.0 5001.0 0 0 0 0 0 0\n"
        )
        return path

    def test_relations(self, scanweave: Scanweave, mapped: Path, relations: Path) -> None:
        trajectory = mapped / "trajectory.tum"
        outcome = scanweave("evaluate", trajectory, "--relations", relations, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        score = json.loads(outcome.out)["relations"]
        assert (score["used"], score["skipped"], score["long"]) == (2, 1, None)
        assert score["translation_m"]["min"] < 0.02
        assert score["translation_m"]["max"] == pytest.approx(1.0, abs=0.02)
        text = scanweave("evaluate", trajectory, "--relations", relations)
        assert text.code == 0
        assert "used: 2" in text.out and "skipped: 1" in text.out and "[deg]" in text.out

    def test_groundtruth(self, scanweave: Scanweave, mapped: Path, log: SyntheticLog) -> None:
        arguments = ["evaluate", mapped / "trajectory.tum", "--groundtruth", log.truth_path]
        outcome = scanweave(*arguments, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        scores = json.loads(outcome.out)
        assert scores["ate"]["translation_m"]["rmse"] < 0.01
        assert scores["rpe"]["delta"] == 1.0
        text = scanweave(*arguments, "--delta", "2", "--tolerance", "0.01")
        assert text.code == 0
        assert "ate:" in text.out and "delta: 2.0" in text.out

    def test_perfect_is_zero(self, scanweave: Scanweave, log: SyntheticLog) -> None:
        scores = json.loads(
            scanweave("evaluate", log.truth_path, "--groundtruth", log.truth_path, "--json").out
        )
        assert scores["ate"]["translation_m"]["max"] < 1e-9
        assert scores["rpe"]["rotation_rad"]["max"] < 1e-6

    @pytest.mark.parametrize("option", ["--relations", "--groundtruth"])
    def test_files_that_are_none(
        self, scanweave: Scanweave, mapped: Path, tmp_path: Path, option: str
    ) -> None:
        trajectory, nowhere = mapped / "trajectory.tum", tmp_path / "nowhere"
        (tmp_path / "text").write_text("a few words\n")
        assert_one_line_error(scanweave("evaluate", trajectory, option, nowhere), "nowhere")
        assert_one_line_error(scanweave("evaluate", trajectory, option, tmp_path / "text"), "text:1")
        assert_one_line_error(scanweave("evaluate", trajectory, option, tmp_path), str(tmp_path))
        assert_one_line_error(scanweave("evaluate", nowhere, option, trajectory), "nowhere")

    def test_another_clock(self, scanweave: Scanweave, mapped: Path, tmp_path: Path) -> None:
        other = tmp_path / "other.tum"
        other.write_text("\n".join(f"{n}.0 {n} {n * n} 0 0 0 0 1" for n in range(9)) + "\n")
        outcome = scanweave("evaluate", mapped / "trajectory.tum", "--groundtruth", other)
        assert_one_line_error(outcome, "clock")


class TestConfig:
    def test_it_reads_back_as_what_it_is(self, scanweave: Scanweave, tmp_path: Path) -> None:
        settings = ["grid.resolution_m=0.1", "lidar_odometry.method=kiss_icp", "loops.enabled=false"]
        outcome = scanweave("config", *(part for setting in settings for part in ("--set", setting)))
        assert (outcome.code, outcome.err) == (0, "")
        (tmp_path / "effective.yaml").write_text(outcome.out)
        assert load_config(str(tmp_path / "effective.yaml")) == load_config(None, settings)
        assert load_config(None, settings) != load_config()

    def test_every_field_is_explained(self, scanweave: Scanweave) -> None:
        lines = scanweave("config").out.splitlines()
        for above, line in zip(["", *lines], lines, strict=False):
            if re.match(r"\s*\w+: ", line):
                assert above.strip().startswith("# "), line


def test_simulate_then_map_recovers_the_drive(scanweave: Scanweave, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    call = ("simulate", "-o", drive, "--rig", "sick2d", "--home", 2, "--duration", 8, "--format", "folder")
    assert scanweave(*call).code == 0
    assert (drive / "truth" / "extrinsics.yaml").is_file()
    assert scanweave("map", drive / "scans.log", "-o", tmp_path / "out").code == 0
    truth = ("--groundtruth", drive / "groundtruth.txt", "--json")
    scores = json.loads(scanweave("evaluate", tmp_path / "out" / "trajectory.tum", *truth).out)
    assert scores["ate"]["translation_m"]["rmse"] < 0.01


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--rig", "nope"), "no rig 'nope'"),
        (("--format", "avi"), "formats are avi"),
        (("--faults", "x"), "no fault preset 'x'"),
    ],
)
def test_simulate_tells_what_there_is(
    scanweave: Scanweave, tmp_path: Path, options: tuple[str, str], told: str
) -> None:
    outcome = scanweave("simulate", "-o", tmp_path / "drive", *options)
    assert outcome.code == 1
    assert told in outcome.err
    assert not (tmp_path / "drive").exists()


def test_simulate_overwrites_nothing(scanweave: Scanweave, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    assert scanweave("simulate", "-o", tmp_path).code == 1
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_demo(scanweave: Scanweave, tmp_path: Path) -> None:
    outcome = scanweave("demo", "-o", tmp_path / "demo", "--seed", 3)
    assert (outcome.code, outcome.err) == (0, "")
    assert {path.name for path in (tmp_path / "demo").iterdir()} == RESULTS | {"simulated-3"}
    found = re.search(r"translation \[m\]: mean ([\d.]+)", outcome.out)
    assert found is not None and float(found[1]) < 0.02


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_interrupted(log: SyntheticLog, tmp_path: Path) -> None:
    # Long enough that the interrupt meets the run amid its scans.
    long, out = tmp_path / "long.log", tmp_path / "out"
    long.write_bytes(log.log_path.read_bytes() * 40)
    out.mkdir()
    (out / "trajectory.tum").write_text("old")
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", _ANNOUNCED, "-v", "map", str(long), "-o", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "mapping\n"
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        rest, complaint = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130, complaint
    assert "Traceback" not in complaint
    assert complaint.splitlines()[-1].startswith("scanweave: interrupted")
    assert "scans" not in rest
    assert {path.name for path in out.iterdir()} == {"trajectory.tum", "map.db"}
    assert "map.db is not finished; the same command with --resume" in complaint
    assert (out / "trajectory.tum").read_text() == "old"


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupt_waits_for_the_scan_to_end(
    scanweave: Scanweave, log: SyntheticLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    def build(dataset: object, settings: object, on_scan: Callable[[int], None], journal: object) -> None:
        on_scan(1)
        signal.raise_signal(signal.SIGINT)
        seen.append(1)  # compiled code may run here, and gets to its end
        on_scan(2)
        seen.append(2)

    monkeypatch.setattr("slam.pipeline.build_map", build)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        outcome = scanweave("map", log.log_path, "-o", tmp_path)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)
    assert (outcome.code, outcome.err.count("\n"), seen) == (130, 2, [1])


# The command, but it says when the mapping begins: an interrupt while Python still loads proves nothing.
# A shell that runs the tests in the background makes its children ignore the signal.
_ANNOUNCED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import slam.cli, slam.pipeline
build_map = slam.pipeline.build_map
def announced(*arguments):
    print("mapping", flush=True)
    return build_map(*arguments)
slam.pipeline.build_map = announced
sys.argv[0] = "scanweave"
slam.cli.main()
"""


def test_the_installed_command_is_this_one() -> None:
    command = Path(sys.executable).with_name("scanweave")
    if not command.exists():
        pytest.skip("scanweave is not installed in this environment")
    done = subprocess.run([command, "config"], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "resolution_m" in done.stdout


class _Page(HTMLParser):
    """Tags, and the addresses that they load."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
