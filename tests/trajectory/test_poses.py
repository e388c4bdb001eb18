"""Many motions at once, against SciPy's own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.trajectory.poses import product


@pytest.mark.parametrize("axes", [[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0]], ids=["space", "plane"])
def test_a_product_of_rotations_is_scipys_to_the_bit(axes: list[float]) -> None:
    first, second = (
        Rotation.from_quat(np.random.default_rng(seed).normal(size=(500, 4)) * axes) for seed in (1, 2)
    )
    np.testing.assert_array_equal(product(first, second).as_quat(), (first * second).as_quat())
