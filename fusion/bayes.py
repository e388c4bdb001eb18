"""Bayesian fusion of two occupancy grids: Li2020 Eq. (7)-(10), Table 3, and a more cautious rule.

Evidence is stored as log-odds, log(p / (1 - p)). In this form Eq. (8) and Eq. (10) are sums, so their order
does not matter. 0 is unknown.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

States: TypeAlias = NDArray[np.int8]
Rule: TypeAlias = Literal["cautious", "corrected", "printed"]
RULES: tuple[Rule, ...] = ("cautious", "corrected", "printed")


class _State(IntEnum):
    """Values of nav2's occupancy grid."""

    OCCUPIED = 100
    FREE = 0
    UNKNOWN = -1


OCCUPIED, FREE, UNKNOWN = (int(state) for state in _State)

# A step of evidence: sums of whole steps are exact, and the same in any order.
STEPS_A_UNIT = 1024

# Rows are the lidar's states, columns the camera's, both in the order occupied, empty, uncertain.
_RULES: dict[Rule, States] = {
    # Not in Li2020: if only the lidar sees a cell as empty, it is unknown below and above the lidar.
    "cautious": np.array(
        [[OCCUPIED, OCCUPIED, OCCUPIED], [OCCUPIED, FREE, UNKNOWN], [OCCUPIED, FREE, UNKNOWN]], dtype=np.int8
    ),
    # The last row is printed in reverse order, which contradicts Li2020's own Fig. 13.
    "corrected": np.array(
        [[OCCUPIED, OCCUPIED, OCCUPIED], [OCCUPIED, FREE, FREE], [OCCUPIED, FREE, UNKNOWN]], dtype=np.int8
    ),
    "printed": np.array(
        [[OCCUPIED, OCCUPIED, OCCUPIED], [OCCUPIED, FREE, FREE], [FREE, OCCUPIED, UNKNOWN]], dtype=np.int8
    ),
}


def log_odds(probability: float) -> float:
    """Return log(p / (1 - p)).

    Raises
    ------
    ValueError
        If the probability is not above 0 and below 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability is {probability}; it must be above 0 and below 1")
    return math.log(probability / (1.0 - probability))


def evidence_steps(probability: float) -> int:
    """Return log-odds in steps of 1 / `STEPS_A_UNIT`; zero only if the probability is exactly one half."""
    steps = round(log_odds(probability) * STEPS_A_UNIT)
    if steps == 0 and probability != 0.5:
        return int(math.copysign(1, probability - 0.5))
    return steps


def decide(lidar: States, camera: States, rule: Rule = "corrected") -> States:
    """Decide what the robot must not hit, from the decision of each sensor (Li2020 Table 3).

    Table 3 and Eq. (10) differ if one sensor sees an object and the other looks over it: 0.9 and 0.1 fuse to
    0.5, but a low box remains an obstacle.

    Parameters
    ----------
    lidar, camera
        `OCCUPIED`, `FREE` or `UNKNOWN`, with the same shape. A missing sensor is unknown everywhere.
    rule
        ``corrected``, or ``printed`` as in the paper, with the last row exchanged. In Li2020 the lidar frees
        cells that the camera did not see. ``cautious`` leaves them unknown, since a lidar sees only one
        height, and otherwise is as ``corrected``. It is for maps made with a camera.

    Raises
    ------
    ValueError
        If the rule has another name.
    """
    if rule not in _RULES:
        raise ValueError(f"rule is {rule!r}; it must be {', '.join(RULES[:-1])} or {RULES[-1]}")
    decided: States = _RULES[rule][_index(lidar), _index(camera)]
    return decided


def _index(states: States) -> NDArray[np.intp]:
    """Row or column of Table 3: 0 occupied, 1 empty, 2 uncertain."""
    return np.where(states == OCCUPIED, 0, np.where(states == FREE, 1, 2)).astype(np.intp)
