"""The tasks of a Dask worker. A task may be sent twice; a finished run is not repeated."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from slam.comparison.drives import is_recorded
from slam.comparison.files import MEASURED
from slam.comparison.isolation import Outcome, run_isolated
from slam.comparison.store import ResultStore
from slam.storage.files import make_folder
from slam.temporary import TemporaryFolder

Row = dict[str, Any]


def perform(run: Row, root: str, drive_fault: str = "") -> Row:
    """Do one run in its own process.

    Parameters
    ----------
    run
        `slam.comparison.run.Run` as a dictionary.
    root
        The comparison's folder.
    drive_fault
        Why its data set could not be simulated; empty if it exists.

    Returns
    -------
    The row of the table: the run, ``status``, ``reason``, ``figures``, ``warnings``, ``log``.
    """
    store = ResultStore(Path(root))
    known = store.row(run["key"])
    if known is not None:
        return known
    with store.attempt() as folder:
        if drive_fault:
            outcome = Outcome("failed", f"its data set could not be made: {drive_fault}", 0.0, 0.0)
        else:
            outcome = run_isolated(run, folder, run["timeout_s"], run["memory_mb"])
        return store.publish(folder, run["key"], row_of(run, outcome, folder))


def record_drive(drive: Row, folder: str, timeout_s: float, memory_mb: float) -> str:
    """Simulate a drive in its own process; returns an error message, or an empty text."""
    target = Path(folder)
    if is_recorded(target):
        return ""
    make_folder(target.parent)
    attempt = TemporaryFolder(target.parent, ".attempt-")
    try:
        made = attempt.path / target.name
        outcome = run_isolated({"drive": drive, "folder": str(made)}, attempt.path, timeout_s, memory_mb)
        if outcome.status == "ok" and not is_recorded(target):  # another experiment may have been faster
            made.replace(target)
        return outcome.reason
    finally:
        attempt.remove()


def row_of(run: Row, outcome: Outcome, folder: Path | None) -> Row:
    """The row of a run that has ended, for any reason."""
    import json

    measured: Row = {"figures": {}, "warnings": []}
    status, reason = outcome.status, outcome.reason
    if status == "ok" and folder is not None:
        try:
            measured = json.loads((folder / MEASURED).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            status, reason = "failed", f"left no figures ({error})"
    reported = ("key", "dataset", "group", "configuration", "method", "seed")
    return {
        **{name: run[name] for name in reported},
        "status": status,
        "reason": reason,
        "figures": measured["figures"],
        "warnings": measured["warnings"],
        "elapsed_s": outcome.elapsed_s,
        "watched_peak_mb": outcome.peak_mb,
        "host": socket.gethostname(),
    }
