import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.bayes import FREE, OCCUPIED, UNKNOWN, decide, evidence_steps, log_odds

PROBABILITIES = st.floats(0.001, 0.999)


@given(PROBABILITIES, PROBABILITIES)
def test_in_log_odds_equation_8_is_a_sum(a, b):
    fused = a * b / (a * b + (1 - a) * (1 - b))
    assert log_odds(fused) == pytest.approx(log_odds(a) + log_odds(b), abs=1e-9)


# The eight cases of Table 3 beside "both uncertain": rows lidar, columns camera.
STATES = np.array([OCCUPIED, FREE, UNKNOWN], dtype=np.int8)
LIDAR, CAMERA = np.repeat(STATES, 3).reshape(3, 3), np.tile(STATES, (3, 1))


def test_table_3_corrected_and_as_printed():
    o, f, u = OCCUPIED, FREE, UNKNOWN
    assert decide(LIDAR, CAMERA).tolist() == [[o, o, o], [o, f, f], [o, f, u]]
    assert decide(LIDAR, CAMERA, "printed").tolist() == [[o, o, o], [o, f, f], [f, o, u]]
    # What the lidar alone calls empty is unknown; all else is as in the table.
    assert decide(LIDAR, CAMERA, "cautious").tolist() == [[o, o, o], [o, f, u], [o, f, u]]
    with pytest.raises(ValueError, match="cautious, corrected or printed"):
        decide(LIDAR, CAMERA, "both")


def test_evidence_is_whole_steps_and_keeps_its_sign():
    assert evidence_steps(0.5) == 0
    assert evidence_steps(0.500001) == 1
    assert evidence_steps(0.499999) == -1
    assert evidence_steps(0.7) == -evidence_steps(0.3) == round(1024 * np.log(7 / 3))
    with pytest.raises(ValueError, match="above 0 and below 1"):
        log_odds(1.0)
