"""The command: a wrong log is reported, its calibration written, and the map made with it is sound."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import Scanweave, assert_one_line_error
from command_line import scanweave as scanweave

from slam.simulation.synthetic_log import write_synthetic_log


@pytest.fixture(scope="module")
def in_mm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with odometry in millimetres, and scans upside down."""
    path = write_synthetic_log(tmp_path_factory.mktemp("mm"), seed=1, duration_s=40.0).log_path
    lines = []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[0] == "ODOM":
            words[1:3] = [str(1e3 * float(word)) for word in words[1:3]]
        if words[0] == "FLASER":
            count = int(words[1])
            words[2 : 2 + count] = words[1 + count : 1 : -1]
            place = 2 + count + 3
            words[place : place + 2] = [str(1e3 * float(word)) for word in words[place : place + 2]]
        lines.append(" ".join(words))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_doctor_shows_writes_and_the_map_takes_it(
    scanweave: Scanweave, in_mm: Path, tmp_path: Path
) -> None:
    file = tmp_path / "calibration.yaml"
    stated = scanweave("doctor", in_mm, "--write", file)
    assert stated.code == 0
    assert "its lengths are" in stated.out and "upside down" in stated.out and f"wrote {file}" in stated.out
    assert "# not sure: rotates opposite" in file.read_text()
    found = json.loads(scanweave("doctor", in_mm, "--json").out)
    assert {one["kind"] for one in found["findings"]} == {"scale", "mirrored"} and found["open"] == []
    assert scanweave("doctor", in_mm, "--calibration", file).out == ("no error found in the log\n")
    assert "finding: odometry: its lengths are" in scanweave("inspect", in_mm).out
    # What is sure the mapper uses by itself, and warns of the rest.
    alone = scanweave("map", in_mm, "-o", tmp_path / "alone")
    assert "warning: FLASER: perhaps rotates opposite" in alone.err
    assert "odometry: its lengths are" in alone.out and "(used)" in alone.out
    mended = scanweave("map", in_mm, "-o", tmp_path / "mended", "--calibration", file)
    assert mended.code == 0 and "perhaps" not in mended.err and "(used)" not in mended.out


def test_records_that_cannot_be_read_are_no_clean_log(
    scanweave: Scanweave, in_mm: Path, tmp_path: Path
) -> None:
    """The doctor found no error in a log of which no scan could be read."""
    log = tmp_path / "damaged.log"
    log.write_text(in_mm.read_text().replace("FLASER ", "FLASER -"))
    assert "not judged: records that cannot be read" in scanweave("doctor", log).out


def test_a_wrong_calibration_ends_in_a_line(scanweave: Scanweave, in_mm: Path, tmp_path: Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text("lidars: {REAR: {upside_down: true}}\n")
    for command in ("doctor", "inspect"):
        assert_one_line_error(scanweave(command, in_mm, "--calibration", file), "REAR", "FLASER")
    assert_one_line_error(
        scanweave("map", in_mm, "-o", tmp_path / "out", "--calibration", file), "REAR", "FLASER"
    )


@pytest.mark.parametrize(
    ("kinds", "left_open"),
    [
        (["ODOM"], "odometry: no other sensor is there"),
        (["ODOM", "FLASER"], "FLASER: it has only 2 readings"),
    ],
)
def test_a_log_that_shows_nothing_is_not_called_sound(
    scanweave: Scanweave, tmp_path: Path, kinds: list[str], left_open: str
) -> None:
    lines = write_synthetic_log(tmp_path, duration_s=10.0).log_path.read_text().splitlines()
    chosen = [
        [line for line in lines if line.startswith(kind)][: 80 if kind == "ODOM" else 2] for kind in kinds
    ]
    (tmp_path / "short.log").write_text("\n".join([line for part in chosen for line in part]) + "\n")
    assert f"not judged: {left_open}" in scanweave("doctor", tmp_path / "short.log").out
