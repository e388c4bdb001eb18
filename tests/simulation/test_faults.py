"""Faults: each where its cause is, as often as its preset says, and always in the mask."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.errors import ConfigError
from slam.simulation.fault_kernels import depth_edges, stereo_shadow
from slam.simulation.faults import NO_FAULTS, Fault, FaultConfig, FaultyReadings, Surfaces, corrupt
from slam.simulation.home_model import Material, Part, Thing, assemble
from slam.simulation.rigs import camera_pose
from slam.simulation.scene import Scene
from slam.simulation.sensor_models import HOKUYO_URG_04LX, KINECT_V1
from slam.simulation.sensors import render_rgbd, scan_lidar

SHAPE = (200, 300)
HOLES = [fault for fault in Fault if fault.name.startswith("HOLE")]


def wall(distance_m: float = 2.0, material: Material = Material.MATTE, **changes: np.ndarray) -> Surfaces:
    """A flat wall; changes replace whole arrays."""
    flat = Surfaces(
        distance_m=np.full(SHAPE, distance_m, dtype=np.float32),
        behind_m=np.full(SHAPE, distance_m, dtype=np.float32),
        material=np.full(SHAPE, material, dtype=np.uint8),
        cos_incidence=np.ones(SHAPE, dtype=np.float32),
        face=np.zeros(SHAPE, dtype=np.int32),
        person=np.zeros(SHAPE, dtype=bool),
    )
    return replace(flat, **changes)


def run(surfaces: Surfaces, config: FaultConfig, seed: int = 0) -> FaultyReadings:
    found = corrupt(surfaces, config, 0.5, 5.0, np.random.default_rng(seed))
    # The law of the mask: a hole is a nan, and what has no fault is the truth.
    np.testing.assert_array_equal(np.isnan(found.distance_m), np.isin(found.fault, HOLES))
    sound = np.isin(found.fault, [Fault.NONE, Fault.PERSON])
    np.testing.assert_array_equal(found.distance_m[sound], surfaces.distance_m[sound])
    return found


def share(found: FaultyReadings, fault: Fault, where: np.ndarray | None = None) -> float:
    mask = found.fault == fault
    return float(mask.mean() if where is None else mask[where].mean())


def step_edge(near_m: float = 1.0, far_m: float = 3.0, at: int = 150) -> Surfaces:
    distance = np.full(SHAPE, near_m, dtype=np.float32)
    distance[:, at:] = far_m
    face = np.zeros(SHAPE, dtype=np.int32)
    face[:, at:] = 1
    return replace(wall(), distance_m=distance, behind_m=distance.copy(), face=face)


def test_without_faults_all_is_true() -> None:
    assert not run(wall(), NO_FAULTS).fault.any()


@pytest.mark.parametrize("value", [0.002, 0.05, 0.5])
def test_random_holes_have_their_share(value: float) -> None:
    found = run(wall(), FaultConfig(random_hole_share=value))
    assert share(found, Fault.HOLE_RANDOM) == pytest.approx(
        value, abs=4.0 * (value / found.fault.size) ** 0.5
    )


@pytest.mark.parametrize("value", [0.1, 0.6])
def test_burrs_have_their_share_and_fly_between(value: float) -> None:
    found = run(step_edge(), FaultConfig(edge_burr_share=value))
    beside = np.zeros(SHAPE, dtype=bool)
    beside[:, 149:151] = True
    assert not (found.fault[~beside] == Fault.BURR_EDGE).any()
    assert share(found, Fault.BURR_EDGE, beside) == pytest.approx(value, abs=4.0 * (value / 400) ** 0.5)
    flying = found.distance_m[found.fault == Fault.BURR_EDGE]
    assert flying.min() > 1.1 and flying.max() < 2.9
    assert flying.std() > 0.3


def test_a_slanted_wall_and_a_small_step_are_no_edges() -> None:
    ramp = np.broadcast_to(np.linspace(0.5, 90.0, 300, dtype=np.float32), SHAPE).copy()
    edge, _, _ = depth_edges(ramp, np.zeros(SHAPE, dtype=np.int32), 0.1, 0.03)
    assert not edge.any()
    faces = np.broadcast_to(np.arange(300, dtype=np.int32), SHAPE).copy()
    edge, fore, back = depth_edges(ramp, faces, 0.1, 0.03)
    assert edge.any() and (back[edge] > fore[edge]).all()
    assert not run(step_edge(1.0, 1.1), FaultConfig(edge_burr_share=1.0)).fault.any()


def test_nothing_is_no_background_of_a_burr() -> None:
    found = run(step_edge(1.0, np.inf), FaultConfig(edge_burr_share=1.0))
    assert share(found, Fault.BURR_EDGE) == 0.0
    assert share(found, Fault.HOLE_RANGE) == pytest.approx(0.5)


def test_out_of_range_is_a_hole() -> None:
    for distance in (0.4, 5.1):
        assert share(run(wall(distance), NO_FAULTS), Fault.HOLE_RANGE) == 1.0


def test_glass_mirrors_at_the_right_angle_only() -> None:
    cosine = np.ones(SHAPE, dtype=np.float32)
    cosine[:, 100:] = 0.9
    behind = np.full(SHAPE, 3.5, dtype=np.float32)
    behind[:, 250:] = 7.0
    pane = wall(2.0, Material.GLASS, cos_incidence=cosine, behind_m=behind)
    found = run(pane, FaultConfig(glass_mirror_cos=0.99, glass_hole_share=0.3))
    assert not found.fault[:, :100].any()
    middle = np.zeros(SHAPE, dtype=bool)
    middle[:, 100:250] = True
    assert share(found, Fault.HOLE_GLASS, middle) == pytest.approx(0.3, abs=0.02)
    through = found.fault == Fault.THROUGH_GLASS
    assert (found.distance_m[through] == 3.5).all()
    assert (through | (found.fault == Fault.HOLE_GLASS))[middle].all()
    assert (found.fault[:, 250:] == Fault.HOLE_GLASS).all()  # too far behind to be seen


def test_dark_surfaces_fade_with_distance_and_slant() -> None:
    config = FaultConfig(dark_range_m=4.0)
    expected = {1.5: 0.0, 2.5: 0.25, 3.0: 0.5, 3.5: 0.75, 4.5: 1.0}
    for distance, value in expected.items():
        found = run(wall(distance, Material.DARK), config)
        assert share(found, Fault.HOLE_DARK) == pytest.approx(value, abs=0.02)
    slanted = wall(2.0, Material.DARK, cos_incidence=np.full(SHAPE, 0.25, dtype=np.float32))
    assert share(run(slanted, config), Fault.HOLE_DARK) == pytest.approx(1.0)
    assert not run(wall(4.5), config).fault.any()


def test_grazing_light_is_lost() -> None:
    cosine = np.where(np.arange(300) < 150, 0.05, 0.5) * np.ones(SHAPE)
    found = run(
        wall(cos_incidence=cosine.astype(np.float32)), FaultConfig(grazing_cos=0.1, grazing_hole_share=0.6)
    )
    assert share(found, Fault.HOLE_GRAZING) == pytest.approx(0.3, abs=0.02)
    assert not found.fault[:, 150:].any()


def test_daylight_blinds_the_window_and_patches_around_it() -> None:
    material = np.zeros(SHAPE, dtype=np.uint8)
    material[80:120, 120:180] = Material.WINDOW
    config = FaultConfig(backlight_reach=24, backlight_hole_share=0.4, patch=8)
    found = run(replace(wall(), material=material), config)
    lost = found.fault == Fault.HOLE_BACKLIGHT
    assert lost[80:120, 120:180].all()
    assert not lost[:40].any() and not lost[:, :80].any()
    halo = lost[56:80, 120:180]
    assert 0.15 < halo.mean() < 0.65
    # Whole patches: neighbours share their fate far more often than chance would have it.
    assert (halo[:, 1:] == halo[:, :-1]).mean() > 0.85
    seen_through = run(replace(wall(), material=material), replace(config, backlight_reach=0))
    assert not (seen_through.fault == Fault.HOLE_BACKLIGHT).any()


def test_multipath_is_too_far_and_only_on_shiny_surfaces() -> None:
    config = FaultConfig(multipath_share=0.3, multipath_m=(0.1, 0.4))
    found = run(wall(2.0, Material.SHINY), config)
    assert share(found, Fault.BURR_MULTIPATH) == pytest.approx(0.3, abs=0.02)
    extra = found.distance_m[found.fault == Fault.BURR_MULTIPATH] - 2.0
    assert extra.min() > 0.0999 and extra.max() < 0.4001
    assert extra.mean() == pytest.approx(0.25, abs=0.01)
    assert not run(wall(), config).fault.any()


def test_the_shadow_is_as_wide_as_the_disparities_differ() -> None:
    surfaces = step_edge(3.0, 1.0)  # far on the left, near on the right
    hidden = stereo_shadow(surfaces.distance_m, 30.0)
    # 30 / 1 - 30 / 3 = 20 pixels of the background, left of the thing; the last one or two may be a slant.
    assert set(hidden.sum(axis=1)) == {18}
    assert hidden[:, 132:149].all() and not hidden[:, 150:].any()
    assert not stereo_shadow(step_edge(1.0, 3.0).distance_m, 30.0).any()


def test_a_person_is_marked_and_still_measured() -> None:
    person = np.zeros(SHAPE, dtype=bool)
    person[:, :50] = True
    found = run(wall(person=person), FaultConfig(random_hole_share=0.1))
    assert share(found, Fault.PERSON, person) == pytest.approx(0.9, abs=0.02)


def test_shares_and_patches_are_checked() -> None:
    with pytest.raises(ConfigError):
        FaultConfig(random_hole_share=1.2)
    with pytest.raises(ConfigError):
        FaultConfig(patch=0)


def test_presets_hold_on_a_wall_in_the_scene() -> None:
    """The share of holes in whole scans and images of a matte wall is that of the presets."""
    box = [Part((2.05, 0.0), (0.05, 3.0), -3.0, 5.0), Part((-1.0, 0.0), (0.05, 3.0), -3.0, 5.0)]
    scene = Scene(assemble([Thing("wall", (part,)) for part in box], [], [], (0.0, 0.0, 0.0)))
    rng = np.random.default_rng(0)
    image = render_rgbd(scene, camera_pose((0.0, 0.0, 0.5)), KINECT_V1, rng)
    value = KINECT_V1.faults.random_hole_share
    assert np.mean(image.depth_m == 0.0) == pytest.approx(value, rel=0.12)
    front = replace(HOKUYO_URG_04LX, beams=120, start_angle_rad=-0.5, step_rad=1.0 / 119)
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.5]))
    scans = np.stack([scan_lidar(scene, pose, front, rng).ranges_m for _ in range(400)])
    assert np.isinf(scans).mean() == pytest.approx(front.faults.random_hole_share, rel=0.15)
    assert not np.isnan(scans).any()
