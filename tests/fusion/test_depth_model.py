import math

import numpy as np
import pytest

from fusion.bayes import STEPS_A_UNIT, evidence_steps
from fusion.depth_model import RangeNoise, depth_from_disparity, disparity_noise, hit_evidence, share_in_cell


def test_depth_from_disparity_solves_equations_2_and_3():
    z0, f, b = 2.0, 580.0, 0.075
    z = np.array([0.8, 1.5, 2.0, 3.5])
    shift = b * (z0 - z) / z0  # Eq. (2): D
    disparity = f * shift / z  # Eq. (3): d
    np.testing.assert_allclose(depth_from_disparity(disparity, z0, f, b), z, rtol=1e-12)
    assert np.isnan(depth_from_disparity(np.array(-30.0), z0, f, b))


def test_noise_of_a_depth_is_that_of_its_disparity():
    noise = disparity_noise(0.0625, 580.0, 0.075, floor_m=1e-9)
    z = np.array([1.0, 3.0])
    d = 580.0 * 0.075 / z
    np.testing.assert_allclose(noise.sigma_m(z), z - 580.0 * 0.075 / (d + 0.0625), rtol=0.01)
    with pytest.raises(ValueError, match="floor_m"):
        RangeNoise(0.0)


def test_a_hit_weighs_less_the_wider_its_noise():
    noise = RangeNoise(0.001, per_m=0.005)
    table = hit_evidence(noise, 0.7, 0.05, 6.0)
    assert (np.diff(table) <= 0).all()
    assert table[0] == evidence_steps(0.7)
    assert 0 < table[-1] < 0.5 * table[0]
    # One standard deviation to each side of the middle.
    sigma = noise.sigma_m(np.array(2.0))
    assert share_in_cell(np.array(2.0), noise, 2 * float(sigma)) == pytest.approx(math.erf(1 / math.sqrt(2)))
    assert table.max() < 4 * STEPS_A_UNIT
    with pytest.raises(ValueError, match="p_hit"):
        hit_evidence(noise, 0.5, 0.05, 6.0)
