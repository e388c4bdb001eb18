"""Gravity direction."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from fusion.estimation import TINY
from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class Gravity:
    """Which way gravity points at a moment.

    Attributes
    ----------
    stamp_s
        The moment.
    down
        (3,) unit vector, base frame.
    sigma_rad
        Standard deviation of its worse axis.
    """

    stamp_s: float
    down: FloatArray
    sigma_rad: float


def upright_of(down: FloatArray) -> gtsam.Rot3:
    """The smallest rotation that makes a unit vector (3,) point down."""
    axis = np.cross(down, [0.0, 0.0, -1.0])
    sine, cosine = float(np.linalg.norm(axis)), -float(down[2])
    if sine < TINY:
        return gtsam.Rot3() if cosine > 0.0 else gtsam.Rot3.Roll(np.pi)
    return gtsam.Rot3.Expmap(axis / sine * np.arctan2(sine, cosine))
