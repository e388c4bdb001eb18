"""How many runs a minute `scanweave compare` does with one worker and with two, on runs of equal length.

Usage: python tools/compare_throughput.py LOG [--runs 8] [--rounds 2] [--workers 1 2]
Real `dask-scheduler` and `dask-worker` processes on loopback; the same log is mapped again and again, with
another seed each time. Other work on the machine disturbs the ratio: the load average is told with it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import yaml

from slam.comparison.cluster import check_installed
from slam.comparison.compare import compare


def main() -> None:
    """Measure in turns, so that a disturbance hits all alike, and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    check_installed()
    seconds: dict[int, list[float]] = {count: [] for count in arguments.workers}
    with tempfile.TemporaryDirectory() as folder:
        experiment = Path(folder) / "x.yaml"
        content = {
            "name": "throughput",
            "datasets": [{"path": str(arguments.log.resolve())}],
            "configurations": [{"name": "full"}],
            "seeds": list(range(arguments.runs)),
        }
        experiment.write_text(yaml.safe_dump(content))
        for turn in range(arguments.rounds):
            for count in arguments.workers:
                seconds[count].append(timed(experiment, Path(folder) / f"{turn}-{count}", count))
                print(
                    f"{count} workers: {seconds[count][-1]:.1f} s, load {os.getloadavg()[0]:.1f}", flush=True
                )
    medians = {count: statistics.median(taken) for count, taken in seconds.items()}
    base = medians[arguments.workers[0]]
    for count, median_s in medians.items():
        rate = 60.0 * arguments.runs / median_s
        print(f"{count} workers: {rate:.1f} runs a minute, {base / median_s:.2f} times the first")


def timed(experiment: Path, out: Path, count: int) -> float:
    """Seconds from the call to the end of the last run, workers already up."""
    ends: list[float] = []
    with workers_up(out, count) as address:
        started = time.perf_counter()
        done = compare(
            experiment,
            out / "measured",
            scheduler=address,
            on_row=lambda row, number, of: ends.append(time.perf_counter()),
        )
    if any(row["status"] != "ok" for row in done.rows):
        sys.exit(f"a run has no result: {[row['reason'] for row in done.rows]}")
    return ends[-1] - started


@contextmanager
def workers_up(folder: Path, count: int) -> Iterator[str]:
    """Address of a scheduler on loopback with so many workers of one thread."""
    from distributed import Client

    folder.mkdir(parents=True)
    reported = folder / "scheduler.json"
    with ExitStack() as stack:
        for kind, own in [("scheduler", ["--port", "0"]), *([("worker", ["--nthreads", "1"])] * count)]:
            command = [
                sys.executable,
                "-m",
                f"distributed.cli.dask_{kind}",
                "--scheduler-file",
                str(reported),
            ]
            process = subprocess.Popen(
                [*command, "--no-dashboard", "--host", "127.0.0.1", *own],
                cwd=folder,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
        while not (reported.is_file() and reported.read_text()):
            time.sleep(0.05)
        address: str = json.loads(reported.read_text())["address"]
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=120.0)
        yield address


if __name__ == "__main__":
    main()
