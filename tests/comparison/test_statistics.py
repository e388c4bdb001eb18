"""Intervals cover what they should, pairs are pairs, and a zero inside means undecided."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.comparison.statistics import interval_of, paired

VALUES = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=6)


@settings(max_examples=8, deadline=None)
@given(st.dictionaries(st.text(max_size=3), VALUES, min_size=1, max_size=4), st.floats(-10.0, 10.0))
def test_the_interval_holds_the_median_within_the_values_and_moves_with_them(
    groups: dict[str, list[float]], shift: float
) -> None:
    found = interval_of(groups)
    every = [value for values in groups.values() for value in values]
    assert found.count == len(every)
    assert found.median == np.median(every)
    if len(every) > 1:
        assert min(every) <= found.low <= found.high <= max(every)
        moved = interval_of({name: [value + shift for value in values] for name, values in groups.items()})
        assert moved.low == pytest.approx(found.low + shift, abs=1e-9)
    else:
        assert np.isnan(found.low) and np.isnan(found.high)


def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(60):
        # Eight homes with an error each, three drives in every one.
        homes = rng.normal(0.0, 1.0, 8)
        found = interval_of({str(n): list(home + rng.normal(0.0, 0.3, 3)) for n, home in enumerate(homes)})
        covered += found.low <= 0.0 <= found.high
    assert 50 <= covered <= 60


def test_drives_that_resemble_each_other_count_less() -> None:
    rng = np.random.default_rng(1)
    homes = {str(n): list(center + rng.normal(0.0, 0.01, 5)) for n, center in enumerate(rng.normal(0, 1, 6))}
    alone = {f"{name} {n}": [value] for name, values in homes.items() for n, value in enumerate(values)}
    grouped, single = interval_of(homes), interval_of(alone)
    assert grouped.median == single.median
    assert grouped.high - grouped.low > single.high - single.low


def runs(values: list[float], seeds: int = 1) -> dict[tuple[str, str, int], float]:
    return {(f"g{n}", f"d{n}", seed): value for n, value in enumerate(values) for seed in range(seeds)}


def test_pairs_see_what_medians_side_by_side_do_not() -> None:
    # Each data set has its own difficulty, a hundred times the effect.
    hardness = np.linspace(0.0, 10.0, 12)
    reference, other = runs(list(hardness)), runs(list(hardness + 0.1))
    found = paired(other, reference, smaller_is_better=True)
    assert found is not None
    assert (found.verdict, found.better) == ("worse", 0)
    assert found.difference.low == pytest.approx(0.1) and found.difference.high == pytest.approx(0.1)
    turned = paired(other, reference, smaller_is_better=False)
    assert turned is not None and (turned.verdict, turned.better) == ("better", 12)


def test_no_difference_is_undecided() -> None:
    rng = np.random.default_rng(2)
    found = paired(runs(list(rng.normal(0, 1, 15))), runs([0.0] * 15), smaller_is_better=True)
    assert found is not None and found.verdict == "undecided"
    same = paired(runs([1.0] * 6), runs([1.0] * 6), smaller_is_better=True)
    assert same is not None and (same.verdict, same.better) == ("undecided", 0)


def test_few_pairs_are_no_evidence() -> None:
    for count, verdict in ((1, "too few pairs"), (5, "too few pairs"), (6, "better")):
        found = paired(runs([1.0] * count), runs([2.0] * count), smaller_is_better=True)
        assert found is not None and (found.verdict, found.better) == (verdict, count)


def test_only_what_both_have_done_is_compared() -> None:
    reference = runs([1.0, 2.0, 3.0])
    other = {key: value + 1.0 for key, value in reference.items() if key[1] != "d1"}
    found = paired(other, reference, smaller_is_better=True)
    assert found is not None and found.difference.count == 2
    assert paired({("g9", "d9", 0): 1.0}, reference, smaller_is_better=True) is None


def test_what_no_seed_decides_is_compared_with_every_seed() -> None:
    seeded, once = runs([1.0, 2.0], seeds=3), runs([2.0, 3.0])
    for a, b, sign in ((once, seeded, 1.0), (seeded, once, -1.0)):
        found = paired(a, b, smaller_is_better=True)
        assert found is not None
        assert found.difference.count == 6
        assert found.difference.median == sign
