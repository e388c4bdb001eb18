"""What a person has decided of a map, as the page shows it."""

from __future__ import annotations

from typing import Any

from slam.storage.map_contents import MapContents
from slam.storage.map_edits import regions_of

_KINDS = ("erase", "keep_out", "slow", "crop", "place")


def applied_data(found: MapContents) -> dict[str, Any]:
    """The texts of the edits, and their zones and places where they are now: points in the map."""
    regions = [
        {
            "kind": kind,
            "name": region.name,
            "points": region.points(found.keyframe_poses).round(3).tolist(),
        }
        for kind in _KINDS
        for region in regions_of(found.edits, kind)
    ]
    return {"texts": [entry.text for entry in found.edits], "regions": regions}
