"""Work done a few items ahead on one thread, in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

AHEAD = 3


def map_ahead(
    work: Callable[[_Item], _Result], items: Iterable[_Item], ahead: int = AHEAD
) -> Iterator[_Result]:
    """``map(work, items)`` with the next ``ahead`` results being made while one is used.

    ``work`` runs on one thread, which ends with the iteration: at its end, at an error, when the iterator
    is closed or forgotten. At most ``ahead + 1`` results are held.

    Raises
    ------
    Exception
        What ``work`` raised, at its place in the order.
    """
    items = iter(items)
    pool = ThreadPoolExecutor(1, "read-ahead")
    try:
        pending: deque[Future[_Result]] = deque(pool.submit(work, item) for item in islice(items, ahead))
        while pending:
            result = pending.popleft().result()
            pending.extend(pool.submit(work, item) for item in islice(items, 1))
            yield result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
