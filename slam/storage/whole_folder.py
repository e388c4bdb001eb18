"""Change all files of a map together: all are written next to the old ones, then replace them."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.errors import MapFileError
from slam.storage.files import make_folder, replacing
from slam.storage.map_file import MAP_NAME

# Where a map is built until it is complete.
_WORK = "editing"
# The page of a map as it is, and that of the run which made its first session.
REPORT, FIRST_REPORT = "report.html", "report-1.html"
# Files of nav2 that not every map has: old ones would be of another map.
_NOT_ALWAYS = ("layers/*.yaml", "layers/*.pgm", "*_mask.yaml", "*_mask.pgm")


def holds(folder: Path, path: Path, remedy: str) -> bool:
    """Whether a folder holds the map of a path.

    Raises
    ------
    MapFileError
        If it holds another one.
    """
    target = folder / MAP_NAME
    if target.exists() and not target.samefile(path):
        raise MapFileError(f"{target} is another map; {remedy}")
    return target.exists()


def copy_into(folder: Path, path: Path, *, overwrite: bool) -> Path:
    """Copy a finished map into a folder, or leave it there; where it is then.

    Raises
    ------
    MapFileError
        If the folder holds another one that is not to be overwritten, or it cannot be written.
    """
    target = folder / MAP_NAME
    if not overwrite:
        holds(folder, path, "overwrite=True replaces it")
    make_folder(folder)
    if not (target.exists() and target.samefile(path)):
        with replacing(target, map_too=True) as temporary:
            shutil.copyfile(path, temporary)
    return target


@contextmanager
def only_one_in(folder: Path) -> Iterator[None]:
    """Keep others from changing the map of a folder during the block; a killed process releases it.

    Raises
    ------
    MapFileError
        If another one does so already.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise MapFileError(f"another run changes the map in {folder}; wait for its end") from error
    finally:
        os.close(handle)


def keep_report(folder: Path) -> None:
    """Call the page of the run that made a map by its session: it shows what is no longer the map.

    Raises
    ------
    MapFileError
        If it cannot be renamed.
    """
    old, kept = folder / REPORT, folder / FIRST_REPORT
    try:
        if old.is_file() and not kept.exists():
            old.replace(kept)
        old.unlink(missing_ok=True)
    except OSError as error:
        raise MapFileError(f"cannot write {folder}: {error.strerror or error}") from error


def move_into(folder: Path, source: Path) -> list[Path]:
    """Let all files of a folder take the place of their namesakes in another, ``map.db`` last.

    Each is renamed: at any moment ``map.db`` is the old one or the new one, whole, and while it is the old
    one the same can be done again. The source is removed.

    Returns
    -------
    Where they are now.

    Raises
    ------
    MapFileError
        If a file cannot be moved.
    """
    files = sorted(path for path in source.rglob("*") if path.is_file())
    files.sort(key=lambda path: path.name == MAP_NAME)
    moved = []
    try:
        for file in files:
            target = folder / file.relative_to(source)
            make_folder(target.parent)
            file.replace(target)
            moved.append(target)
        shutil.rmtree(source)
    except OSError as error:
        raise MapFileError(f"cannot write {folder}: {error.strerror or error}") from error
    return moved


def remake(folder: Path, write: Callable[[Path], None]) -> None:
    """Let a function write a map and its files beside those of a folder, then let them take their place.

    Raises
    ------
    ScanweaveError
        If it fails: the folder is as it was.
    """
    make_folder(folder)
    with only_one_in(folder):
        work = folder / _WORK
        shutil.rmtree(work, ignore_errors=True)  # of a run that was killed
        make_folder(work)
        try:
            write(work)
            for pattern in _NOT_ALWAYS:
                for old in folder.glob(pattern):
                    if not (work / old.relative_to(folder)).exists():
                        old.unlink()
            keep_report(folder)
            move_into(folder, work)
        finally:
            shutil.rmtree(work, ignore_errors=True)
