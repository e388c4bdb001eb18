"""The command line: exit codes, one-line errors, files, and what each command prints."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from command_line import RESULTS, Scanweave, assert_one_line_error, log, mapped, scanweave

from slam.simulation.synthetic_log import SyntheticLog
from slam.storage.tum import read_tum

__all__ = ["log", "mapped", "scanweave"]  # fixtures
COMMANDS = ("map", "inspect", "evaluate", "config", "simulate", "demo")


class TestMap:
    def test_it_writes_what_it_promises_and_nothing_else(self, mapped: Path) -> None:
        assert {path.name for path in mapped.iterdir()} == RESULTS

    def test_it_says_what_it_did(self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path) -> None:
        outcome = scanweave("map", log.log_path, "-o", tmp_path)
        assert (outcome.code, outcome.err) == (0, "")
        used, first, second = outcome.out.splitlines()
        assert used == f"used: FLASER (2D lidar, {log.scan_count}), odometry (wheels, {log.odometry_count})"
        assert first.startswith(f"{log.scan_count} scans, ")
        assert " 0 records dropped, " in first
        assert [name for name in RESULTS if str(tmp_path / name) not in second] == []

    def test_tags_that_lie_beside_the_log_are_reported(
        self, scanweave: Scanweave, log: SyntheticLog, tmp_path: Path
    ) -> None:
        (tmp_path / "in").mkdir()
        given = tmp_path / "in" / log.log_path.name
        given.write_bytes(log.log_path.read_bytes())
        (tmp_path / "in" / "tags.yaml").write_text("start: {at_m: [1.0, 2.0], yaw_deg: 0.0}\n")
        stated = "used tags.yaml, found next to the log; --tags gives another file"
        assert stated in scanweave("map", given, "-o", tmp_path / "out").out.splitlines()
        tags = tmp_path / "in" / "tags.yaml"
        assert stated not in scanweave("map", given, "-o", tmp_path / "b", "--tags", tags).out.splitlines()

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
        assert {"link", "iframe", "object", "base"}.isdisjoint(page.tags)
        assert page.addresses and all(address.startswith("data:") for address in page.addresses)
        plain = re.sub(r"<script.*?</script>|base64,[^\"]*", "", html, flags=re.DOTALL)
        assert not re.search(r"https?://|@import|url\(", plain)
        assert "default-src &#39;none&#39;" in html
        assert "resolution_m: 0.05" in html

    @pytest.mark.parametrize(
        ("arguments", "shown"),
        [
            (["--no-odometry"], "wheels: false"),
            (["--set", "layers.rule=printed"], "rule: printed"),
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
            (lambda path: None, ["does not exist", "give the path of a log"]),
            (lambda path: path.mkdir(), ["directory"]),
            (lambda path: path.touch(), ["is empty"]),
            (lambda path: path.write_bytes(b"\x1f\x8b\x08\x00garbage"), ["damaged"]),
            (lambda path: path.write_bytes(bytes(range(256)) * 40), ["known format"]),
            (lambda path: path.write_text("# only comments\n"), ["no usable frame, scan or odometry"]),
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

    def test_a_log_whose_name_is_misspelt(self, scanweave: Scanweave, tmp_path: Path) -> None:
        (tmp_path / "monday.log").touch()
        assert_one_line_error(scanweave("inspect", tmp_path / "monady.log"), "did you mean", "monday.log?")

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
        assert f"\n{log.scan_count - 2} scans" in outcome.out
        assert "dropped: " in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        inspected = json.loads(scanweave("inspect", damaged, "--json").out)
        assert sum(tally["count"] for tally in inspected["dropped"].values()) == 3

        for command in (["map", damaged, "-o", tmp_path / "strict"], ["inspect", damaged]):
            stopped = scanweave(*command, "--strict")
            assert_one_line_error(stopped, f"damaged.log, record {scans[10] + 1}: ", "--strict")
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
            ("grid.resolution_m=-1", ["grid.resolution_m", "greater than or equal to 0.001"]),
            ("grid.resolution_m=wide", ["grid.resolution_m", "wide"]),
            ("layers.rule=magic", ["layers.rule", "cautious"]),
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
        kept, refused = outcome.err.splitlines()
        assert outcome.code == 1 and "--resume continues it" in kept
        assert "No space left on device" in refused and "trajectory.tum" in refused
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
