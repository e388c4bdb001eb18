"""The scatter of an alignment's gradient, against Newey and West's double sum."""

import numpy as np
import pytest

from slam.matching.point_to_line import terms_at
from slam.matching.score_spread import score_spread
from slam.matching.surfel_map import build_surfel_maps

KERNEL_M = 0.05


@pytest.mark.parametrize("lags", [1, 7, 25, 200])
def test_neighbours_count_by_bartletts_weights(lags: int) -> None:
    rng = np.random.default_rng(lags)
    along = np.linspace(0.0, 3.0, 90)
    wall = np.column_stack([along, np.zeros(90)]).astype(np.float32)
    normals = np.tile(np.array([0.0, 1.0], np.float32), (90, 1))
    surfels = build_surfel_maps(wall, normals, (0.1,))[0]
    seen = (wall + rng.normal(0.0, 0.01, (90, 2))).astype(np.float32)
    pose = np.array([0.01, -0.01, 0.02])
    terms = terms_at(seen, normals, pose, surfels, KERNEL_M)
    gradients, weight, bend = terms[:, :3], terms[:, 3].sum(), terms[:, 4].sum()
    assert bend > 0.3 * weight > 15.0
    lag = np.abs(np.subtract.outer(np.arange(90), np.arange(90)))
    weights = np.maximum(1.0 - lag / (lags + 1.0), 0.0)
    np.testing.assert_allclose(
        score_spread(seen, normals, pose, surfels, KERNEL_M, lags),
        gradients.T @ weights @ gradients * (weight / bend) ** 2,
        rtol=1e-9,
        atol=1e-12,
    )


def test_no_points_scatter_nothing() -> None:
    none = np.zeros((0, 2), np.float32)
    surfels = build_surfel_maps(none, none, (0.1,))[0]
    np.testing.assert_array_equal(score_spread(none, none, np.zeros(3), surfels, KERNEL_M, 25), 0.0)
