"""Whatever becomes of a run's process is a row: done, failed, too slow, too large, killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from command_runs import TELLS, command_run

from slam.comparison.isolation import run_isolated
from slam.comparison.perform import perform
from slam.comparison.store import ResultStore


def test_a_run_leaves_its_figures_its_job_and_its_log(tmp_path: Path) -> None:
    run = command_run(f"{TELLS}; print('hello')")
    row = perform(run.to_dict(), str(tmp_path))
    assert (row["status"], row["reason"]) == ("ok", "")
    assert row["figures"]["a.b"] == 2.0
    assert set(row["figures"]) == {"a.b", "wall_s", "cpu_s"}
    folder = ResultStore(tmp_path).of(run.key)
    assert "hello" in (folder / "log.txt").read_text()
    assert {"job.json", "result.json", "figures.json"} <= {file.name for file in folder.iterdir()}


@pytest.mark.parametrize(
    ("code", "limits", "status", "reason"),
    [
        ("raise SystemExit(3)", {}, "failed", "ended with 3; see the run's log"),
        ("pass", {}, "failed", "cannot read the figures of the command, figures.json"),
        ("import time; time.sleep(60)", {"timeout_s": 0.5}, "timeout", "took longer than 0.5 s (timeout_s)"),
        (
            "import time; x = bytearray(300 << 20); time.sleep(60)",
            {"memory_mb": 200.0},
            "memory",
            "more than 200 MB (memory_mb)",
        ),
        ("import os, signal; os.killpg(0, signal.SIGKILL)", {}, "killed", "was ended by SIGKILL"),
    ],
)
def test_an_end_is_a_row_with_its_reason(
    tmp_path: Path, code: str, limits: dict[str, float], status: str, reason: str
) -> None:
    row = perform(command_run(code, **limits).to_dict(), str(tmp_path))
    assert row["status"] == status
    assert reason in row["reason"]
    assert "\n" not in row["reason"]
    assert ResultStore(tmp_path).row("k") == row


def test_a_command_that_is_not_there_is_named(tmp_path: Path) -> None:
    run = command_run("pass").to_dict() | {"command": ["no-such-program"]}
    row = perform(run, str(tmp_path))
    assert row["status"] == "failed"
    assert "cannot start no-such-program" in row["reason"]


def test_libraries_are_set_to_use_one_thread(tmp_path: Path) -> None:
    limits = "{name: v for name, v in os.environ.items() if name.endswith('_NUM_THREADS')}"
    row = perform(command_run(f"{TELLS}; import os; print({limits})").to_dict(), str(tmp_path))
    assert row["status"] == "ok"
    reported = (ResultStore(tmp_path).of("k") / "log.txt").read_text()
    assert all(f"'{name}_NUM_THREADS': '1'" in reported for name in ("OMP", "OPENBLAS", "NUMBA", "MKL"))


def test_a_killed_worker_takes_its_run_with_it(tmp_path: Path) -> None:
    # What outlived its worker would go on beside the same run, started anew elsewhere.
    job = command_run("import time; time.sleep(600)").to_dict()
    worker = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import json, sys; from pathlib import Path; from slam.comparison.isolation import run_isolated; "
            "run_isolated(json.loads(sys.argv[1]), Path(sys.argv[2]), 600.0, 2000.0)",
            json.dumps(job),
            str(tmp_path),
        ]
    )
    deadline_s = time.monotonic() + 60.0
    family: list[psutil.Process] = []
    while len(family) < 2 and time.monotonic() < deadline_s:  # the run, and its command
        family = psutil.Process(worker.pid).children(recursive=True)
        time.sleep(0.02)
    assert len(family) == 2
    worker.kill()
    worker.wait()
    _, alive = psutil.wait_procs(family, timeout=30.0)
    assert alive == []


def test_an_interrupted_watch_leaves_no_process(tmp_path: Path) -> None:
    # Ctrl-C reaches whoever watches, not the run: it is in a session of its own.
    seen: list[psutil.Process] = []

    def interrupt() -> None:
        while not seen:
            seen.extend(psutil.Process().children(recursive=True))
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        run_isolated(command_run("import time; time.sleep(600)").to_dict(), tmp_path, 600.0, 2000.0)
    thread.join()
    _, alive = psutil.wait_procs(seen, timeout=30.0)
    assert alive == []


def test_a_run_that_is_done_is_not_done_again(tmp_path: Path) -> None:
    count = tmp_path / "count"
    code = f"{TELLS}; open({str(count)!r}, 'a').write('x')"
    first = perform(command_run(code).to_dict(), str(tmp_path))
    assert perform(command_run(code).to_dict(), str(tmp_path)) == first
    assert count.read_text() == "x"


def test_of_two_attempts_the_first_to_end_holds(tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    with store.attempt() as slow, store.attempt() as quick:
        assert store.publish(quick, "k", {"status": "ok", "by": "quick"})["by"] == "quick"
        assert store.publish(slow, "k", {"status": "ok", "by": "slow"})["by"] == "quick"
    assert [folder.name for folder in store.folder.iterdir()] == ["k"]


def test_resume_keeps_what_lasts_and_repeats_what_a_limit_stopped(tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    for key, status in (("done", "ok"), ("wrong", "failed"), ("slow", "timeout"), ("large", "memory")):
        with store.attempt() as folder:
            store.publish(folder, key, {"status": status})
    keys = ["done", "wrong", "slow", "large", "new"]
    assert store.missing(keys, resume=True) == {"slow", "large", "new"}
    assert store.row("done") is not None and store.row("slow") is None
    assert store.missing(keys, resume=False) == set(keys)
    assert store.row("done") is None
