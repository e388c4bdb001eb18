"""Changes a home between two days: some furniture is moved, removed or added."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slam.measurements import FloatArray
from slam.simulation.floor_layout import RoomPlan
from slam.simulation.furnishing import OF_ROOMS, place_once_more
from slam.simulation.home_model import Rearrangement, Thing

# Equally likely entries: moved twice as often as removed or added.
_WAYS = ("moved", "moved", "went", "appeared")
_TRIES = 8
# A shorter motion does not count.
_LEAST_M = 0.3


def rearrange(
    plans: Sequence[RoomPlan],
    furnished: Sequence[Sequence[Thing]],
    count: int,
    rng: np.random.Generator,
) -> tuple[list[list[Thing]], list[Rearrangement]]:
    """Move, remove or add a number of pieces of furniture, each once.

    Parameters
    ----------
    plans, furnished
        The rooms, and the movable furniture of each.

    Returns
    -------
    The furniture of each room afterwards, and the changes: fewer than requested if nothing else fits.
    """
    after = [list(pieces) for pieces in furnished]
    rest = [(room, piece) for room, pieces in enumerate(furnished) for piece in pieces if piece.kind != "rug"]
    changes: list[Rearrangement] = []
    for _ in range(_TRIES * count):
        if len(changes) == count or not rest:
            break
        room, before = rest[int(rng.integers(len(rest)))]
        plan, change = plans[room], str(rng.choice(_WAYS))
        if change == "appeared":
            kinds, at_wall = OF_ROOMS[plan.purpose][wall := int(rng.integers(2))], wall == 0
            new = place_once_more(plan, after[room], kinds[int(rng.integers(len(kinds)))](rng), rng, at_wall)
            if new is not None and new.kind != "rug":
                after[room].append(new)
                changes.append(Rearrangement(None, new))
            continue
        others = [piece for piece in after[room] if piece is not before]
        new = None
        if change == "moved":
            free = {piece.__name__ for piece in OF_ROOMS[plan.purpose][1]}
            new = place_once_more(plan, others, _by_itself(before), rng, before.kind not in free)
            if new is None or math.dist(_middle(before), _middle(new)) < _LEAST_M:
                continue
        rest.remove((room, before))
        after[room] = [*others, new] if new is not None else others
        changes.append(Rearrangement(before, new))
    return after, changes


def _middle(thing: Thing) -> FloatArray:
    """(2,) centre of the bounding box of a piece."""
    corners = np.concatenate([part.corners_xy() for part in thing.parts])
    return np.asarray(0.5 * (corners.min(axis=0) + corners.max(axis=0)))


def _by_itself(thing: Thing) -> Thing:
    """A piece in its own frame: origin in the middle of its back, x to its right."""
    yaw = thing.parts[0].yaw_rad
    upright = [part.placed(0.0, 0.0, -yaw) for part in thing.parts]
    corners = np.concatenate([part.corners_xy() for part in upright])
    low, high = corners.min(axis=0), corners.max(axis=0)
    return Thing(thing.kind, tuple(part.placed(-0.5 * (low[0] + high[0]), -low[1], 0.0) for part in upright))
