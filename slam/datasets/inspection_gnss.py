"""What the fixes of one satellite receiver hold."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam.datasets.dataset import Thinned
from slam.earth import TangentPlane
from slam.measurements import GnssFix


@dataclass(slots=True)
class GnssFigures:
    """Running figures of one receiver."""

    plane: TangentPlane | None = None
    farthest_m: float = 0.0
    sigmas_m: Thinned = field(default_factory=Thinned)
    last: GnssFix | None = None

    def add(self, fix: GnssFix) -> None:
        """One more fix."""
        place = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
        self.plane = self.plane or TangentPlane(*place)
        self.farthest_m = max(self.farthest_m, float(np.hypot(*self.plane.enu_m(*place)[:2])))
        if fix.covariance_m2 is not None:
            self.sigmas_m.add(math.sqrt(0.5 * float(np.trace(fix.covariance_m2[:2, :2]))))
        self.last = fix

    def facts(self) -> dict[str, Any] | None:
        """The first place, how far the others are from it, the median sigma across; None before the first."""
        if self.plane is None or self.last is None:
            return None
        antenna_m = self.last.antenna_m
        return {
            "first": [self.plane.latitude_deg, self.plane.longitude_deg, self.plane.altitude_m],
            "farthest_m": self.farthest_m,
            "median_sigma_m": self.sigmas_m.median(),
            "antenna_m": None if antenna_m is None else antenna_m.tolist(),
        }
