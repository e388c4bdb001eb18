"""A real scheduler and two real workers: one is killed in the middle, and every run still counts once."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from slam.comparison.compare import compare
from slam.comparison.perform import Row

RUNS = 6
_START_S = 120.0


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address of a scheduler on loopback, and its two workers."""
    reported = tmp_path / "scheduler.json"
    with ExitStack() as stack:

        def started(kind: str, *arguments: str) -> subprocess.Popen[bytes]:
            log = stack.enter_context((tmp_path / f"{kind}-{len(arguments)}.log").open("ab"))
            command = [
                sys.executable,
                "-m",
                f"distributed.cli.dask_{kind}",
                "--scheduler-file",
                str(reported),
            ]
            process = subprocess.Popen(
                [*command, "--no-dashboard", *arguments], cwd=tmp_path, stdout=log, stderr=log
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        started("scheduler", "--host", "127.0.0.1", "--port", "0")
        workers = [
            started("worker", "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1") for _ in range(2)
        ]
        yield _address(reported), workers


def _address(reported: Path) -> str:
    """The scheduler's address, once both workers are there."""
    from distributed import Client

    deadline_s = time.monotonic() + _START_S
    while time.monotonic() < deadline_s:
        if reported.is_file() and (text := reported.read_text()):
            address: str = json.loads(text)["address"]
            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(2, timeout=_START_S)
            return address
        time.sleep(0.05)
    raise AssertionError("the scheduler did not start")


def test_one_worker_is_killed_and_every_run_counts_once(
    tmp_path: Path, cluster: tuple[str, list[subprocess.Popen[bytes]]]
) -> None:
    address, workers = cluster
    begun = tmp_path / "begun"
    # Each shows that it has begun, and lasts long enough to be caught in the act.
    code = (
        f"import os, sys, time; open({str(begun)!r}, 'a').write(f'{{os.getpid()}} {{sys.argv[1]}}\\n'); "
        "time.sleep(1.0)"
    )
    commands: list[dict[str, Any]] = [
        {"name": f"run {n}", "command": ["{python}", "-c", code, f"run {n}"]} for n in range(RUNS)
    ]
    (tmp_path / "x.yaml").write_text(yaml.safe_dump({"name": "x", "commands": commands}))

    def kill_after_two(row: Row, done: int, count: int) -> None:
        while done == 2:
            mine = {child.pid for child in psutil.Process(workers[0].pid).children(recursive=True)}
            if mine & {int(line.split()[0]) for line in begun.read_text().splitlines()}:
                workers[0].kill()
                break
            time.sleep(0.01)

    out = tmp_path / "out"
    found = compare(tmp_path / "x.yaml", out, scheduler=address, on_row=kill_after_two)
    assert workers[0].wait() != 0 and workers[1].poll() is None
    assert Counter(row["configuration"] for row in found.rows) == {f"run {n}": 1 for n in range(RUNS)}
    assert {row["status"] for row in found.rows} == {"ok"}
    assert {folder.name for folder in (out / "runs").iterdir()} == {row["key"] for row in found.rows}
    assert len((out / "results.csv").read_text().splitlines()) == RUNS + 1
    # The run that died with its worker was begun again elsewhere; that is what made it count once.
    starts = Counter(line.split(" ", 1)[1] for line in begun.read_text().splitlines())
    assert set(starts) == {f"run {n}" for n in range(RUNS)}
    assert starts.total() == RUNS + 1
