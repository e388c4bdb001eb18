"""Usual speed of a robot, from its wheel odometry."""

from __future__ import annotations

import math

from fusion.estimation import FEWEST


class UsualSpeed:
    """The speed that 95 % of the moving readings do not exceed.

    Parameters
    ----------
    greatest, least
        Largest speed of any robot, and least speed of motion, metres or radians per second.

    Examples
    --------
    >>> from slam.odometry.usual_speed import UsualSpeed
    >>> usual = UsualSpeed(5.0, 0.05)
    >>> for _ in range(200):
    ...     usual.add(0.42)
    >>> usual.add(4.6)  # a jump
    >>> round(usual.most, 2), usual.exceeded_by(1.2), usual.exceeded_by(4.6)
    (0.45, False, True)
    """

    def __init__(self, greatest: float, least: float) -> None:
        self._width, self._greatest, self._moved = least, int(greatest / least), 0
        self._counts = [0] * (self._greatest + 1)
        # A bin of the histogram, and the number of readings above it.
        self._top, self._faster = self._greatest, 0

    def add(self, speed: float) -> None:
        """Add the speed of the next reading."""
        step = min(int(speed / self._width), self._greatest)
        if not step:
            return
        self._moved += 1
        self._counts[step] += 1
        self._faster += step > self._top
        while self._faster * FEWEST > self._moved:
            self._top += 1
            self._faster -= self._counts[self._top]
        while (self._faster + self._counts[self._top]) * FEWEST <= self._moved:
            self._faster += self._counts[self._top]
            self._top -= 1

    @property
    def most(self) -> float:
        """Return the speed; infinite before ten readings exceed it, or at the limit of any robot."""
        known = self._moved >= 10 * FEWEST and self._top < self._greatest
        return (self._top + 1) * self._width if known else math.inf

    def exceeded_by(self, speed: float) -> bool:
        """Return whether a speed is more than three times as fast."""
        return speed > 3.0 * self.most
