"""Checks of arguments: one line that names the argument, instead of an error inside a kernel."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


def numbers(value: Any, shape: tuple[int | None, ...], name: str, *, finite: bool = True) -> NDArray[Any]:
    """Return real numbers as an array of a shape; None is any length.

    Raises
    ------
    ValueError
        If they are not numbers, have another shape, or are not finite.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    fits = len(shape) == array.ndim and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    real = array.dtype.kind in "iuf"
    if real and fits:
        bad = np.count_nonzero(~np.isfinite(array)) if finite else 0
        if not bad:
            return array
        raise ValueError(f"{name}: {bad} of {array.size} numbers are not finite; leave them out")
    actual = f"{array.dtype}{list(array.shape)}" if array.ndim else " ".join(f"{value!r:.60}".split())
    expected = f" of shape ({', '.join('N' if n is None else str(n) for n in shape)})" if shape else ""
    raise ValueError(f"{name} is {actual}; give numbers{expected}")


def instance(value: Any, kinds: type[T] | tuple[type[T], ...], name: str) -> T:
    """Return a value of one of these types, or raise a ValueError that names them."""
    if not isinstance(value, kinds):
        expected = " or ".join(kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
        raise ValueError(f"{name} is {type(value).__name__}; give {expected}")
    return value
