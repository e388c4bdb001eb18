"""How ``scanweave map`` begins, goes on with and leaves a map that is being made."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.errors import DatasetError, MapFileError, UnfinishedMapError
from slam.storage.map_file import MAP_NAME, MapFile, is_tidy, settle_counts
from slam.storage.map_identity import MapIdentity


def finished_map(folder: Path, identity: MapIdentity) -> bool:
    """Whether the map that should be resumed is finished already.

    Raises
    ------
    MapFileError
        Where it is of another log, configuration or version, or damaged.
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
        difference = MapIdentity.from_meta(file.meta(), path).difference(identity)
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
    elif finished:
        settle_counts(path)
    return finished


@contextmanager
def opened_map(folder: Path, identity: MapIdentity, *, resume: bool) -> Iterator[MapFile]:
    """Yield the map to write; whatever but a faulty log ends the block, what was found out is kept.

    Raises
    ------
    MapFileError
        Where it cannot be made, or another run writes it.
    """
    path = folder / MAP_NAME
    file = MapFile.resume(path) if resume else None
    resumed = file is not None
    if file is not None:
        print(f"going on with {path}", file=sys.stderr)
    else:
        unfinished = left_unfinished(path)
        file = MapFile.create(path)
        if resume:
            print(f"nothing to resume in {folder}; mapping from the beginning", file=sys.stderr)
        elif unfinished:
            print(f"replacing {path}, which an interrupted run has left", file=sys.stderr)
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
        print(f"{path} is not finished; the same command with --resume goes on with it", file=sys.stderr)
        raise
    finally:
        file.close()


def left_unfinished(path: Path) -> bool:
    """Whether a map is there that was never finished."""
    if not path.is_file():
        return False
    try:
        MapFile.read(path).close()
    except UnfinishedMapError:
        return True
    except MapFileError:
        return False
    return False
