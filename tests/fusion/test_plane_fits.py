"""Homography and rigid motion between matched points, with and without noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.alignment import moved, planar, residuals, rigid_fit, rigid_motion
from tools.xu2024_homography import fit, homography_dlt, is_degenerate

HOMOGRAPHY = np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, -0.2], [0.02, -0.03, 1.0]])


def points(rng, count=60):
    return rng.uniform([0.5, -2.0], [4.0, 2.0], (count, 2))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_points_give_the_exact_homography(seed):
    source = points(np.random.default_rng(seed), 12)
    found = homography_dlt(source, moved(HOMOGRAPHY, source))
    assert found == pytest.approx(HOMOGRAPHY, abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(-math.pi, math.pi), st.floats(-2, 2), st.floats(-2, 2))
def test_exact_points_give_the_exact_motion(seed, yaw, x, y):
    source = points(np.random.default_rng(seed), 5)
    assert rigid_motion(source, moved(planar(x, y, yaw), source)) == pytest.approx(
        planar(x, y, yaw), abs=1e-9
    )


@pytest.mark.parametrize("model", ["homography", "magsac", "rigid"])
def test_a_third_of_noise_pairs_does_not_matter(model):
    rng = np.random.default_rng(3)
    truth = planar(0.15, -0.05, 0.3) if model == "rigid" else HOMOGRAPHY
    source = points(rng, 90)
    target = moved(truth, source) + 0.005 * rng.standard_normal((90, 2))
    target[:30] += rng.choice([-1.0, 1.0], (30, 2)) * rng.uniform(0.5, 1.5, (30, 2))
    found = rigid_fit(source, target, rng) if model == "rigid" else fit(source, target, model, rng)
    assert found is not None
    assert residuals(found, source, moved(truth, source)).max() < 0.05


def test_what_leaves_a_model_open_is_refused():
    rng = np.random.default_rng(0)
    line = np.column_stack([np.linspace(0, 3, 30), 2.0 + np.linspace(0, 1.5, 30)])
    assert fit(line, line, "homography", rng) is None
    assert fit(line, line, "magsac", rng) is None
    assert rigid_fit(line, line, rng) is not None
    assert rigid_fit(np.ones((30, 2)), np.ones((30, 2)), rng) is None
    assert rigid_fit(line[:2], line[:2], rng) is None
    assert is_degenerate(points(rng, 5))
