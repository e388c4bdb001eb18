"""Results that take time to compute: they are computed, or read from an interrupted run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol, TypeVar

T = TypeVar("T")


class ResultCache(Protocol):
    """Asked for everything that takes time while a log is mapped, in an order that the log alone decides."""

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """The answer to a question.

        Parameters
        ----------
        key
            A number of what is asked about; one bit of difference shows that events took another course.
        compute
            Gives the answer; it must not change anything that a later answer depends on.
        """
        ...


class _Computed:
    """Nothing is remembered."""

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """Compute it."""
        return compute()


COMPUTED: Final[ResultCache] = _Computed()
