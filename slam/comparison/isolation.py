"""Runs each job in its own process, with limits of time and memory; a crash becomes a row in a table."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from slam.comparison.files import FAILURE, JOB, LOG

Status: TypeAlias = Literal["ok", "failed", "timeout", "memory", "killed"]

# One run uses one core, so that parallel runs do not slow each other down and distort the measurement.
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA", "TBB")
THREAD_LIMITS = {
    **{f"{library}_NUM_THREADS": "1" for library in _LIBRARIES},
    "VECLIB_MAXIMUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
_LOOK_S = 0.5  # each check goes through all processes of the machine
# Set to stop a comparison in this process: its threads end their runs, and start no more.
STOPPING = threading.Event()


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a process ended.

    Attributes
    ----------
    status
        ok, or the reason why it was stopped.
    reason
        One line; empty if it is ok.
    elapsed_s
        Elapsed time, including imports.
    peak_mb
        Peak resident size of it and its children together.
    """

    status: Status
    reason: str
    elapsed_s: float
    peak_mb: float


def run_isolated(job: dict[str, Any], folder: Path, timeout_s: float, memory_mb: float) -> Outcome:
    """Do a job in its own process and monitor it.

    Parameters
    ----------
    job
        Plain types, for `slam.comparison.child`.
    folder
        Must exist; receives the job, the log, and the files of the run.
    timeout_s, memory_mb
        Limits beyond which the process and its children are killed. Memory is the resident size, checked
        twice a second: a limit of the address space would include what libraries only reserve.
    """
    (folder / JOB).write_text(json.dumps(job, indent=1), encoding="utf-8")
    command = [sys.executable, "-m", "slam.comparison.child", str(folder / JOB), str(folder)]
    started = time.monotonic()
    with (folder / LOG).open("wb") as log:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **THREAD_LIMITS},
            start_new_session=True,
        )
        try:
            stopped, peak_mb = _watched(process, started + timeout_s, memory_mb)
        finally:
            # Also if this process is interrupted: its children end with it.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
    elapsed_s = time.monotonic() - started
    if stopped == "timeout":
        return Outcome("timeout", f"took longer than {timeout_s:g} s (timeout_s)", elapsed_s, peak_mb)
    if stopped == "interrupted":
        return Outcome("killed", "was interrupted", elapsed_s, peak_mb)
    if stopped == "memory":
        text = f"took {peak_mb:.0f} MB, more than {memory_mb:g} MB (memory_mb)"
        return Outcome("memory", text, elapsed_s, peak_mb)
    return Outcome(*_ending(process.returncode, folder), elapsed_s, peak_mb)


def _watched(
    process: subprocess.Popen[bytes], deadline_s: float, memory_mb: float
) -> tuple[Literal["timeout", "memory", "interrupted"] | None, float]:
    """Wait for the end of a process or for a reason to stop it; also returns its peak memory."""
    import psutil

    peak_mb = 0.0
    watched = psutil.Process(process.pid)
    while True:
        try:
            process.wait(_LOOK_S)
            return None, peak_mb
        except subprocess.TimeoutExpired:
            pass
        if STOPPING.is_set():
            return "interrupted", peak_mb
        with suppress(psutil.Error):
            family = [watched, *watched.children(recursive=True)]
            peak_mb = max(peak_mb, sum(_resident_mb(member) for member in family))
        if peak_mb > memory_mb:
            return "memory", peak_mb
        if time.monotonic() > deadline_s:
            return "timeout", peak_mb


def _resident_mb(process: Any) -> float:
    """Memory of a process, 0 if it has just ended."""
    import psutil

    try:
        return float(process.memory_info().rss) / 2**20
    except psutil.Error:
        return 0.0


def _ending(code: int, folder: Path) -> tuple[Status, str]:
    """Status and reason of a process that exited or was killed."""
    if code == 0:
        return "ok", ""
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        return "killed", f"was ended by {name} from outside, or crashed; see its log"
    try:
        reported = json.loads((folder / FAILURE).read_text(encoding="utf-8"))
        return "failed", " ".join(str(reported["reason"]).split())
    except (OSError, ValueError, KeyError):
        return "failed", f"ended with {code}; see its log"
