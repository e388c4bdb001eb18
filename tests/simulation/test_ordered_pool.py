"""Threads that write: order with one, errors reported, memory bounded."""

from __future__ import annotations

import threading

import pytest

from slam.simulation.ordered_pool import OrderedPool


def test_one_worker_keeps_the_order() -> None:
    done: list[int] = []
    with OrderedPool(1, 3) as pool:
        for number in range(50):
            pool.submit(done.append, number)
    assert done == list(range(50))


def fail() -> None:
    raise OSError("disk full")


def test_an_error_comes_out_at_the_next_job_or_at_the_end() -> None:
    with pytest.raises(OSError, match="disk full"), OrderedPool(1, 2) as pool:
        pool.submit(fail)
    with pytest.raises(OSError, match="disk full"), OrderedPool(1, 1) as pool:
        pool.submit(fail)
        pool.submit(list)
        pytest.fail("the second job was taken")


def test_what_waits_is_bounded() -> None:
    gate, began = threading.Event(), []
    with OrderedPool(1, 2) as pool:
        pool.submit(gate.wait)  # type: ignore[arg-type]
        pool.submit(began.append, 1)
        threading.Timer(0.05, gate.set).start()
        pool.submit(began.append, 2)  # waits until the first is done
        assert gate.is_set()
    assert began == [1, 2]


def test_after_an_error_what_has_not_begun_is_dropped() -> None:
    gate, began = threading.Event(), []
    with pytest.raises(KeyError), OrderedPool(1, 5) as pool:
        pool.submit(gate.wait)  # type: ignore[arg-type]
        pool.submit(began.append, 1)
        threading.Timer(0.05, gate.set).start()
        raise KeyError("interrupted")
    assert began == []
