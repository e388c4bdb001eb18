"""Every setting that exists changes what a run comes to: none is forgotten, and none is read in vain.

Each is changed in a tiny run that has something to decide by it (`setting_runs`), up to the first answer that
differs. A new setting fails here until it reaches something.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from typing import Any, Literal, get_args, get_origin

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from setting_runs import BASES, RUNS, Course, differs

from slam.config import Config, load_config

# The run that has something to decide by the settings of a section, and the settings that want another.
RUN_OF_SECTION = {
    **dict.fromkeys(("scan", "match", "prediction", "wheels"), "planar"),
    **dict.fromkeys(("keyframes", "loops", "graph", "grid"), "planar"),
    **dict.fromkeys(("sensors", "fusion", "layers"), "fused"),
    **dict.fromkeys(("", "rgbd", "rgbd_odometry", "visual_loops"), "spatial"),
    **dict.fromkeys(("cloud_odometry", "cloud_map"), "first_clouds"),
    "cloud_loops": "clouds",
    "dense_map": "files",
    "localization": "in_plan",
    "cloud_localization": "in_room",
}
RUN_OF = {
    "match.lost_after": "spatial",
    "match.degenerate_sigma_m": "spatial",
    "loops.by_appearance": "spatial",
    "loops.least_overlap": "spatial",
    "sensors.topics": "from_a_file",
    "sensors.calibration_files": "from_a_file",
    "sensors.imu": "with_imu",
    "sensors.doctor": "planar",
    "sensors.tags": "planar",
    "sensors.calibration": "planar",
    "visual_loops.least_features": "frames_alone",
}
# What else must be set for a setting to matter.
BESIDE: dict[str, tuple[str, ...]] = {
    "match.search_half_yaw_rad": ("match.confident_inlier_share=1.0",),
    "match.search_points": ("match.confident_inlier_share=1.0",),
    "match.search_least_score": ("match.confident_inlier_share=1.0",),
    "loops.near": ("loops.least_path_m=1",),
    "sensors.doctor": ("sensors.calibration={wheels: {odometry: {heading_scale: -1.0}}}",),
    "prediction.disputed_within": (
        "wheels.floor_m=0.0001",
        "wheels.distance_share=0.0",
        "wheels.swing_m_per_rad=0.0",
    ),
    "cloud_odometry.keyframe_voxels": ("keyframes.angle_rad=3",),
    "cloud_loops.greatest_residual_ratio": ("match.minimal_residual_m=0.001",),
    "localization.keyframe_rad": ("localization.keyframe_m=5",),
    "localization.search_every_m": ("localization.confident_probability=0.999",),
    "localization.lost_after_s": ("localization.dead_reckoning_m=100", "localization.keyframe_m=0.05"),
    "graph.loose_share": ("match.confident_inlier_share=1.0",),
    "rgbd_odometry.keyframe_parallax": (
        "keyframes.angle_rad=3",
        "rgbd_odometry.keyframe_overlap=0.01",
    ),
    "rgbd_odometry.keyframe_overlap": ("keyframes.angle_rad=3",),
    "cloud_odometry.scale_share": ("cloud_odometry.voxel_m=null",),
    "cloud_odometry.least_voxel_m": ("cloud_odometry.voxel_m=null",),
    "cloud_odometry.greatest_voxel_m": ("cloud_odometry.voxel_m=null",),
    "cloud_loops.greatest_dissimilarity": ("loops.near=0",),
}
# Values that matter in a run so small, where four times the default does not.
VALUES: dict[str, Any] = {
    "localization.search_every_m": 0.05,
    "match.local_map_keyframes": 5,
    "match.search_half_yaw_rad": 0.01,
    "match.search_points": 20,
    "match.search_least_score": 0.99,
    "match.lost_after": 2,
    "loops.near": 1,
    "loops.by_appearance": 0,
    "loops.least_overlap": 1.0,
    "seed": 1,
    "sensors.motion": "spatial",
    "rgbd.registration": "auto",
    "match.confident_inlier_share": 0.01,
    "prediction.velocity_share": 0.0,
    "prediction.disputed_within": 1000.0,
    "prediction.memory_scans": 3.0,
    "keyframes.angle_rad": 0.05,
    "localization.confident_probability": 0.999,
    "cloud_localization.reach_voxels": 2.0,
    "cloud_localization.new_share": 0.01,
    "visual_loops.least_features": 100,
    "sensors.topics": ["/scan"],
    "sensors.calibration_files": ["nowhere.yaml"],
    "sensors.calibration": {"wheels": {"odometry": {"scale": 3.0}}},
    "sensors.tags": {
        "surveyed": [
            {"stamp_s": 100.0 + n, "at_m": place} for n, place in ((1, [0, 0]), (6, [2, 1]), (9, [3, -1]))
        ]
    },
    "scan.range_min_m": 1.5,
    "scan.range_max_m": 2.0,
    "wheels.swing_m_per_rad": 5.0,
    "wheels.greatest_speed_m_s": 0.01,
    "loops.inlier_probability": 0.001,
    "grid.hit_probability": 0.9,
    "grid.miss_probability": 0.3,
    "grid.clear_range_m": 1.0,
    "grid.greatest_cells": 1,
    "fusion.tolerance_s": 0.001,
    "layers.depth_max_m": 1.5,
    "rgbd.working_width": 80,
    "rgbd.farthest_m": 1.5,
    "rgbd_odometry.views": 1,
    "rgbd_odometry.guided_radius": 0.01,
    "cloud_odometry.voxel_m": 0.5,
    "cloud_odometry.range_min_m": 1.6,
    "cloud_odometry.range_max_m": 4.0,
    "cloud_odometry.keyframe_voxels": 0.5,
    "cloud_odometry.least_pairs": 3000,
    "cloud_odometry.greatest_voxel_m": 0.15,
    "cloud_loops.reach_voxels": 12.0,
    "cloud_loops.greatest_dissimilarity": 1.0,
    "cloud_loops.greatest_residual_ratio": 40.0,
    "cloud_map.plan_range_m": 3.0,
    "localization.search_least_score": 0.9,
    "localization.search_keep_share": 0.2,
    "localization.keyframe_rad": 0.05,
    "localization.window_m": 0.5,
    "localization.gate_sigmas": 0.1,
    "localization.dead_reckoning_m": 0.01,
    "localization.hypotheses": 1,
    "localization.least_inlier_share": 0.98,
}


def settings() -> Iterator[tuple[str, FieldInfo]]:
    """Dotted name and field of every setting."""
    for name, field in Config.model_fields.items():
        section = field.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            yield from ((f"{name}.{key}", inner) for key, inner in section.model_fields.items())
        else:
            yield name, field


@cache
def baseline(run: str, settings: tuple[str, ...]) -> Course:
    """What a run comes to as it is."""
    course = Course()
    RUNS[run](load_config(None, settings), course)
    return course


def other_value(name: str, field: FieldInfo) -> Any:
    """Another value than the default."""
    if name in VALUES:
        return VALUES[name]
    default = field.default
    if isinstance(default, bool):
        return not default
    if get_origin(field.annotation) is Literal:
        return next(value for value in get_args(field.annotation) if value != default)
    most = min((getattr(limit, "le", getattr(limit, "lt", 1e9)) for limit in field.metadata), default=1e9)
    return type(default)(min(4 * default, most))


@pytest.mark.parametrize(("name", "field"), [pytest.param(*pair, id=pair[0]) for pair in settings()])
def test_every_setting_reaches_something(name: str, field: FieldInfo) -> None:
    section = name.rpartition(".")[0]
    assert section in RUN_OF_SECTION, "say which run has something to decide by this section"
    run = RUN_OF.get(name, RUN_OF_SECTION[section])
    base = (*BASES.get(run, ()), *BESIDE.get(name, ()))
    changed = load_config(None, [*base, f"{name}={json.dumps(other_value(name, field))}"])
    assert changed != load_config(None, base)
    assert differs(RUNS[run], changed, baseline(run, base)), "it changes nothing that this run comes to"
