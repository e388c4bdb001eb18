"""The memory that the C library keeps of what was freed."""

from __future__ import annotations

import ctypes
from contextlib import suppress


def give_back() -> None:
    """Return it to the system, where the library can: between what is kept it would pile up.

    It takes a millisecond or some: for the end of a stage, not of a scan.
    """
    with suppress(OSError, AttributeError, TypeError):  # one that is not glibc keeps it
        ctypes.CDLL(None).malloc_trim(0)
