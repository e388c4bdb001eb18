"""What a command shows while it works, and how it ends when it is interrupted."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupted_between_scans(advance: Callable[[int], None]) -> Iterator[Callable[[int], None]]:
    """Let Ctrl-C wait for the end of a scan: in compiled code it surfaces as some other error.

    A second one does not wait.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield advance  # whoever ignores or handles the signal has a reason
        return
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def on_scan(count: int) -> None:
        if asked:
            raise KeyboardInterrupt
        advance(count)

    signal.signal(signal.SIGINT, note)
    try:
        yield on_scan
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked:
        raise KeyboardInterrupt


@contextmanager
def progress_of(what: str, unit: str = "scans") -> Iterator[Progress]:
    """A counter on stderr while work goes on; silent where stderr is not a terminal."""
    progress = Progress(what, unit)
    try:
        yield progress
    finally:
        progress.close()


class Progress:
    """Rewrites one line a few times a second."""

    def __init__(self, what: str, unit: str) -> None:
        self._what = what
        self._unit = unit
        self._shown_at = time.perf_counter()
        self._terminal = sys.stderr.isatty()
        self._shown = False

    def __call__(self, count: int) -> None:
        """Show that ``count`` units are done."""
        now = time.perf_counter()
        if self._terminal and now - self._shown_at > 0.2:
            print(f"\r{self._what}: {count} {self._unit}", end="", file=sys.stderr, flush=True)
            self._shown_at, self._shown = now, True

    def close(self) -> None:
        """Clear the line."""
        if self._shown:
            print("\r" + " " * 40 + "\r", end="", file=sys.stderr, flush=True)
