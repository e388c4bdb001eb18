"""Measure how the cost of a map grows with the length of its log.

    python tools/growth.py LOG [--scans 960] [--times 1 3 10 30] [--sparse]

LOG is a CARMEN log. Its first ``--scans`` scans are played forward, backward, forward ... (with increasing
time; each pass sees every place) until the log has the wanted length; with ``--sparse``, the start of the log
is used as it is: a campus of ``scanweave simulate --campus`` has new places nearly everywhere. Each log is
mapped in a child process with loaded libraries: total CPU seconds, CPU seconds of the final optimisation,
peak memory, bytes of ``map.db`` and of the report. The exponent between the first and the last length is 1 if
the cost is proportional to the log, 0 if it is constant.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import tempfile
import time
from collections.abc import Iterator
from itertools import chain, cycle
from pathlib import Path
from typing import Any

from slam import heap
from tools.trial_process import load_libraries, run_child

LASERS = ("FLASER", "ROBOTLASER1")
COLUMNS = (
    "scans",
    "keyframes",
    "loops",
    "CPU s",
    "ms a scan",
    "final s",
    "peak MB",
    "map.db MB",
    "report MB",
)
# The libraries for a planar log; others in memory would be attributed to the log.
LIBRARIES = ("slam.app.mapping", "slam.app.map_run", "slam.evaluation.pages", "slam.outputs.finished_map")


def main() -> None:
    """Map each length, and print one row for each."""
    options = parse_options()
    load_libraries(LIBRARIES)
    head, lines = read_lines(options.log)
    print("| times | " + " | ".join(COLUMNS) + " |\n|" + "---:|" * (len(COLUMNS) + 1), flush=True)
    rows = []
    with tempfile.TemporaryDirectory(dir=options.scratch) as scratch:
        log, out = Path(scratch) / "long.log", Path(scratch) / "map"
        for times in (1, *options.times):  # the first run compiles the kernels
            scans = options.scans * times
            drive = iter(lines) if options.sparse else back_and_forth(lines, options.scans)
            with log.open("w") as stream:
                stream.writelines(chain(head, until(drive, scans)))
            heap.give_back()  # a child starts with its parent's memory
            row = measured(log, out)
            rows.append(row)
            if len(rows) > 1:
                cells = (f"{row[name]:.4g}" for name in COLUMNS)
                print(f"| {times} | " + " | ".join(cells) + " |", flush=True)
    low, high = rows[1], rows[-1]
    span = math.log(high["scans"] / low["scans"]) or math.nan  # undefined for one length
    powers = (f"{math.log(high[name] / low[name]) / span:.2f}" if low[name] else "" for name in COLUMNS)
    print("| exponent | " + " | ".join(powers) + " |")
    for row in rows[1:]:
        print(f"{row['scans']} scans, CPU s by stage: {json.dumps(row['stages'])}")


def parse_options() -> argparse.Namespace:
    """Parse the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path)
    parser.add_argument("--scans", type=int, default=960, help="scans of the shortest log")
    parser.add_argument("--times", type=int, nargs="+", default=[1, 3, 10, 30])
    parser.add_argument("--sparse", action="store_true", help="use the start of the log, nothing repeated")
    parser.add_argument("--scratch", type=Path, help="folder for logs and maps")
    return parser.parse_args()


def read_lines(log: Path) -> tuple[list[str], list[str]]:
    """The header of a CARMEN log, and its readings."""
    with (gzip.open if log.suffix == ".gz" else open)(log, "rt") as stream:
        lines = [line if line.endswith("\n") else f"{line}\n" for line in stream]
    readings = [line for line in lines if line.startswith((*LASERS, "ODOM"))]
    return [line for line in lines if line.startswith(("#", "PARAM"))], readings


def back_and_forth(lines: list[str], scans: int) -> Iterator[str]:
    """The first scans repeatedly, forward and backward in turn; stamps increase."""
    part = list(until(iter(lines), scans))
    first_s, last_s = stamp_s(part[0]), stamp_s(part[-1])
    begun_s = first_s
    for backward in cycle((False, True)):
        for line in reversed(part) if backward else part:
            into_s = last_s - stamp_s(line) if backward else stamp_s(line) - first_s
            words = line.split()
            words[-3] = words[-1] = f"{begun_s + into_s:.6f}"
            yield " ".join(words) + "\n"
        begun_s += last_s - first_s


def stamp_s(line: str) -> float:
    """The record time of a line."""
    return float(line.split()[-3])


def until(lines: Iterator[str], scans: int) -> Iterator[str]:
    """The lines up to a number of scans."""
    for line in lines:
        scans -= line.startswith(LASERS)
        if scans < 0:
            return
        yield line


def measured(log: Path, out: Path) -> dict[str, Any]:
    """Measure the cost of a map."""

    def work() -> int:
        from slam.app.mapping import run_log

        heap.own_process = True  # as of the command
        time.perf_counter = time.process_time  # CPU time of stages: other processes may run
        run = run_log(log, out=out, overwrite=True)
        assert run.report is not None
        stages = run.report.result.stage_seconds
        figures = {
            "scans": run.report.result.scans.stamps_s.size,
            "keyframes": len(run.report.result.map.node_poses),
            "loops": sum(loop.accepted for loop in run.report.result.map.loops),
            "final s": stages["final optimisation"],
            "map.db MB": (out / "map.db").stat().st_size / 1e6,
            "report MB": (out / "report.html").stat().st_size / 1e6,
            "stages": {name: round(seconds, 2) for name, seconds in stages.items() if seconds >= 0.01},
        }
        print(json.dumps(figures))
        return 0

    outcome = run_child(work, 1e5, 1e6)
    if outcome.fault:
        raise SystemExit(f"{log}: {outcome.fault}: {outcome.said}")
    row = {**json.loads(outcome.said), "CPU s": outcome.cpu_s, "peak MB": outcome.peak_mb}
    return {**row, "ms a scan": 1e3 * row["CPU s"] / row["scans"]}


if __name__ == "__main__":
    main()
