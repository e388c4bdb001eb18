"""Work done in a copy of this process, on another core: Python's lock lets threads do one thing at a time."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import signal
import struct
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import TypeAlias, TypeVar, cast

T = TypeVar("T")
Tell: TypeAlias = Callable[[bytes], None]

_LENGTH = struct.Struct("<I")


class Forked:
    """A function at work in a copy of this process, which sends what it finds.

    The copy shares this one's memory, as it is at that moment. It sends without waiting for who receives,
    keeps still, and ends with this process, whatever ends it: its pipe breaks.

    Attributes
    ----------
    number
        The number of the process.
    """

    def __init__(self, work: Callable[[Tell], None]) -> None:
        self._source, target = os.pipe()
        self._received = bytearray()
        gc.freeze()  # or else the copy's collector would write to, and so copy, all that it shares
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which libraries end before
            self.number = os.fork()
        if self.number == 0:
            os.close(self._source)
            _work(work, target)
        gc.unfreeze()
        os.close(target)

    def receive(self) -> bytes | None:
        """The next that it has sent, waited for; None where nothing comes any more."""
        content = self._read(_LENGTH.size)
        return None if content is None else self._read(*_LENGTH.unpack(content))

    def close(self) -> None:
        """End it, wherever it is."""
        os.close(self._source)
        with suppress(ProcessLookupError):
            os.kill(self.number, signal.SIGKILL)
        os.waitpid(self.number, 0)

    def _read(self, size: int) -> bytes | None:
        """So many bytes, or None."""
        while len(self._received) < size:
            block = os.read(self._source, 1 << 16)
            if not block:
                return None
            self._received += block
        content = bytes(self._received[:size])
        del self._received[:size]
        return content


def begun(compute: Callable[[], T]) -> Callable[[], T]:
    """Begin to compute a value on another core; who asks for it waits, or computes it where no core was free.

    It takes the way through `pickle` and comes back equal, as the arrays and plain values that it is made of.
    """
    if not is_core_free():
        return compute
    copy = Forked(lambda tell: tell(pickle.dumps(compute(), pickle.HIGHEST_PROTOCOL)))

    def value() -> T:
        try:
            content = copy.receive()
        finally:
            copy.close()
        # It is our own copy that sends this; what it failed in fails here too.
        return compute() if content is None else cast(T, pickle.loads(content))

    return value


def is_core_free() -> bool:
    """Whether a copy of this process would have a core of its own, and can be made.

    Not beside other threads, whose locks it would find closed for ever; they are also those of a server, or
    of one who maps several logs at a time.
    """
    alone = threading.current_thread() is threading.main_thread() and threading.active_count() == 1
    return sys.platform == "linux" and alone and len(os.sched_getaffinity(0)) > 1


def _work(work: Callable[[Tell], None], target: int) -> None:
    """What a copy does; it never returns."""
    waiting = bytearray()

    def tell(content: bytes) -> None:
        waiting.extend(_LENGTH.pack(len(content)) + content)
        with suppress(BlockingIOError):
            del waiting[: os.write(target, waiting)]

    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for who made the copy
        warnings.simplefilter("ignore")
        logging.disable()
        os.set_blocking(target, False)
        work(tell)
        os.set_blocking(target, True)
        while waiting:
            del waiting[: os.write(target, waiting)]
    except BaseException:
        pass  # who receives goes on alone, and finds it too
    finally:
        os._exit(0)
