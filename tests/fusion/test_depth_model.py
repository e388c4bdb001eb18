import math

import numpy as np
import pytest

from fusion.bayes import STEPS_A_UNIT, evidence_steps
from fusion.depth_model import RangeNoise, hit_evidence, share_in_cell


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
    with pytest.raises(ValueError, match="floor_m"):
        RangeNoise(0.0)
    with pytest.raises(ValueError, match="p_hit"):
        hit_evidence(noise, 0.5, 0.05, 6.0)
