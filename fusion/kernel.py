"""The decorator of the compiled kernels: numba compiles one when it is first called, and keeps the code.

The code is kept where numba keeps it: in the folder that ``NUMBA_CACHE_DIR`` names, else beside the source,
else in the user's cache folder. Two things are done better here. Numba compiles a kernel anew where its own
file has changed; here also where a kernel or a constant has that it takes from another file. And where no
folder can be written to, numba gives up; here it is said once, and every run compiles anew.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from inspect import getfile
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from numba.core import caching
from numba.core.dispatcher import Dispatcher

log = logging.getLogger(__name__)

# Numbers to begin with for what a loop changes: after a literal, numba infers the types once more a loop.
ZERO: Any = np.int64(0)
ONE: Any = np.int64(1)
NONE: Any = np.int64(-1)

_CONSTANT = (int, float, str, np.generic)


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` with its options; the compiled code is kept.

    Write kernels that compile fast, for the first run waits for all of them: a millisecond goes into each
    operation, two to four into each element read or written, five into each loop, fifty into each function
    and a hundred into the first array that is made. So arrays are made by who calls, loops are plain, and a
    helper of one kernel is ``inline="always"``.
    """
    if function is None:
        return partial(kernel, **options)
    # Nobody calls kernels by their C address.
    options = {"no_cfunc_wrapper": True, **options}
    chosen = numba.config.CACHE_LOCATOR_CLASSES
    try:
        numba.config.CACHE_LOCATOR_CLASSES = chosen or _FOLDERS
        return numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        _warn()
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_LOCATOR_CLASSES = chosen


@cache
def _warn() -> None:
    """Say, once a run, that compiled code is lost."""
    log.warning(
        "numba cannot keep compiled code, neither beside the source nor in the user's cache folder; "
        "set NUMBA_CACHE_DIR to a writable folder; every run compiles anew"
    )


class _Stamped(caching._CacheLocator):  # type: ignore[misc]
    """Tells numba by what a kernel's compiled code is still the right one."""

    def __init__(self, py_func: FunctionType, py_file: str) -> None:
        super().__init__(py_func, py_file)
        self._function = py_func

    def get_source_stamp(self) -> str:
        """What the code was compiled from."""
        return _stamp(self._function)


class GivenFolder(_Stamped, caching.UserProvidedCacheLocator):  # type: ignore[misc]
    """The folder of ``NUMBA_CACHE_DIR``."""


class SourceFolder(_Stamped, caching.InTreeCacheLocator):  # type: ignore[misc]
    """``__pycache__`` beside the source."""


class UserFolder(_Stamped, caching.UserWideCacheLocator):  # type: ignore[misc]
    """The user's cache folder."""


_FOLDERS = ",".join(f"{__name__}.{folder.__name__}" for folder in (GivenFolder, SourceFolder, UserFolder))


def _stamp(function: FunctionType) -> str:
    """Digest of the file of a kernel, and of the kernels and constants which that file has from elsewhere.

    All that a file takes from others stands above its first kernel; so one stamp serves the whole file.
    """
    file = getfile(function)
    if file not in _stamps:
        digest = sha256(Path(file).read_bytes())
        for name, value in sorted(function.__globals__.items()):
            if isinstance(value, _CONSTANT) and not name.startswith("__"):
                digest.update(f"{name}={value!r}".encode())
            elif isinstance(value, type):
                digest.update(f"{name}={getattr(value, '_fields', ())}".encode())
            elif other := _used(value, function):
                digest.update(_stamp(other).encode())
        _stamps[file] = digest.hexdigest()
    return _stamps[file]


def _used(value: Any, function: FunctionType) -> FunctionType | None:
    """What a kernel may call in another file: a kernel, or a plain function of a file with kernels."""
    found = value.py_func if isinstance(value, Dispatcher) else value
    if not isinstance(found, FunctionType) or found.__globals__ is function.__globals__:
        return None
    return found if found is not value or "kernel" in found.__globals__ else None


_stamps: dict[str, str] = {}
