"""Decorator of the compiled kernels: numba compiles a kernel at its first call and stores the code.

Numba stores the code in the folder that ``NUMBA_CACHE_DIR`` names, else next to the source, else in the
user's cache folder. This decorator improves three things. It loads numba at the first call of a kernel. Numba
recompiles a kernel if its own file changed; here also if a kernel or constant that it imports from another
file changed. And if no folder is writable, numba stops with an error; here the user is warned once, and every
run compiles again.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, partial, update_wrapper
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

# Initial values of loop variables: with a literal, numba infers the types once more per loop.
ZERO: Any = np.int64(0)
ONE: Any = np.int64(1)
NONE: Any = np.int64(-1)


class Kernel:
    """A function that numba compiles for the types with which it is called.

    Attributes
    ----------
    py_func, options
        Function to compile, and options: see `numba.njit`.
    run
        Target of a call: numba's own object after the first call.
    loaded_ns
        Modification time of each file with kernels when it was loaded.
    """

    loaded_ns: ClassVar[dict[str, int]] = {}

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self.py_func, self.options = function, options
        self.run: Any = self._first_run
        with suppress(OSError):  # interactive code has no file
            file = function.__code__.co_filename
            self.loaded_ns[file] = Path(file).stat().st_mtime_ns

    def __call__(self, *arguments: Any) -> Any:
        """Return the result for these arguments."""
        return self.run(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # requested by inspection tools, no reason to load numba
            raise AttributeError(name)
        return getattr(self.dispatcher, name)

    @cached_property
    def dispatcher(self) -> Any:
        """Return numba's dispatcher."""
        from fusion.compiling import dispatcher_of

        return dispatcher_of(self)

    def _first_run(self, *arguments: Any) -> Any:
        """Call it, and use numba's object directly from now on."""
        self.run = self.dispatcher
        return self.run(*arguments)


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` with its options; the compiled code is stored.

    Write kernels that compile fast, because the first run waits for all of them: each operation takes a
    millisecond, each element read or written two to four, each loop five, each function fifty, and the first
    array that is created a hundred. So the caller creates arrays, loops are plain, and a helper of one kernel
    is ``inline="always"``.
    """
    return partial(kernel, **options) if function is None else Kernel(function, options)
