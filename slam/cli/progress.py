"""What a command shows while it works, and how it ends when it is interrupted."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from slam.cli.app import tell, verbosity

if TYPE_CHECKING:
    from slam.app.progress import Progress

Show = Callable[["Progress"], None]
# Interval of the lines in a log, if the output is no terminal.
_LINE_S = 30.0


@contextmanager
def interruptible(show: Show) -> Iterator[Show]:
    """Let Ctrl-C wait for the next moment that is shown: in compiled code it surfaces as some other error.

    A second one does not wait.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield show  # whoever ignores or handles the signal has a reason
        return
    interrupted = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def show_or_stop(progress: Progress) -> None:
        if interrupted:
            raise KeyboardInterrupt
        show(progress)

    signal.signal(signal.SIGINT, note)
    try:
        yield show_or_stop
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def progress_bar(unit: str = "scans and frames", first: str = "") -> Iterator[Show]:
    """Show on stderr how far the work is: share, rate, time left; of what is no terminal a line now and then.

    Parameters
    ----------
    first
        Printed once the work has begun; a command that is refused prints only the reason.
    """
    begun = iter([first] if first and not verbosity["quiet"] else [])

    def tell_first(progress: Progress) -> None:
        for line in begun:
            tell(line, sys.stderr)

    if verbosity["quiet"]:
        yield tell_first
        return

    def tell_and_show(progress: Progress) -> None:
        tell_first(progress)
        show(progress)

    show: Show
    if not sys.stderr.isatty():
        show = _Lines(unit)
        yield tell_and_show
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[readings]} " + unit),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    # Drawn by the working thread: with another thread the process could not be forked, see `slam.forked`.
    with Bars(*columns, console=Console(stderr=True), transient=True, auto_refresh=False) as bars:
        show = _Bars(bars)
        yield tell_and_show


class _Lines:
    """A line now and then."""

    def __init__(self, unit: str) -> None:
        self._unit, self._printed_s = unit, time.monotonic()

    def __call__(self, progress: Progress) -> None:
        """Print the progress if it is time."""
        now_s = time.monotonic()
        if now_s - self._printed_s >= _LINE_S:
            self._printed_s = now_s
            share = "" if progress.share is None else f", {progress.share:.0%} of the log"
            tell(f"{progress.stage}: {progress.readings:,} {self._unit}{share}", sys.stderr)


class _Bars:
    """One bar a stage."""

    def __init__(self, bars: Any) -> None:
        self._bars = bars
        self._task: Any = None
        self._stage = ""
        self._first = 0
        self._drawn_s = -math.inf

    def __call__(self, progress: Progress) -> None:
        """Show how far it is."""
        if progress.stage != self._stage:
            if self._task is not None:
                self._bars.remove_task(self._task)
            self._stage, self._first, self._drawn_s = progress.stage, progress.readings, -math.inf
            self._task = self._bars.add_task(progress.stage, total=None, readings=0, rate="")
        task = next(task for task in self._bars.tasks if task.id == self._task)
        done, elapsed_s = progress.readings - self._first, task.elapsed or 0.0
        self._bars.update(
            self._task,
            total=None if progress.share is None else 1.0,
            completed=progress.share or 0.0,
            readings=f"{progress.readings:,}",
            rate=f"{done / elapsed_s:,.0f}/s" if done and elapsed_s > 0.0 else "",
        )
        now_s = time.monotonic()
        if self._bars.live.refresh_per_second * (now_s - self._drawn_s) >= 1.0:
            self._bars.refresh()
            self._drawn_s = now_s
