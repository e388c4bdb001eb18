"""Decode or prepare items in other threads while the previous item is used."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from slam.heap import give_back

Item = TypeVar("Item")
Prepared = TypeVar("Prepared")


def prefetched(
    items: Iterable[Item], prepare: Callable[[Item], Prepared], most_waiting: int = 3, threads: int = 1
) -> Iterator[Prepared]:
    """Yield results of ``prepare`` in item order, up to ``most_waiting`` of them computed in advance.

    The order, and with it every result, is that of a plain loop; with several ``threads`` no item may change
    what another depends on. An error of ``prepare`` surfaces where its item's turn comes.
    """
    waiting: deque[Future[Prepared]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="prepare") as pool:
        try:
            for number, item in enumerate(items, 1):
                if number % 100 == 0:  # else holes between what is kept fill up
                    give_back()
                waiting.append(pool.submit(prepare, item))
                if len(waiting) > most_waiting:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
