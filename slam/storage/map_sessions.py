"""The logs of a map, in the order in which they were joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from slam.errors import MapFileError

SESSIONS: Final = "sessions"


@dataclass(frozen=True, slots=True)
class MapSession:
    """One log in a map.

    Attributes
    ----------
    log_name, log_fingerprint
        As in `slam.storage.map_identity.MapIdentity`.
    keyframes, poses
        Number of its keyframes and poses in the map; they follow those of the earlier sessions.
    """

    log_name: str
    log_fingerprint: str
    keyframes: Annotated[int, Field(gt=0)]
    poses: Annotated[int, Field(gt=0)]


def session_numbers(sessions: Sequence[MapSession]) -> NDArray[np.int64]:
    """Return (K,) the session number, from 0, of each keyframe of a map."""
    return np.repeat(np.arange(len(sessions)), [session.keyframes for session in sessions])


def sessions_of(meta: Mapping[str, str], keyframes: int, poses: int) -> list[MapSession]:
    """Return the sessions of a map with these numbers of keyframes and poses; not stored for a single log.

    Raises
    ------
    MapFileError
        If they are stored, but their numbers do not match the map.
    """
    if SESSIONS not in meta:
        return [MapSession(meta["log_name"], meta["log_fingerprint"], keyframes, poses)]
    try:
        sessions = TypeAdapter(list[MapSession]).validate_json(meta[SESSIONS], strict=True)
    except ValidationError as error:
        why = error.errors()[0]["msg"]
        raise MapFileError(f"the map's sessions cannot be read ({why}); make the map anew") from error
    totals = (sum(part.keyframes for part in sessions), sum(part.poses for part in sessions))
    if totals != (keyframes, poses):
        raise MapFileError(
            f"the map's sessions have {totals[0]} keyframes and {totals[1]} poses, it holds {keyframes} and "
            f"{poses}; make the map anew"
        )
    return sessions
