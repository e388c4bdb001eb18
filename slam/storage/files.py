"""Read and write all text and image files of Scanweave: completely, or not at all."""

from __future__ import annotations

import glob
import gzip
import secrets
import shutil
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from slam.datasets.budget import Budget
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import MAX_LINE_BYTES
from slam.errors import MapFileError, ScanweaveError
from slam.storage.map_file import MAP_NAME
from slam.temporary import held, remove_left


@contextmanager
def replacing(path: Path, *, map_too: bool = False) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; rename it to ``path`` if the block succeeds.

    A reader of ``path`` sees the old file or the whole new one, never half of it; what a killed run has left
    of it is removed. The temporary name keeps the suffix of ``path``: some writers choose the format by it.

    Raises
    ------
    MapFileError
        If the folder is missing, not writable or full, or unless ``map_too`` the name is that of a map;
        nothing is left behind.
    """
    path = Path(path)
    if path.name == MAP_NAME and not map_too:
        raise MapFileError(f"{path} is the name of a map, which would be lost; give another name")
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(8)}.tmp{path.suffix}")
    remove_left(path.parent.glob(f".{glob.escape(path.stem)}.{'?' * 16}.tmp{glob.escape(path.suffix)}"))
    try:
        with held(temporary):
            yield temporary
            temporary.replace(path)
    except OSError as error:
        raise MapFileError(
            f"cannot write {path}: {error.strerror or error}; check the folder and its free space"
        ) from error
    finally:
        with suppress(OSError):  # of a folder that cannot be written to
            temporary.unlink()


def make_folder(path: Path) -> None:
    """Create a folder and its parents if missing.

    Raises
    ------
    MapFileError
        If that fails, or a file with that name exists.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MapFileError(
            f"cannot make the folder {path}: {error.strerror or error}; give another name"
        ) from error


@contextmanager
def filling(folder: Path) -> Iterator[None]:
    """Create a folder if missing; if the block fails or is interrupted, a new folder is removed again."""
    new = not folder.exists()
    make_folder(folder)
    try:
        yield
    except BaseException:
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path`` at once; `MapFileError` as in `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines of text at once, each ended by a newline; a name in ``.gz`` is compressed.

    The compressed form contains neither name nor time, so that equal lines give equal bytes.

    Raises
    ------
    MapFileError
        As in `replacing`.
    """
    with replacing(path) as temporary, temporary.open("wb") as raw:
        if Path(path).suffix == ".gz":
            with gzip.GzipFile(filename="", mode="wb", fileobj=raw, mtime=0) as packed:
                packed.writelines(f"{line}\n".encode() for line in lines)
        else:
            raw.writelines(f"{line}\n".encode() for line in lines)


def numbered_fields(
    path: Path, error: type[ScanweaveError] = MapFileError
) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, blank-separated fields) of a text file, plain or ``.gz``.

    Empty lines and whole-line comments (``#``) are skipped, but counted.

    Raises
    ------
    ScanweaveError
        Of the type ``error``, if the file cannot be opened, is not text, its compression is damaged, or it
        decompresses to more than any such file.
    """
    path = Path(path)
    number, opened = 0, gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rt", encoding="utf-8") as stream:
            budget = Budget(path.stat().st_size, text=True)
            for number, line in enumerate(iter(lambda: stream.readline(MAX_LINE_BYTES), ""), start=1):
                budget.take(len(line))
                fields = line.split()
                if fields and not fields[0].startswith("#"):
                    yield number, fields
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a text file (after line {number}); is it another format?") from cause
    except (EOFError, zlib.error, gzip.BadGzipFile) as cause:
        raise error(f"{path}: damaged gzip data after line {number}; fetch the file again") from cause
    except RecordFault as cause:
        raise error(f"{path}: {cause}") from cause
    except OSError as cause:
        raise error(f"cannot read {path}: {cause.strerror or cause}") from cause


def parse_floats(fields: list[str], where: str, error: type[ScanweaveError] = MapFileError) -> list[float]:
    """Parse finite floats from ``fields``; ``where`` (file and line) begins the message of ``error``."""
    try:
        values = [float(text) for text in fields]
    except ValueError as cause:
        raise error(f"{where}: {cause}") from cause
    for text, value in zip(fields, values, strict=True):
        if not abs(value) < float("inf"):
            raise error(f"{where}: '{text}' is not a finite number")
    return values
