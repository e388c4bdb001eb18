"""Work in a copy of this process."""

from __future__ import annotations

import os
import select
import signal
import threading
import time

import numpy as np
import pytest

from slam import forked
from slam.forked import Begun, Forked, Send, is_core_free


def test_all_that_is_reported_comes_in_its_order_however_much_waits() -> None:
    blocks = [bytes([number]) * size for number, size in enumerate((0, 1, 70_000, 3_000_000, 5))]

    def work(send: Send) -> None:
        for block in blocks:
            send(block)

    copy = Forked(work)
    time.sleep(0.05)  # it is not waited for, and waits for nobody
    try:
        assert [copy.receive() for _ in range(6)] == [*blocks, None]
    finally:
        copy.close()


def test_an_error_ends_what_it_shows_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    def work(send: Send) -> None:
        send(b"one")
        raise ValueError("nobody reads this")

    copy = Forked(work)
    assert (copy.receive(), copy.receive()) == (b"one", None)
    copy.close()
    assert capfd.readouterr() == ("", "")


def test_it_does_not_heed_an_interrupt_and_ends_when_it_is_closed() -> None:
    def work(send: Send) -> None:
        send(b"begun")
        while True:
            time.sleep(0.01)

    copy = Forked(work)
    assert copy.receive() == b"begun"
    os.kill(copy.number, signal.SIGINT)
    time.sleep(0.05)
    assert os.waitpid(copy.number, os.WNOHANG) == (0, 0)
    copy.close()
    with pytest.raises(ProcessLookupError):
        os.kill(copy.number, 0)


def test_nobody_is_left_where_it_is_forgotten() -> None:
    copy = Forked(lambda send: time.sleep(60.0))
    number = copy.number
    del copy
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


def test_no_copy_is_made_beside_a_thread_or_on_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    assert is_core_free()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    assert not is_core_free()
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    assert not is_core_free()


@pytest.mark.parametrize("free", [True, False])
def test_a_value_that_was_begun_is_what_is_computed(free: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked, "is_core_free", lambda: free)
    numbers, here = np.arange(1e6), os.getpid()
    value = Begun(lambda: {"twice": 2.0 * numbers}, os.getpid)
    np.testing.assert_array_equal(value()["twice"], 2.0 * numbers)
    assert (value() == here) is not free


def test_what_fails_in_the_copy_fails_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked, "is_core_free", lambda: True)

    def compute() -> int:
        raise ValueError("no such number")

    value = Begun(compute, os.getpid)
    with pytest.raises(ValueError, match="no such number"):
        value()
    assert value() == os.getpid()


def test_a_copy_that_waits_for_what_never_comes_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one on a lock that another thread of a library held when the copy was made."""
    wait = select.select
    monkeypatch.setattr(forked.select, "select", lambda *of: wait(*of[:3], 0.05))

    def work(send: Send) -> None:
        send(b"begun")
        closed = threading.Lock()
        closed.acquire()
        closed.acquire()

    copy = Forked(work)
    assert copy.receive() == b"begun"
    assert copy.receive() is None
    copy.close()


def test_where_no_process_can_be_made_it_is_computed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> int:
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(forked, "is_core_free", lambda: True)
    monkeypatch.setattr(forked.os, "fork", full)
    begun = Begun(lambda: 1, lambda: 2)
    assert (begun(), begun()) == (1, 2)


def test_a_copy_that_is_gone_already_is_no_error() -> None:
    """As in a service that was started with SIGCHLD ignored."""
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        copy = Forked(lambda send: send(b"done"))
        assert copy.receive() == b"done" and copy.receive() is None
        copy.close()
    finally:
        signal.signal(signal.SIGCHLD, before)
