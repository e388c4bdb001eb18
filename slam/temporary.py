"""Temporary files and folders, locked while in use: the next run removes those that a killed run left."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

# Between its making and its locking a file is not locked either.
_SETTLED_S = 60.0
_PREFIX = "scanweave-held-"


class TemporaryFolder:
    """A folder that goes with this object, or when `remove` is called; also at the end of the program.

    Parameters
    ----------
    inside
        The folder that it is made in; None for that of the system.
    prefix
        How its name begins; folders of such names are this class's alone.
    """

    def __init__(self, inside: Path | None = None, prefix: str = _PREFIX) -> None:
        remove_left(Path(inside or tempfile.gettempdir()).glob(f"{prefix}*"))
        self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=inside))
        self.remove = weakref.finalize(self, _forget, self.path, _locked(self.path))


@contextmanager
def held(path: Path, *, folder: bool = False) -> Iterator[None]:
    """Hold a new, empty file or folder while the block writes it in its place."""
    path.mkdir(parents=True) if folder else path.touch(exist_ok=False)
    lock = _locked(path)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def remove_left(candidates: Iterable[Path]) -> None:
    """Remove of these files and folders what is our own and no living process holds."""
    for path in candidates:
        try:
            found = path.lstat()
            if found.st_uid != os.getuid() or time.time() - found.st_mtime < _SETTLED_S:
                continue
            lock = _locked(path)
        except OSError:
            continue
        if lock is not None:
            _forget(path, lock)


def _locked(path: Path) -> int | None:
    """A lock on a file or folder, as a descriptor; None if another process has it, or none can be had."""
    lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        return None
    return lock


def _forget(path: Path, lock: int | None) -> None:
    """Remove what a lock holds."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
    if lock is not None:
        os.close(lock)
