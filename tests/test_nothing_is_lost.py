"""What a mistyped command, a full or read-only disk, or a wrong argument must not destroy."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Scanweave, assert_one_line_error, log, mapped, scanweave

import slam
from slam.errors import MapFileError, ScanweaveError
from slam.simulation.synthetic_log import SyntheticLog, write_synthetic_log
from slam.storage.files import write_bytes
from slam.viewer.viewer import recording

__all__ = ["log", "mapped", "scanweave"]


@pytest.fixture
def house(mapped: Path, tmp_path: Path) -> Path:
    """A copy of a map that must stay as it is."""
    return Path(shutil.copytree(mapped, tmp_path / "house"))


@pytest.mark.parametrize(
    "words",
    [
        "export HOUSE -f tum -o HOUSE/map.db",
        "map LOG -o OUT --record HOUSE/map.db",
        "demo -o HOUSE",
    ],
)
def test_no_result_takes_the_place_of_a_map(
    words: str, scanweave: Scanweave, house: Path, log: SyntheticLog, tmp_path: Path
) -> None:
    before = (house / "map.db").read_bytes()
    meant = {"HOUSE": str(house), "LOG": str(log.log_path), "OUT": str(tmp_path / "out")}
    for name, path in meant.items():
        words = words.replace(name, path)
    assert_one_line_error(scanweave(*words.split()), "map.db")
    assert (house / "map.db").read_bytes() == before
    assert not (house / "simulated-1").exists()


def test_corrections_are_not_written_over_a_log(
    scanweave: Scanweave, log: SyntheticLog, tmp_path: Path
) -> None:
    mine = Path(shutil.copy(log.log_path, tmp_path / "mine.log"))
    outcome = scanweave("doctor", mine, "--write", mine)
    assert (outcome.code, mine.read_bytes()) == (2, log.log_path.read_bytes())


def test_a_session_does_not_replace_a_third_map(
    scanweave: Scanweave, house: Path, mapped: Path, tmp_path: Path
) -> None:
    other = write_synthetic_log(tmp_path / "other", seed=2, duration_s=10.0).log_path
    assert scanweave("map", other, "-o", tmp_path / "third").code == 0
    before = (tmp_path / "third" / "map.db").read_bytes()
    tuesday = write_synthetic_log(tmp_path / "tuesday", seed=3, duration_s=10.0).log_path
    outcome = scanweave("map", tuesday, "--into", house, "-o", tmp_path / "third")
    assert_one_line_error(outcome, "is another map")
    assert (tmp_path / "third" / "map.db").read_bytes() == before


def _refuse(code: int) -> Callable[..., Any]:
    def refused(self: Path, *_: object, **__: object) -> Any:
        raise OSError(code, os.strerror(code), str(self))

    return refused


def test_a_folder_that_cannot_be_written_to_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("touch", "unlink"):
        monkeypatch.setattr(Path, name, _refuse(errno.EROFS))
    with pytest.raises(MapFileError, match="Read-only file system"):
        write_bytes(tmp_path / "a.txt", b"")
    with pytest.raises(ScanweaveError, match="cannot write"), recording(tmp_path / "no" / "a.rrd"):
        pass


def test_a_bag_that_breaks_off_leaves_nothing(
    mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slam.storage.ros_messages.latched", lambda: _refuse(errno.ENOSPC)(Path("x")))
    with slam.load_map(mapped) as saved, pytest.raises(MapFileError, match="No space left"):
        saved.export("mcap", tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", ["info", "map -o out", "export -f tum -o out"])
def test_a_name_that_is_too_long_is_one_line(scanweave: Scanweave, words: str) -> None:
    assert_one_line_error(scanweave(*words.split(), "x" * 300), "File name too long")


@pytest.mark.parametrize("buffered", [False, True])  # containers often set PYTHONUNBUFFERED
def test_output_that_nobody_takes_is_one_line(mapped: Path, buffered: bool) -> None:
    command = "import sys; from slam.cli import main; main()"
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-P", "-c", command, "info", mapped],
            env={**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"},
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert (done.returncode, done.stderr) == (1, "scanweave: the output: No space left on device\n")


def test_an_interrupt_while_a_module_loads_is_one_line(
    scanweave: Scanweave, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loading() -> None:  # as a compiled module reports it
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr("slam.cli.commands.run", loading)
    outcome = scanweave("config")
    assert (outcome.code, outcome.err.count("\n")) == (130, 1)


def test_a_termination_tidies_up_as_an_interrupt_does(tmp_path: Path) -> None:
    command = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    command += "from slam.cli import main; main()"
    words = ["simulate", "-o", str(tmp_path / "drive"), "--rig", "sick2d", "--duration", "2000"]
    with subprocess.Popen(
        [sys.executable, "-P", "-c", command, *words], stderr=subprocess.PIPE, text=True
    ) as process:
        ends_s = time.monotonic() + 60.0
        while not list(tmp_path.iterdir()) and time.monotonic() < ends_s:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        stated = process.communicate(timeout=60)[1]
    assert (process.returncode, stated.count("interrupted")) == (130, 1)
    assert list(tmp_path.iterdir()) == []


_MAPPED: list[Any] = [None, 5, float("nan"), [], {}, object(), b"x", "a\0b", "x" * 5000]


@pytest.mark.parametrize("wrong", _MAPPED, ids=lambda one: repr(one)[:9])
def test_arguments_of_other_types_are_refused_in_one_line(wrong: Any, mapped: Path) -> None:
    calls: list[Callable[[], object]] = [
        lambda: slam.map_log(wrong),
        lambda: slam.open_dataset(wrong),
        lambda: slam.load_map(wrong),
        lambda: slam.load_grid_map(wrong),
        lambda: slam.build_map(wrong),
        lambda: slam.Localizer(wrong),
        lambda: slam.localize_log(wrong, "no.log"),
        lambda: slam.localize_log(mapped, wrong),
        lambda: slam.join(wrong, "no.log"),
        lambda: slam.merge([mapped, wrong], "out"),
        lambda: slam.roll_back(wrong, 1),
        lambda: slam.diff_maps(wrong, mapped),
        lambda: slam.diff_maps(mapped, sessions=(1, 1) if wrong is None else (wrong,)),  # type: ignore[arg-type]
        lambda: slam.evaluate(wrong, groundtruth=mapped),
        lambda: slam.register_sensor(wrong, wrong),
    ]
    if isinstance(wrong, list):
        calls.pop(4)  # no measurements, which is refused elsewhere
    for call in calls:
        with pytest.raises(ScanweaveError) as stated:
            call()
        assert "\n" not in str(stated.value)


def test_a_setting_may_be_a_single_text(mapped: Path) -> None:
    with slam.load_map(mapped) as saved, saved.remap("grid.resolution_m=0.1") as coarse:
        assert coarse.config.grid.resolution_m == 0.1


def test_a_log_is_diagnosed_by_its_path(log: SyntheticLog) -> None:
    assert slam.diagnose(log.log_path) == slam.diagnose(slam.open_dataset(log.log_path))
    with pytest.raises(ScanweaveError):
        slam.diagnose("no.log")


def test_a_scan_of_lists_is_matched_and_one_of_nothing_is_refused() -> None:
    def scan(ranges_m: Any) -> slam.LaserScan:
        return slam.LaserScan(0.0, ranges_m, -3.14, 3.14 / 180, 20.0)

    assert slam.match_scans(scan([3.0] * 360), scan([3.0] * 360)).converged
    for wrong in (None, "x", [["a"]]):
        with pytest.raises(ScanweaveError, match="ranges_m is"):
            slam.match_scans(scan(wrong), scan([3.0] * 360))
    with pytest.raises(ScanweaveError, match="points_lidar is"):
        slam.build_map([slam.PointCloud(0.0, None)])  # type: ignore[arg-type]
