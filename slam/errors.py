"""Errors for users; each message names the problem, the value, the limit and the remedy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slam.foreign import plain


class ScanweaveError(Exception):
    """Base class of all expected errors; the command line prints the message in one line and exits with 1.

    Text that a message quotes from a file or its name is sanitised here, so it is safe wherever it is shown.

    Examples
    --------
    >>> import slam
    >>> try:
    ...     slam.open_dataset("no-such.log")
    ... except slam.ScanweaveError as error:
    ...     print(str(error)[:46])
    no-such.log does not exist; give the path of a
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(plain(message, longest=4096))


class ConfigError(ScanweaveError):
    """A configuration file or override that does not fit the model."""


class DatasetError(ScanweaveError):
    """A log that cannot be opened or has no usable data."""


class BadRecordError(DatasetError):
    """A single malformed record; raised only with ``--strict``, otherwise it is counted and skipped."""


class GraphError(ScanweaveError):
    """A measurement that the graph does not accept (not finite, wrong size, not positive definite)."""


class MapFileError(ScanweaveError):
    """A saved map, grid, graph or trajectory file that is damaged or in another format."""


class UnfinishedMapError(MapFileError):
    """A map whose run was interrupted or is still running."""


class LibraryError(ScanweaveError):
    """A library that cannot be loaded, or that needs a missing system library."""


@contextmanager
def needs(what: str, extra: str) -> Iterator[None]:
    """Turn the failed import of an optional library into a `LibraryError` that names the extra to install."""
    try:
        yield
    except ImportError as error:
        raise LibraryError(f"{what}: pip install 'scanweave[{extra}]'") from error


class EvaluationError(ScanweaveError):
    """A reference that does not match the trajectory to be scored."""


def path_of(given: Any, what: str, error: type[ScanweaveError] = MapFileError) -> Path:
    """Return a path that a caller gave; an error of the given type if it is none, or not possible."""
    try:
        path = Path(given)
        if not path.exists() and "\0" in str(path):
            raise ValueError("it contains a NUL character")
    except (TypeError, ValueError, OSError) as cause:
        why = getattr(cause, "strerror", "") or "" if isinstance(cause, OSError) else f"{cause}"
        raise error(f"{what} is {plain(repr(given), 80)}; give a path: {why}") from cause
    return path
