"""Release memory that counts as used without need: what the C library keeps, and the code of libraries."""

from __future__ import annotations

import ctypes
import mmap
import re
from contextlib import suppress
from pathlib import Path

# What of files is in memory and not this process's own, in /proc/self/smaps (proc_pid_smaps(5)).
_UNCHANGED = re.compile(
    r"^(\w+)-(\w+) (?:r-[x-]p|rw-s) \S+ \S+ \d+ +/.*\n(?:\w+: .*\n)*?Anonymous: +0 kB", re.M
)

# Whether nothing but a command runs in this process. Where others do, their code would have to come back
# a stage later, and the system takes long to tell what a large process has in memory.
own_process = False


def give_back() -> None:
    """Return it to the system, where the library can: between what is kept it would pile up.

    It takes a millisecond or some: for the end of a stage, not of a scan.
    """
    with suppress(OSError, AttributeError, TypeError):  # one that is not glibc keeps it
        ctypes.CDLL(None).malloc_trim(0)


def end_stage() -> None:
    """`give_back`, and in an `own_process` let go of the code of libraries, and of arrays in files.

    What the next stage calls comes back from the system's cache of files, in some ten milliseconds.
    """
    give_back()
    if not own_process:
        return
    with suppress(OSError, AttributeError, TypeError):  # not Linux
        advise = ctypes.CDLL(None).madvise
        for first, last in _UNCHANGED.findall(Path("/proc/self/smaps").read_text()):
            start = int(first, 16)
            advise(ctypes.c_void_p(start), ctypes.c_size_t(int(last, 16) - start), mmap.MADV_DONTNEED)
