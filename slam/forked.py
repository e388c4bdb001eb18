"""Run work in a copy of this process on another core; Python's lock lets only one thread run at a time."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import select
import signal
import struct
import sys
import threading
import warnings
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

Send: TypeAlias = Callable[[bytes], None]

_LENGTH = struct.Struct("<I")


class Forked:
    """A function at work in a copy of this process, which sends what it finds.

    The copy shares this one's memory, as it is at that moment. It sends without waiting for who receives,
    keeps still, and ends with this process, whatever ends it: its pipe breaks.

    Attributes
    ----------
    close
        Ends it, wherever it is.
    """

    def __init__(self, work: Callable[[Send], None]) -> None:
        self._source, target = os.pipe()
        self._received = bytearray()
        gc.freeze()  # or else the copy's collector would write to, and so copy, all that it shares
        alone = weakref.finalize(self, os.close, self._source)
        self.close: Callable[[], Any] = alone
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which libraries end before
                self.number = os.fork()
        except OSError:  # no room for another process: nothing is ever received
            gc.unfreeze()
            os.close(target)
            return
        if self.number == 0:
            os.close(self._source)
            _work(work, target)
        gc.unfreeze()
        os.close(target)
        alone.detach()
        self.close = weakref.finalize(self, _end, self._source, self.number)

    def receive(self) -> bytes | None:
        """The next that it has sent, waited for; None if nothing comes any more."""
        content = self._read(_LENGTH.size)
        return None if content is None else self._read(*_LENGTH.unpack(content))

    def _read(self, size: int) -> bytes | None:
        """So many bytes, or None: also where it neither sends nor works, as on a lock that nobody opens."""
        worked = -1
        while len(self._received) < size:
            if not select.select([self._source], [], [], 10)[0]:
                before, worked = worked, _worked(self.number)
                if worked == before:
                    return None
                continue
            block = os.read(self._source, 1 << 16)
            if not block:
                return None
            self._received += block
        content = bytes(self._received[:size])
        del self._received[:size]
        return content


class Begun:
    """Values that are computed one after the other on another core, from now on, and asked for in that order.

    Where no core was free, or the copy has failed, each is computed when it is asked for. A value takes the
    way through `pickle`: arrays and plain values come back equal.
    """

    def __init__(self, *computes: Callable[[], Any]) -> None:
        self._left = list(computes)
        self._copy: Forked | None = None

        def work(send: Send) -> None:
            for compute in computes:
                send(pickle.dumps(compute(), pickle.HIGHEST_PROTOCOL))

        if is_core_free():
            self._copy = Forked(work)

    def __call__(self) -> Any:
        """The next value."""
        compute = self._left.pop(0)
        content = None if self._copy is None else self._copy.receive()
        if self._copy is not None and (content is None or not self._left):
            self._copy.close()
            self._copy = None
        return compute() if content is None else pickle.loads(content)  # it is our own copy that has sent it


def is_core_free() -> bool:
    """Whether a copy of this process would have a core of its own, and can be made.

    Not beside other threads, whose locks it would find closed for ever; they are also those of a server, or
    of one who maps several logs at a time.
    """
    alone = threading.current_thread() is threading.main_thread() and threading.active_count() == 1
    return sys.platform == "linux" and alone and len(os.sched_getaffinity(0)) > 1


def _worked(number: int) -> int:
    """Ticks of a core that a process of this machine has had, user and system; 0 where it is gone."""
    try:
        fields = Path(f"/proc/{number}/stat").read_text("utf-8").rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[11]) + int(fields[12])


def _end(source: int, number: int) -> None:
    """End a copy, wherever it is."""
    os.close(source)
    # Where SIGCHLD is ignored, as some services start their programs, one that has ended is gone already.
    with suppress(ProcessLookupError, ChildProcessError):
        os.kill(number, signal.SIGKILL)
        os.waitpid(number, 0)


def _work(work: Callable[[Send], None], target: int) -> None:
    """What a copy does; it never returns."""
    waiting = bytearray()

    def send(content: bytes) -> None:
        waiting.extend(_LENGTH.pack(len(content)) + content)
        with suppress(BlockingIOError):
            del waiting[: os.write(target, waiting)]

    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for who made the copy
        warnings.simplefilter("ignore")
        logging.disable()
        os.set_blocking(target, False)
        work(send)
        os.set_blocking(target, True)
        while waiting:
            del waiting[: os.write(target, waiting)]
    except BaseException:
        pass  # who receives goes on alone, and finds it too
    finally:
        os._exit(0)
