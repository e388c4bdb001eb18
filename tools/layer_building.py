"""The layers of keyframes at known poses, in one pass."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from slam.config import Config
from slam.errors import ScanweaveError
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.layer_builder import LayerBuilder, LayerSettings, Reading
from slam.mapping.layered_map import DecisionRule, LayeredMap
from slam.measurements import Pose


def build_layers(
    keyframes: Iterable[Reading],
    poses: Sequence[Pose],
    settings: LayerSettings | None = None,
    rule: DecisionRule = DecisionRule(),  # noqa: B008
) -> LayeredMap:
    """Build the layers in one pass over keyframes at known poses; their order changes nothing.

    Parameters
    ----------
    keyframes
        Scans and depth images, mixed as they come; one is in memory at a time.
    poses
        ``T_map_base`` of each, in the same order.

    Raises
    ------
    ScanweaveError
        Where there are more or fewer poses than keyframes, and as `LayerBuilder.add`.
    """
    builder = LayerBuilder(settings or replace(layer_settings(Config()), robot_radius_m=0.0))
    count = 0
    for count, reading in enumerate(keyframes, start=1):
        if count > len(poses):
            raise ScanweaveError(f"more keyframes than their {len(poses)} poses; give one pose a keyframe")
        builder.add(reading, poses[count - 1])
    if count < len(poses):
        raise ScanweaveError(f"{count} keyframes for {len(poses)} poses; give one pose a keyframe")
    return LayeredMap(builder.grid("lidar"), builder.grid("depth"), rule)
