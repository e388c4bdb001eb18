"""The unit in which an accelerometer tells its readings: metres a second squared, or gravities."""

from __future__ import annotations

import numpy as np

from slam.measurements import GRAVITY_M_S2, FloatArray


class ForceUnit:
    """Told by the first reading: a sensor that is carried or driven feels gravity and little more.

    Attributes
    ----------
    choice
        What was concluded, for people; empty where it is metres a second squared, as it should be.
    """

    def __init__(self) -> None:
        self.choice = ""
        self._scale: float | None = None

    def m_s2(self, force: FloatArray) -> FloatArray:
        """A specific force (3,) as written, in metres a second squared."""
        if self._scale is None:
            # Halfway between one and gravity, as factors go.
            in_g = float(np.linalg.norm(force)) < np.sqrt(GRAVITY_M_S2)
            self._scale = GRAVITY_M_S2 if in_g else 1.0
            self.choice = "accelerations are in g, not m/s^2; read as such" if in_g else ""
        return force * self._scale
