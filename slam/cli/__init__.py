"""The commands. Nothing else prints."""

from __future__ import annotations

import gc
import sys

from slam import heap
from slam.cli import compare, demo, edit, localize, map_log, queries, saved, simulate
from slam.cli.app import app, tell
from slam.errors import ScanweaveError

__all__ = ["app", "compare", "demo", "edit", "localize", "main", "map_log", "queries", "saved", "simulate"]

_OBJECTS_A_COLLECTION = 500_000
# Conventional exit code of a program that the user interrupted.
_INTERRUPTED = 130

# Help lists the commands as somebody meets them: a log, its map, what is done with a map, and the rest.
_ORDER = "demo inspect doctor map localize info view edit remap merge diff floorplan plan export check"
_BY_ORDER = {name: number for number, name in enumerate(_ORDER.split())}
app.registered_commands.sort(
    key=lambda one: _BY_ORDER.get(one.name or one.callback.__name__, len(_BY_ORDER))  # type: ignore[union-attr]
)


def main() -> None:
    """Run a command: exit code 1 for a known error in one line, 2 for wrong usage."""
    # Records by the ten thousand live to the end: to look through them again and again takes 3 % of a run.
    gc.set_threshold(_OBJECTS_A_COLLECTION)
    heap.own_process = True
    try:
        app()
    except ScanweaveError as error:
        tell(f"scanweave: {error}", sys.stderr)
        sys.exit(1)
    except (KeyboardInterrupt, SystemExit) as end:
        # Typer turns an interrupt into its exit code and says nothing.
        if isinstance(end, SystemExit) and end.code != _INTERRUPTED:
            raise
        print("scanweave: interrupted; nothing half-written was left behind", file=sys.stderr)
        sys.exit(_INTERRUPTED)
    finally:
        gc.freeze()  # the interpreter would look through them all once more before it ends
