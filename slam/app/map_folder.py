"""Folder of a map during a run: its contents, and how a run starts, resumes and leaves it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path

from slam.errors import DatasetError, MapFileError, UnfinishedMapError
from slam.storage.map_edits import UneditedFile
from slam.storage.map_file import MAP_NAME, MapFile, is_tidy, settle_counts
from slam.storage.map_identity import MapIdentity


def finished_map(folder: Path, identity: MapIdentity) -> bool:
    """Whether the map that should be resumed is finished already.

    Raises
    ------
    MapFileError
        If it is of another log, configuration or version, or damaged.
    """
    path = folder / MAP_NAME
    file: MapFile | None
    try:
        file, tidy = MapFile.read(path), is_tidy(path)
    except MapFileError:
        file, tidy = MapFile.resume(path), False
    if file is None:
        return False
    try:
        # Edits and other settings came after the run: that was as it was.
        difference = MapIdentity.from_meta(UneditedFile(file).meta(), path).difference(identity)
        finished = file.finished
    finally:
        file.close()
    if difference is not None:
        raise MapFileError(f"{path} cannot be resumed: {difference}; map anew, without --resume or elsewhere")
    if finished and not tidy:
        # The interruption came between the last word and the end of the tidying up.
        left = MapFile.resume(path)
        assert left is not None
        left.compact()
        MapFile.read(path).close()  # which refuses a damaged one
    elif finished and os.access(path, os.W_OK):
        settle_counts(path)
    return finished


class Left(Enum):
    """What an earlier run has left in a folder."""

    NOTHING = "nothing"
    UNFINISHED = "a map that was interrupted"
    FINISHED = "a finished map"
    DAMAGED = "not a complete map"


def left_in(folder: Path) -> Left:
    """What an earlier run has left in a folder."""
    path = folder / MAP_NAME
    if not path.is_file() or not path.stat().st_size:
        return Left.NOTHING
    try:
        MapFile.read(path).close()
    except UnfinishedMapError:
        return Left.UNFINISHED
    except MapFileError:
        return Left.DAMAGED
    return Left.FINISHED


@contextmanager
def opened_map(folder: Path, identity: MapIdentity, *, resume: bool) -> Iterator[MapFile]:
    """Yield the map to write; whatever but a faulty log ends the block, what was found out is kept.

    Raises
    ------
    MapFileError
        If it cannot be made, or another run writes it.
    """
    path = folder / MAP_NAME
    file = MapFile.resume(path) if resume else None
    resumed = file is not None
    if file is None:
        file = MapFile.create(path)
        for key, value in identity.to_meta().items():
            file.add_meta(key, value)
        file.commit()
    try:
        yield file
    except DatasetError:
        if not resumed:  # the log is at fault: there is nothing to go on with
            file.discard()
        raise
    except KeyboardInterrupt:
        file.commit()
        raise
    finally:
        file.close()
