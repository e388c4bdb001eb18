"""Progress of a run, for a caller that waits for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run.

    Attributes
    ----------
    stage
        Current step: ``mapping``, ``optimising``, ``writing``, ``localising``.
    readings
        Number of scans and frames so far.
    share
        Share of the log that has been read, 0..1; None if it is not known.

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
    """Report no progress."""
