"""Which settings a saved map can still follow, and which were decided when its log was read."""

from __future__ import annotations

from collections.abc import Sequence

from slam.config import Config, leaves, with_settings
from slam.errors import ConfigError

# What is drawn and written of keyframes, and what only later commands ask for.
_FREE = ("grid.", "layers.", "dense_map.", "cloud_map.", "localization.", "cloud_localization.")
# Of the graph: which loops count.
_LOOPS = frozenset({"loops.enabled", "loops.inlier_probability", "loops.least_inlier_share"})
_FUSION = "fusion.enabled"


def remade_config(config: Config, settings: Sequence[str]) -> Config:
    """The settings of a map that is made anew with others.

    Raises
    ------
    ConfigError
        For an unknown key, a bad value, or a setting that only the log could follow.
    """
    changed = with_settings(config, settings)
    before, after = (dict(leaves(one.model_dump(mode="json"))) for one in (config, changed))
    for name in sorted({*before, *after}):
        if before.get(name) == after.get(name) or name.startswith(_FREE) or name in _LOOPS:
            continue
        if name == _FUSION and not after[name]:
            continue
        why = (
            "the map holds what each keyframe saw, not the images that repaired it"
            if name.startswith("fusion.")
            else "it was decided when the log was read"
        )
        raise ConfigError(
            f"{name} = {after.get(name)} takes the log: {why}; "
            f"'scanweave map LOG -s {name}={after.get(name)}'"
        )
    return changed
