"""Add a session to a saved map."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from fusion.showing import one_line
from slam.app.map_run import MapRun, run_into
from slam.app.progress import OnProgress, Progress, silent
from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.datasets.opening import opened_by
from slam.errors import MapFileError, ScanweaveError, path_of
from slam.evaluation.saved_page import write_saved_page
from slam.localization.known_map import has_walls
from slam.outputs.finished_map import Map, load_map
from slam.sessions.connection import Connection, connect
from slam.sessions.joined_files import write_joined
from slam.storage.files import make_folder, write_bytes
from slam.storage.map_file import MAP_NAME
from slam.storage.map_identity import identity_of
from slam.storage.whole_folder import REPORT, holds, keep_report, move_into, only_one_in

# Where the session is mapped and the joined map is written until it is whole.
WORK = "joining"


@dataclass(frozen=True, slots=True)
class Joined:
    """The result of joining a session to a map.

    Attributes
    ----------
    map
        The joined map, open.
    session
        Result of mapping the log alone; that map is closed and deleted.
    connection
        Pose of the session in the map, and the loops between the two.
    written
        The files that were written.
    """

    map: Map
    session: MapRun
    connection: Connection
    written: tuple[Path, ...]

    __repr__ = one_line


def join(
    known: Map | Path | str,
    log: Path | str | Dataset,
    config: Config | None = None,
    *,
    out: Path | str | None = None,
    on_progress: OnProgress | None = None,
    resume: bool = False,
    strict: bool = False,
) -> Joined:
    """Map a log and join it to a saved map; the result replaces that map or goes to another folder.

    Parameters
    ----------
    known
        The map or its path. An open map stays open and keeps its contents.
    log
        A path that `slam.open_dataset` accepts, or an opened dataset.
    config
        Configuration for mapping the log; None uses the settings of the map.
    out
        Folder for the joined map; None replaces ``known``.
    on_progress
        Function that is called with a `slam.Progress` during the run.
    resume
        Continue a session that was interrupted.
    strict
        Stop at the first damaged record instead of counting and skipping it. Used if ``log`` is a path.

    Raises
    ------
    ScanweaveError
        If the two cannot be connected, or a file is faulty; the saved map is then unchanged.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> monday = write_synthetic_log("monday", seed=1, duration_s=10.0).log_path
    >>> tuesday = write_synthetic_log("tuesday", seed=2, duration_s=10.0).log_path
    >>> house = slam.map_log(monday, out="house")
    >>> joined = slam.join(house, tuesday, out="joined")
    >>> len(joined.map.sessions), len(joined.map.keyframe_poses) > len(house.keyframe_poses)
    (2, True)
    """
    known = known if isinstance(known, Map) else load_map(known)
    kind_of(known, str(known.path))
    if out is not None:
        holds(path_of(out, "out"), known.path, "give another --out (out=)")
    elif known.in_memory or known.path.name != MAP_NAME:
        why = "lies in a temporary folder" if known.in_memory else f"is not named {MAP_NAME}"
        raise MapFileError(f"{known.path} {why}; give --out (out=) for the joined map")
    log = opened_by((config or Config()).sensors, log, strict=strict)
    identity = identity_of(log, config or known.config)
    if any(session.log_fingerprint == identity.log_fingerprint for session in known.sessions):
        raise ScanweaveError(f"{log.path} is already in {known.path}; the map was not changed")
    folder = known.path.parent if out is None else Path(out)
    was_there = folder.exists()
    work = folder / WORK / "session"
    make_folder(work)
    tell = on_progress or silent
    with only_one_in(folder):
        try:
            session = run_into(work, log, identity, on_progress=tell, resume=resume, exports=False)
            tell(Progress("joining", 0))
            connection, written = _connected(log, known, session, folder)
        finally:
            session_map = work / MAP_NAME
            if not session_map.exists():  # nothing is left that could be gone on with
                shutil.rmtree(folder / WORK, ignore_errors=True)
                if not was_there and not any(folder.iterdir()):
                    folder.rmdir()
    joined = load_map(folder)
    return Joined(joined, session, connection, (*written, write_saved_page(joined)))


def _connected(log: Dataset, known: Map, session: MapRun, folder: Path) -> tuple[Connection, list[Path]]:
    """Connect the two, write the joined map into a folder, and return the files that were written."""
    work = session.map.path.parent
    try:
        kinds = [kind_of(known, str(known.path)), kind_of(session.map, f"what was mapped of {log.path}")]
        if kinds[0] != kinds[1]:
            raise ScanweaveError(
                f"{known.path} is a map of {kinds[0]}, that of {log.path} one of {kinds[1]}; "
                "the map is as it was"
            )
        connection = connect(known, session.map)
        if connection.joined is None:
            raise ScanweaveError(
                f"{log.path} does not connect to {known.path}: {connection.reason}; the map was not changed"
            )
    except ScanweaveError:
        session.map.close()
        shutil.rmtree(work)  # to go on with it would lead here again
        raise
    built = folder / WORK / "map"
    shutil.rmtree(built, ignore_errors=True)  # of a run that was killed
    write_joined(built, known, session.map, connection)
    if not (work / REPORT).is_file():  # of a run that was stopped before it
        write_saved_page(session.map)
    session.map.close()
    with load_map(built) as saved:
        saved.write_files(built)
    write_bytes(built / f"report-{len(known.sessions) + 1}.html", (work / REPORT).read_bytes())
    keep_report(folder)
    written = move_into(folder, built)
    shutil.rmtree(work)
    return connection, written


def kind_of(saved: Map, name: str) -> str:
    """Describe what a map holds in a few words; raise an error if no session can be joined to it."""
    contents = saved.contents
    if contents.clouds is not None:
        return "a 3D lidar"
    if not contents.planar and contents.frames is not None:
        return "a camera in space"
    if not has_walls(contents):
        raise ScanweaveError(f"{name} holds no lidar scan; sessions are joined by their scans")
    return "a robot on a floor"
