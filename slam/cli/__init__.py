"""The commands. Nothing else prints."""

from __future__ import annotations

import sys

# Conventional exit code of a program that the user interrupted.
_INTERRUPTED = 130


def main() -> None:
    """Load and run the program; an interruption at any moment ends in one line."""
    try:
        from slam.cli.commands import run

        run()
    except (KeyboardInterrupt, SystemExit, ImportError) as end:
        # Typer turns an interrupt into its exit code and says nothing, a compiled module into its own error.
        stopped = isinstance(end, KeyboardInterrupt) or getattr(end, "code", None) == _INTERRUPTED
        if not stopped and not isinstance(end.__cause__, KeyboardInterrupt):
            raise
        print("scanweave: interrupted; no file is left half-written", file=sys.stderr)
        sys.exit(_INTERRUPTED)
