"""Eq. (2)-(4) on all windows at once, against the formulas on each window alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.registration import FEWEST, LEAST_OVERLAP, Grade, grade_of, pearson
from tools.xu2024_rows import inverse_cosine, inverse_euler, masked_sums, pearson_map


def plain(d, window):
    """PCC, InvCos, InvEuler of the samples that both have, as printed; None if they are too few."""
    both = np.isfinite(d) & np.isfinite(window)
    if both.sum() < max(FEWEST, LEAST_OVERLAP * d.size):
        return None
    a, b = d[both].astype(float), window[both].astype(float)
    cosine = 1.0 - a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
    euler = 1.0 - np.linalg.norm(a - b) / max(np.linalg.norm(a), np.linalg.norm(b))
    return np.corrcoef(a, b)[0, 1], cosine, euler


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(0.0, 0.6), st.integers(14, 40))
def test_all_windows_at_once_are_each_window_alone(seed, holes, width):
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0.3, 5.0, (3, width)).astype(np.float32)
    curve = rng.uniform(0.3, 5.0, width + 9).astype(np.float32)
    rows[rng.random(rows.shape) < holes] = np.nan
    curve[rng.random(curve.shape) < holes] = np.nan
    sums = masked_sums(rows, curve)
    maps = pearson_map(sums), inverse_cosine(sums), inverse_euler(sums)
    for v in range(3):
        for u in range(10):
            wanted = plain(rows[v], curve[u : u + width])
            found = [scores[v, u] for scores in maps]
            assert found == pytest.approx(wanted or (0.0, 1.0, 0.0), abs=2e-3)
            assert pearson(rows[v], curve[u : u + width]) == pytest.approx(wanted[0] if wanted else 0.0)


def test_a_curve_is_like_itself_and_pcc_does_not_see_scale():
    curve = (2.0 + np.sin(np.linspace(0.0, 9.0, 60))).astype(np.float32)
    sums = masked_sums(np.stack([curve[20:50], 1.5 * curve[20:50]]), curve)
    assert np.unravel_index(np.argmax(pearson_map(sums)[:1]), (1, 31))[1] == 20
    assert pearson_map(sums)[:, 20] == pytest.approx(1.0, abs=1e-3)
    assert inverse_cosine(sums)[:, 20] == pytest.approx(0.0, abs=1e-4)
    assert inverse_euler(sums)[0, 20] == pytest.approx(1.0, abs=1e-2)
    assert inverse_euler(sums)[1, 20] == pytest.approx(2.0 / 3.0, abs=1e-2)


def test_a_flat_curve_has_no_correlation_and_too_wide_a_one_is_refused():
    flat = np.full((1, 20), 2.0, np.float32)
    assert pearson(flat[0], np.linspace(1, 2, 20, dtype=np.float32)) == 0.0
    assert pearson_map(masked_sums(flat, np.linspace(1, 2, 30, dtype=np.float32))).max() == 0.0
    with pytest.raises(ValueError, match="20"):
        masked_sums(flat, np.ones(19, np.float32))


@pytest.mark.parametrize(("pcc", "grade"), [(-0.5, 0), (0.3, 0), (0.31, 1), (0.6, 1), (0.61, 2), (1.0, 2)])
def test_grades_are_the_papers(pcc, grade):
    assert grade_of(pcc) == Grade(grade)
