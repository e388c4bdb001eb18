import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.bayes import FREE, OCCUPIED, UNKNOWN, decide, evidence_steps, exceeds, log_odds, states_of, update

PROBABILITIES = st.floats(0.001, 0.999)


@given(PROBABILITIES, PROBABILITIES, PROBABILITIES)
def test_fusing_is_commutative_and_associative(a, b, c):
    a, b, c = np.array(a), np.array(b), np.array(c)
    assert update(a, b) == pytest.approx(update(b, a), abs=1e-12)
    assert update(update(a, b), c) == pytest.approx(update(a, update(b, c)), abs=1e-6)


@given(PROBABILITIES, PROBABILITIES)
def test_in_log_odds_fusing_is_a_sum(a, b):
    fused = float(update(np.array(a), np.array(b)))
    assert fused == pytest.approx(1 / (1 + np.exp(-(log_odds(a) + log_odds(b)))), abs=1e-9)


def test_equation_8_and_10_by_hand():
    np.testing.assert_allclose(
        update(np.array([0.5, 0.9, 0.9]), np.array([0.3, 0.9, 0.1])), [0.3, 81 / 82, 0.5]
    )
    assert np.isnan(update(np.array(1.0), np.array(0.0)))


# The eight cases of Table 3 beside "both uncertain": rows lidar, columns camera.
STATES = np.array([OCCUPIED, FREE, UNKNOWN], dtype=np.int8)
LIDAR, CAMERA = np.repeat(STATES, 3).reshape(3, 3), np.tile(STATES, (3, 1))


def test_table_3_corrected_and_as_printed():
    o, f, u = OCCUPIED, FREE, UNKNOWN
    assert decide(LIDAR, CAMERA).tolist() == [[o, o, o], [o, f, f], [o, f, u]]
    assert decide(LIDAR, CAMERA, "printed").tolist() == [[o, o, o], [o, f, f], [f, o, u]]
    with pytest.raises(ValueError, match="corrected or printed"):
        decide(LIDAR, CAMERA, "both")


def test_thresholds_of_equation_9():
    p = np.array([0.2, 0.35, 0.5, 0.65, 0.7])
    assert exceeds(p).tolist() == [False, False, False, True, True]
    assert states_of(p, 0.65, 0.35).tolist() == [FREE, UNKNOWN, UNKNOWN, UNKNOWN, OCCUPIED]
    with pytest.raises(ValueError, match="thresholds"):
        states_of(p, 0.3, 0.6)


def test_evidence_is_whole_steps_and_keeps_its_sign():
    assert evidence_steps(0.5) == 0
    assert evidence_steps(0.500001) == 1
    assert evidence_steps(0.499999) == -1
    assert evidence_steps(0.7) == -evidence_steps(0.3) == round(1024 * np.log(7 / 3))
    with pytest.raises(ValueError, match="above 0 and below 1"):
        log_odds(1.0)
