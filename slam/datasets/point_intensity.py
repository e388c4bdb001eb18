"""How strongly each point of a cloud sent the beam back, whatever the driver called it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.measurements import Float32Array

# Drivers, PCL, CloudCompare; a reflectivity is one whose range is reckoned out.
_NAMES = "intensity", "intensities", "i", "scalar_intensity", "reflectivity", "reflectance", "remission"


def intensities_of(names: Iterable[str], column: Callable[[str], NDArray[Any]]) -> Float32Array | None:
    """(N,) in the sensor's own steps; None where the cloud does not tell them, or nothing but zeros.

    Parameters
    ----------
    names
        The fields of its points.
    column
        The values of a field, (N,).
    """
    own = {name.lower(): name for name in names}
    found = next((own[name] for name in _NAMES if name in own), None)
    values = np.zeros(0) if found is None else column(found)
    with np.errstate(invalid="ignore", over="ignore"):
        return values.astype(np.float32) if values.any() else None
