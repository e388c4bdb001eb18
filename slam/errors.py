"""The errors that a user can meet; each message says what, the value, the limit and the remedy."""

from __future__ import annotations

from slam.foreign import plain


class ScanweaveError(Exception):
    """Base of every expected failure; the command line prints it in one line and exits with 1.

    What a message quotes of a file or its name is made plain here, wherever it is shown.

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
    """A log that cannot be opened or holds nothing usable."""


class BadRecordError(DatasetError):
    """A single malformed record, raised only under ``--strict``; otherwise counted and skipped."""


class GraphError(ScanweaveError):
    """A measurement that must not enter the graph (not finite, wrong size, not positive definite)."""


class MapFileError(ScanweaveError):
    """A saved map, grid, graph or trajectory file that is damaged or in another format."""


class UnfinishedMapError(MapFileError):
    """A map whose run was interrupted, or still goes on."""


class LibraryError(ScanweaveError):
    """A library that does not load, or lacks one of the system."""


class EvaluationError(ScanweaveError):
    """A reference that does not fit the trajectory it should score."""
