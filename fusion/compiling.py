"""Numba behind `fusion.kernel`: where compiled code is kept, and by what it is still the right one.

Apart from the decorator, for numba takes long to load: this file is imported when a kernel is first called.
"""

from __future__ import annotations

import logging
import os
from functools import cache
from hashlib import sha256
from inspect import getfile
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from llvmlite import binding
from numba.core import caching
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python
from numba.extending import typeof_impl

log = logging.getLogger(__name__)

_CONSTANT = (int, float, str, np.generic)


def dispatcher_of(kernel: Any) -> Dispatcher:
    """Numba's own object of a `fusion.kernel.Kernel`, which keeps what it compiles where that is possible."""
    _make_known(type(kernel))
    _loaded_ns.update(kernel.loaded_ns)
    # Nobody calls kernels by their C address.
    options = {"no_cfunc_wrapper": True, **kernel.options}
    chosen = numba.config.CACHE_LOCATOR_CLASSES
    try:
        numba.config.CACHE_LOCATOR_CLASSES = chosen or _FOLDERS
        found = numba.njit(**options)(kernel.py_func)
        found._cache = _Cache(kernel.py_func)
        return found
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        _warn()
        return numba.njit(**options)(kernel.py_func)
    finally:
        numba.config.CACHE_LOCATOR_CLASSES = chosen


def _make_known(kind: type) -> None:
    """Tell numba what a kernel is that another one calls: its dispatcher."""
    typeof_impl.register(kind, lambda kernel, _: numba.types.Dispatcher(kernel.dispatcher))


@cache
def _warn() -> None:
    """Say, once a run, that compiled code is lost."""
    log.warning(
        "numba cannot keep compiled code, neither beside the source nor in the user's cache folder; "
        "set NUMBA_CACHE_DIR to a writable folder; every run compiles anew"
    )


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    """Loads compiled code without what only compiling takes: a quarter of a second, and fifty megabytes.

    Numba's own loads all that it can compile before it looks whether there is anything to compile; the
    compiler loads it in any case.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code of a signature, with what it came with; None where there is none."""
        _tell_linker()
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


@cache
def _tell_linker() -> None:
    """Where the functions of numba's runtime are that compiled code calls."""
    for name, address in _nrt_python.c_helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


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

    One stamp serves the whole file: kernels are compiled when their file has been loaded.
    """
    file = getfile(function)
    if file not in _stamps:
        digest = sha256(Path(file).read_bytes())
        changed_ns = Path(file).stat().st_mtime_ns
        if changed_ns != _loaded_ns.get(file, changed_ns):
            digest.update(os.urandom(16))  # edited since: what is compiled is not what is there now
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
    found = getattr(value, "py_func", value) if callable(value) else value
    if not isinstance(found, FunctionType) or found.__globals__ is function.__globals__:
        return None
    return found if found is not value or "kernel" in found.__globals__ else None


_stamps: dict[str, str] = {}
_loaded_ns: dict[str, int] = {}
