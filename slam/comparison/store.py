"""Results on disk: one folder per run, named by its key, published atomically."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slam.comparison.files import RESULT
from slam.errors import MapFileError
from slam.storage.files import make_folder, write_bytes
from slam.temporary import TemporaryFolder

# Stopped by the machine or a limit, not by the run itself: these are tried again.
PASSING = frozenset({"timeout", "memory", "killed"})


class ResultStore:
    """The folder ``runs`` of a comparison, shared by all workers.

    Parameters
    ----------
    root
        The comparison's folder.
    """

    def __init__(self, root: Path) -> None:
        self.folder = root / "runs"
        make_folder(self.folder)

    def of(self, key: str) -> Path:
        """Folder of a run."""
        return self.folder / key

    def row(self, key: str) -> dict[str, Any] | None:
        """The row of a finished run, None if there is none.

        Raises
        ------
        MapFileError
            If it exists and cannot be read.
        """
        path = self.of(key) / RESULT
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise MapFileError(
                f"cannot read {path}: {error}; remove {path.parent} to run it again"
            ) from error
        return content

    def forget(self, key: str) -> None:
        """Delete the result of a run that is repeated."""
        shutil.rmtree(self.of(key), ignore_errors=True)

    @contextmanager
    def attempt(self) -> Iterator[Path]:
        """A working folder; it is deleted afterwards unless published."""
        folder = TemporaryFolder(self.folder, ".attempt-")
        try:
            yield folder.path
        finally:
            folder.remove()

    def publish(self, folder: Path, key: str, row: dict[str, Any]) -> dict[str, Any]:
        """Publish a finished attempt as the run's result, unless another attempt was first.

        Returns
        -------
        The row that is valid.
        """
        write_bytes(folder / RESULT, json.dumps(row, indent=1).encode())
        folder.chmod(0o755)
        try:
            folder.rename(self.of(key))  # fails if a non-empty folder exists: the first one remains
        except OSError as error:
            known = self.row(key)
            if known is None:
                raise MapFileError(f"cannot write {self.of(key)}: {error.strerror or error}") from error
            return known
        return row

    def missing(self, keys: Iterable[str], *, resume: bool) -> set[str]:
        """Keys to run: all, or those without a final result; their leftovers are removed."""
        missing = set()
        for key in keys:
            row = self.row(key) if resume else None
            if row is None or row["status"] in PASSING:
                self.forget(key)
                missing.add(key)
        return missing

    def sweep(self) -> None:
        """Remove leftovers of killed workers."""
        for folder in self.folder.glob(".attempt-*"):
            shutil.rmtree(folder, ignore_errors=True)
