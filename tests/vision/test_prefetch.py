"""Results made ahead: in order, bounded, and without a thread left behind."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator

import pytest

from slam.vision.prefetch import prefetched


def preparers() -> int:
    # A command that an earlier test has interrupted lies in a cycle with its threads, frozen as commands end.
    gc.unfreeze()
    gc.collect()
    return sum(thread.name.startswith("prepare") for thread in threading.enumerate())


def test_results_come_in_order_from_one_other_thread() -> None:
    names = set()

    def square(item: int) -> int:
        names.add(threading.current_thread().name)
        return item * item

    assert list(prefetched(range(50), square)) == [n * n for n in range(50)]
    assert len(names) == 1
    assert threading.current_thread().name not in names
    assert list(prefetched([], abs)) == []
    assert preparers() == 0


@pytest.mark.parametrize("ahead", [0, 1, 4])
def test_no_more_is_taken_than_is_needed_soon(ahead: int) -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        while True:
            taken += 1
            yield taken

    results = prefetched(items(), lambda item: item, ahead)
    assert [next(results) for _ in range(5)] == [1, 2, 3, 4, 5]
    assert taken <= 5 + ahead
    del results
    assert preparers() == 0


def test_an_error_comes_at_its_place() -> None:
    results = prefetched([1, 1, 0, 1], lambda item: 1 // item)
    assert [next(results), next(results)] == [1, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert preparers() == 0


def test_several_threads_keep_the_order() -> None:
    begun = threading.Event()

    def late_if_first(item: int) -> int:
        if item == 0:
            assert begun.wait(10.0)  # only another thread can say that it has begun
        begun.set() if item == 1 else None
        return item

    assert list(prefetched(range(20), late_if_first, 4, threads=2)) == list(range(20))
    assert preparers() == 0
