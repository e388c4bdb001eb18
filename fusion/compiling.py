"""Numba behind `fusion.kernel`: where compiled code is stored, and how to check that it is up to date.

It is separate from the decorator because numba loads slowly: it is imported when a kernel is first called.
"""

from __future__ import annotations

import fcntl
import logging
import os
import sys
import time
from contextlib import suppress
from functools import cache
from hashlib import sha256
from inspect import getfile
from pathlib import Path
from types import FunctionType
from typing import Any, ClassVar

import numba
import numpy as np
from llvmlite import binding
from numba.core import caching
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python
from numba.extending import typeof_impl

log = logging.getLogger(__name__)


def dispatcher_of(kernel: Any) -> Dispatcher:
    """Return numba's dispatcher of a `fusion.kernel.Kernel`; it stores compiled code if possible."""
    # The numba type of a kernel that another kernel calls.
    typeof_impl.register(type(kernel), lambda called, _: numba.types.Dispatcher(called.dispatcher))
    _loaded_ns.update(kernel.loaded_ns)
    # Kernels are never called by their C address.
    compiled = numba.njit(**{"no_cfunc_wrapper": True, **kernel.options})(kernel.py_func)
    try:
        compiled._cache = _Cache(kernel.py_func)
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        _warn()
    return compiled


@cache
def _warn() -> None:
    """Warn, once per run, that compiled code cannot be stored."""
    log.warning(
        "numba cannot keep compiled code, neither beside the source nor in the user's cache folder; "
        "set NUMBA_CACHE_DIR to a writable folder; every run compiles anew"
    )


class _Folders(caching.CompileResultCacheImpl):  # type: ignore[misc]
    """The folder of ``NUMBA_CACHE_DIR``, ``__pycache__`` beside the source, or the user's cache folder."""

    _locator_classes: ClassVar = [UserProvidedCacheLocator, InTreeCacheLocator, UserWideCacheLocator]


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    """Load compiled code without the compiler, which saves a quarter of a second and fifty megabytes.

    Numba's own cache loads the compiler before it checks whether there is anything to compile; the compiler
    loads it in any case. If another process is compiling the same code, it waits and then loads the result.
    """

    _impl_class = _Folders

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)
        self._cache_file._source_stamp, self._file = _stamp(function), getfile(function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the stored code of a signature; None if there is none."""
        _tell_linker()
        with self._guard_against_spurious_io_errors():
            overload = self._load_overload(sig, target_context)
            if overload is None and self._file not in _locks:
                self._wait()
                if overload := self._load_overload(sig, target_context):
                    os.close(_locks.pop(self._file))
            return overload

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store compiled code, and let other processes look for it."""
        super().save_overload(sig, data)
        if self._file in _locks:
            os.close(_locks.pop(self._file))

    def _wait(self) -> None:
        """Wait while another process compiles the same file; then no other starts before this one ends.

        For at most ten seconds, so that a stopped process does not block others.
        """
        lock = _locks[self._file] = os.open(self._file, os.O_RDONLY)
        with suppress(OSError):  # on a file system without locks
            for _ in range(2000):
                with suppress(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                time.sleep(sys.getswitchinterval())


@cache
def _tell_linker() -> None:
    """Pass the linker the addresses of the numba runtime functions that compiled code calls."""
    for name, address in _nrt_python.c_helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _stamp(function: FunctionType) -> str:
    """Return the digest of a kernel's file, and of the kernels and constants that it imports.

    One stamp serves the whole file: kernels are compiled when their file has been loaded.
    """
    file = getfile(function)
    if file not in _stamps:
        digest = sha256(Path(file).read_bytes())
        changed_ns = Path(file).stat().st_mtime_ns
        if changed_ns != _loaded_ns.get(file, changed_ns):
            digest.update(os.urandom(16))  # edited since it was loaded: the compiled code is older
        for name, value in sorted(function.__globals__.items()):
            if isinstance(value, (int, float, str, np.generic)) and not name.startswith("__"):
                digest.update(f"{name}={value!r}".encode())
            elif isinstance(value, type):
                digest.update(f"{name}={getattr(value, '_fields', ())}".encode())
            elif other := _used(value, function):
                digest.update(_stamp(other).encode())
        _stamps[file] = digest.hexdigest()
    return _stamps[file]


def _used(value: Any, function: FunctionType) -> FunctionType | None:
    """Return whether a kernel may call it in another file: a kernel, or a function of a file with kernels."""
    function_used = getattr(value, "py_func", value) if callable(value) else value
    if not isinstance(function_used, FunctionType) or function_used.__globals__ is function.__globals__:
        return None
    return function_used if function_used is not value or "kernel" in function_used.__globals__ else None


_stamps: dict[str, str] = {}
_locks: dict[str, int] = {}
_loaded_ns: dict[str, int] = {}
