"""How far a use case has come, told to whoever waits for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run has come.

    Attributes
    ----------
    stage
        What is being done: ``mapping``, ``optimising``, ``writing``, ``localising``.
    readings
        Scans and frames so far.
    share
        Of the log that has been read, 0..1; None where its reader cannot tell.

    Examples
    --------
    >>> import slam
    >>> def show(progress: slam.Progress) -> None:
    ...     share = "?" if progress.share is None else f"{progress.share:.0%}"
    ...     print(f"{progress.stage}: {progress.readings} readings, {share}")
    >>> show(slam.Progress("mapping", 120, 0.5))  # what `slam.map_log(log, on_progress=show)` prints
    mapping: 120 readings, 50%
    """

    stage: str
    readings: int
    share: float | None = None


OnProgress: TypeAlias = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """Tell nobody."""
