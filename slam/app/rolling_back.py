"""Remove the last sessions of a map."""

from __future__ import annotations

from pathlib import Path

from slam.errors import MapFileError
from slam.outputs.finished_map import Map, load_map, made_anew
from slam.sessions.rolling_back import write_first_sessions


def roll_back(saved: Map | Path | str, sessions: int, *, out: Path | str | None = None) -> Map:
    """Return the map with only its first sessions; the given map stays open and unchanged.

    Parameters
    ----------
    saved
        The map, or its path.
    sessions
        Number of sessions to keep.
    out
        Folder for the map, possibly that of the given map; None keeps it in a temporary folder.

    Raises
    ------
    ScanweaveError
        If the map does not have more sessions than that, or a file is faulty; the map is then unchanged.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> logs = [write_synthetic_log(f"log{n}", seed=n, duration_s=10.0).log_path for n in (1, 2)]
    >>> house = slam.map_log(logs[0], out="house")
    >>> both = slam.join(house, logs[1], out="both").map
    >>> first = slam.roll_back(both, 1)
    >>> len(first.sessions), bool((first.grid.steps == house.grid.steps).all())
    (1, True)
    """
    saved = saved if isinstance(saved, Map) else load_map(saved)
    before = len(saved.sessions)
    if sessions not in range(1, before):
        if before < 2:
            raise MapFileError(f"{saved.path} has only one session: there is none to remove")
        raise MapFileError(
            f"{saved.path} has {before} sessions; of these 1 to {before - 1} can stay, not {sessions}"
        )
    remaining = made_anew(saved, lambda path: write_first_sessions(saved, sessions, path), out)
    if out is not None:
        first = 1 if sessions == 1 else sessions + 1
        endings = (".tum", "_covariance.csv")
        stale = [f"trajectory-{number}{end}" for number in range(first, before + 1) for end in endings]
        stale += [f"report-{number}.html" for number in range(sessions + 1, before + 1)]
        for name in stale:
            (Path(out) / name).unlink(missing_ok=True)
    return remaining
