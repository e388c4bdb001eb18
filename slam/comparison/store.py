"""Results on disk: a folder a run, named by its key, which appears whole or not at all."""

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

# What stopped these was the machine or a limit, not the run: they are tried again.
PASSING = frozenset({"timeout", "memory", "killed"})


class ResultStore:
    """The folder ``runs`` of a comparison; every worker sees the same one.

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
        """A finished run's row, None if there is none.

        Raises
        ------
        MapFileError
            If it is there and cannot be read.
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
        """Make room for a run that is done anew."""
        shutil.rmtree(self.of(key), ignore_errors=True)

    @contextmanager
    def attempt(self) -> Iterator[Path]:
        """A folder to work in; what is not published is gone afterwards."""
        folder = TemporaryFolder(self.folder, ".attempt-")
        try:
            yield folder.path
        finally:
            folder.remove()

    def publish(self, folder: Path, key: str, row: dict[str, Any]) -> dict[str, Any]:
        """Let a finished attempt be the run's result, unless another attempt was first.

        Returns
        -------
        The row that holds.
        """
        write_bytes(folder / RESULT, json.dumps(row, indent=1).encode())
        folder.chmod(0o755)
        try:
            folder.rename(self.of(key))  # fails where a folder with content is there: the first one stays
        except OSError as error:
            known = self.row(key)
            if known is None:
                raise MapFileError(f"cannot write {self.of(key)}: {error.strerror or error}") from error
            return known
        return row

    def missing(self, keys: Iterable[str], *, resume: bool) -> set[str]:
        """Keys that are to be run: all, or those without a lasting result; others' remains are removed."""
        wanted = set()
        for key in keys:
            row = self.row(key) if resume else None
            if row is None or row["status"] in PASSING:
                self.forget(key)
                wanted.add(key)
        return wanted

    def sweep(self) -> None:
        """Remove what killed workers have left."""
        for folder in self.folder.glob(".attempt-*"):
            shutil.rmtree(folder, ignore_errors=True)
