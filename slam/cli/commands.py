"""All commands."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys

from slam import heap
from slam.cli import compare, demo, edit, localize, map_log, queries, saved, simulate
from slam.cli.app import app, tell
from slam.errors import ScanweaveError

__all__ = ["app", "compare", "demo", "edit", "localize", "map_log", "queries", "run", "saved", "simulate"]

_OBJECTS_A_COLLECTION = 500_000
# Help lists the commands as somebody meets them: a log, its map, what is done with a map, and the rest.
_ORDER = "demo inspect doctor map localize info view edit remap merge diff floorplan plan export check"
_BY_ORDER = {name: number for number, name in enumerate(_ORDER.split())}
app.registered_commands.sort(
    key=lambda one: _BY_ORDER.get(one.name or one.callback.__name__, len(_BY_ORDER))  # type: ignore[union-attr]
)


def run() -> None:
    """Run a command: exit code 1 for a known error in one line, 2 for wrong usage."""
    # Records by the ten thousand live to the end: to look through them again and again takes 3 % of a run.
    gc.set_threshold(_OBJECTS_A_COLLECTION)
    heap.own_process = True
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # ended as by Ctrl-C: all is tidied up
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        app()
    except (ScanweaveError, OSError) as error:
        logging.info("where it failed:", exc_info=error)
        message: object = error
        if isinstance(error, OSError) and error.strerror:
            message = f"{error.filename or 'the output'}: {error.strerror}"
        tell(f"scanweave: {message}", sys.stderr)
        try:
            print(end="", flush=True)
        except OSError:  # the output takes nothing more; when Python ends it would report that again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    finally:
        gc.freeze()  # the interpreter would check them all again before it ends
