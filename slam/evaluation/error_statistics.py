"""Statistics that are reported for every list of errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of non-negative errors, in the unit of the errors; ``std`` is that of the population."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorStatistics:
        """Compute the statistics of (N,) errors, N >= 1."""
        return cls(
            rmse=float(np.sqrt(np.mean(np.square(errors)))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
        )
