"""Runs commands in a child of this process with loaded libraries, and measures resources and exit."""

from __future__ import annotations

import os
import resource
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

_MB = 1024.0
_LIBRARIES = (
    *("cv2", "rosbags.typesys", "rosbags.typesys.stores.ros2_humble", "rosbags.typesys.stores.ros1_noetic"),
    *("slam.cli", "slam.datasets.inspection", "slam.evaluation.pages", "slam.evaluation.map_info"),
    *("slam.app.mapping", "slam.app.map_run", "slam.evaluation.figure_parts", "slam.outputs.finished_map"),
    *("slam.mapping.navigation", "slam.storage.nav2", "matplotlib.pyplot", "slam.zstandard", "lz4.frame"),
)
_STEERING = frozenset(
    chr(code) for code in (*range(32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A))
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a child process.

    Attributes
    ----------
    fault
        The violation in a few words; empty if there is none.
    said, lines
        The last line that it printed, and all of them.
    """

    cpu_s: float
    peak_mb: float
    fault: str
    said: str
    lines: tuple[str, ...] = ()


def load_libraries(names: Iterable[str] = _LIBRARIES) -> None:
    """Import what commands import when they begin, so that children do not pay for it."""
    for name in names:
        import_module(name)


def run_command(arguments: list[str], cpu_s: float, memory_mb: float) -> Outcome:
    """Run a scanweave command in a child with limits of CPU time and memory."""

    def work() -> int:
        from slam.cli import main

        sys.argv = ["scanweave", *arguments]
        try:
            main()
        except SystemExit as end:
            return end.code if isinstance(end.code, int) else 1
        return 0

    return run_child(work, cpu_s, memory_mb)


def run_child(work: Callable[[], int], cpu_s: float, memory_mb: float) -> Outcome:
    """Run a function in a child; it must exit with 0 to 2, print one line for 1, and only printable text."""
    with tempfile.TemporaryFile() as said:
        child = os.fork()
        if child == 0:
            _work(work, said.fileno(), cpu_s, memory_mb)
        _, status, used = os.wait4(child, 0)
        said.seek(0)
        text = said.read().decode("utf-8", "surrogateescape")
    lines = [line for line in text.split("\n") if line]
    fault = _fault(os.waitstatus_to_exitcode(status), text, lines)
    return Outcome(
        used.ru_utime + used.ru_stime, used.ru_maxrss / _MB, fault, lines[-1] if lines else "", tuple(lines)
    )


def _work(work: Callable[[], int], output: int, cpu_s: float, memory_mb: float) -> None:
    """In the child: all that is printed goes to a file, and nothing of the parent is left behind."""
    code = 70
    try:
        os.setpgid(0, 0)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for stream in (1, 2):
            os.dup2(output, stream)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)
        size = Path("/proc/self/statm").read_text(encoding="ascii").split()[0]
        most = int(size) * resource.getpagesize() + int(memory_mb * _MB * _MB)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s) + 1, int(cpu_s) + 2))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(int(4 * cpu_s) + 30)  # one that sleeps takes no CPU time
        code = work()
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _fault(code: int, text: str, lines: list[str]) -> str:
    """Return the violation of a rule, or an empty text."""
    if code in (-signal.SIGXCPU, -signal.SIGKILL, -signal.SIGALRM):
        return "no end"
    if code < 0:
        return f"crash by {signal.Signals(-code).name}"
    if "Traceback" in text or code not in (0, 1, 2):
        return next((line for line in reversed(lines) if "Error" in line), f"exit code {code}")[:200]
    if code == 1 and not lines[-1].startswith("scanweave: "):
        return "no line of its own"
    steering = _STEERING.intersection(text.replace("\n", ""))
    return f"prints {sorted(steering)!r} as it is" if steering else ""
