"""The commands beside `map`: inspect, evaluate, config, simulate, demo; and what an interrupt leaves."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import RESULTS, Scanweave, assert_one_line_error, log, mapped, scanweave

from slam.cli.simulate import _seconds_shown
from slam.config import load_config
from slam.simulation.synthetic_log import SyntheticLog

__all__ = ["log", "mapped", "scanweave"]  # fixtures


class TestInspect:
    def test_json(self, scanweave: Scanweave, log: SyntheticLog) -> None:
        outcome = scanweave("inspect", log.log_path, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        reported = json.loads(outcome.out)
        assert {sensor["sensor"]: sensor["count"] for sensor in reported["sensors"]} == {
            "FLASER": log.scan_count,
            "odometry": log.odometry_count,
        }
        assert reported["duration_s"] == pytest.approx(12.0)

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
        assert "nees: " in text.out and not re.search(r"\.\d{5}", text.out)

    def test_perfect_is_zero(self, scanweave: Scanweave, log: SyntheticLog) -> None:
        scores = json.loads(
            scanweave("evaluate", log.truth_path, "--groundtruth", log.truth_path, "--json").out
        )
        assert scores["ate"]["translation_m"]["max"] < 1e-9
        assert scores["rpe"]["rotation_rad"]["max"] < 1e-6

    def test_a_drive_shorter_than_delta_has_its_ate(self, scanweave: Scanweave, tmp_path: Path) -> None:
        truth, off = tmp_path / "truth.tum", tmp_path / "off.tum"
        for file, y in ((truth, 0.1), (off, 0.2)):
            poses = ((0.0, 0.0), (0.3, 0.0), (0.3, y), (0.6, y))
            file.write_text("".join(f"{n}.0 {x} {y} 0 0 0 0 1\n" for n, (x, y) in enumerate(poses)))
        arguments = ["evaluate", off, "--groundtruth", truth]
        outcome = scanweave(*arguments, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        scores = json.loads(outcome.out)
        assert 0.01 < scores["ate"]["translation_m"]["rmse"] < 0.1
        assert scores["rpe"] is None
        assert "rpe: none: the drive is shorter than delta" in scanweave(*arguments).out

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
        settings = ["grid.resolution_m=0.1", "layers.rule=printed", "loops.enabled=false"]
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
    assert "rooms visited: 1; 161 odometry, 80 lidar" in scanweave(*call).out
    assert (drive / "truth" / "extrinsics.yaml").is_file()
    assert scanweave("map", drive / "scans.log", "-o", tmp_path / "out").code == 0
    truth = ("--groundtruth", drive / "groundtruth.txt", "--json")
    scores = json.loads(scanweave("evaluate", tmp_path / "out" / "trajectory.tum", *truth).out)
    assert scores["ate"]["translation_m"]["rmse"] < 0.01


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (("--rig", "nope"), "no rig 'nope'"),
        (("--format", "avi"), "formats are avi"),
        (("--faults", "x"), "no fault preset 'x'"),
        (("--campus", "--faults", "harsh"), "no fault preset 'harsh'; there are none, usual"),
        (("--campus", "--office"), "leave out --rig, --imu, --office"),
        (("--street", "--rig", "xu2024x"), "there are car64, car16"),
        (("--tunnel",), "need --street"),
    ],
)
def test_simulate_shows_what_there_is(
    scanweave: Scanweave, tmp_path: Path, options: tuple[str, str], reported: str
) -> None:
    outcome = scanweave("simulate", "-o", tmp_path / "drive", *options)
    assert outcome.code == 1
    assert reported in outcome.err
    assert not (tmp_path / "drive").exists()


def test_harsh_faults_are_of_the_sensors_that_a_rig_has(scanweave: Scanweave, tmp_path: Path) -> None:
    """This robot has no lidar that could die: its camera does."""
    call = ("simulate", "-o", tmp_path / "drive", "--rig", "yang2021", "--faults", "harsh", "--duration", 1)
    assert scanweave(*call, "--format", "folder").code == 0
    faults = json.loads((tmp_path / "drive" / "truth" / "faults.json").read_text("utf-8"))
    assert faults["faults"]["dying_sensor"] == "camera"


def test_simulate_overwrites_nothing(scanweave: Scanweave, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    assert scanweave("simulate", "-o", tmp_path).code == 1
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_demo(scanweave: Scanweave, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slam.cli.demo._DURATION_S", 3.5)
    outcome = scanweave("demo", "-o", tmp_path / "demo", "--seed", 3)
    assert outcome.code == 0
    # Where it takes long, how far it is stands among them.
    said = re.compile(r"warning: |\w+: [\d,]+ scans and frames")
    assert all(said.match(line) for line in outcome.err.splitlines()), outcome.err
    assert {path.name for path in (tmp_path / "demo").iterdir()} == RESULTS | {"simulated-3", "layers"}
    found = re.search(r"([\d.]+) m RMSE against the ground truth", outcome.out)
    assert found is not None and float(found[1]) < 0.02


def test_an_interrupt_waits_while_a_drive_is_simulated() -> None:
    # In code that is being compiled it would surface as some other error, or be lost.
    with pytest.raises(KeyboardInterrupt), _seconds_shown() as stated:
        signal.raise_signal(signal.SIGINT)
        reached = True
        stated(1.0, 2.0)
    assert reached


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
    assert "map.db is kept; the same command with --resume" in complaint
    assert (out / "trajectory.tum").read_text() == "old"


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupt_waits_for_the_scan_to_end(
    scanweave: Scanweave, log: SyntheticLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    def build(
        dataset: object, settings: object, on_step: Callable[[str, int], None], checkpoint: object
    ) -> None:
        on_step("mapping", 1)
        signal.raise_signal(signal.SIGINT)
        seen.append(1)  # compiled code may run here, and gets to its end
        on_step("mapping", 2)
        seen.append(2)

    monkeypatch.setattr("slam.app.map_run.build_map", build)
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
import slam.cli, slam.app.map_run
build_map = slam.app.map_run.build_map
def announced(*arguments):
    print("mapping", flush=True)
    return build_map(*arguments)
slam.app.map_run.build_map = announced
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
