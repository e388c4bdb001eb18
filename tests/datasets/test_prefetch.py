"""Reading ahead: in order, bounded, and without a thread left behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from slam.datasets.prefetch import AHEAD, map_ahead


def readers() -> int:
    return sum(thread.name.startswith("read-ahead") for thread in threading.enumerate())


def test_results_come_in_order_from_one_other_thread() -> None:
    names = set()

    def work(item: int) -> int:
        names.add(threading.current_thread().name)
        return item * item

    assert list(map_ahead(work, range(50))) == [k * k for k in range(50)]
    assert len(names) == 1
    assert threading.current_thread().name not in names
    assert readers() == 0


def test_no_more_is_taken_than_is_needed_soon() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        while True:
            taken += 1
            yield taken

    results = map_ahead(lambda item: item, items())
    assert [next(results) for _ in range(5)] == [1, 2, 3, 4, 5]
    assert taken <= 5 + AHEAD
    del results
    assert readers() == 0


def test_an_error_comes_at_its_place() -> None:
    results = map_ahead(lambda item: 1 // item, [1, 1, 0, 1])
    assert [next(results), next(results)] == [1, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert readers() == 0
