"""A few threads that write while the drive continues, with a limit of pending jobs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import ParamSpec, Self

P = ParamSpec("P")


class OrderedPool:
    """Jobs for threads; `submit` waits for the oldest job if too many are pending, and raises its error.

    Parameters
    ----------
    workers
        Number of threads. With one, jobs are done in order.
    pending
        Maximum number of jobs that wait or run.
    """

    def __init__(self, workers: int, pending: int) -> None:
        self._executor = ThreadPoolExecutor(workers)
        self._limit = pending
        self._jobs: deque[Future[None]] = deque()

    def submit(self, job: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
        """Queue a job; an error of an earlier one is raised here."""
        while len(self._jobs) >= self._limit:
            self._jobs.popleft().result()
        self._jobs.append(self._executor.submit(job, *args, **kwargs))

    def finish(self) -> None:
        """Wait for all jobs; raises the first error."""
        while self._jobs:
            self._jobs.popleft().result()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish after success; after an error, drop jobs that have not started."""
        try:
            if kind is None:
                self.finish()
        finally:
            self._executor.shutdown(wait=True, cancel_futures=True)
