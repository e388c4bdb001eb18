"""When sensors fire, and what their clocks say."""

from __future__ import annotations

import numpy as np
import pytest

from slam.simulation.sensor_clock import generator, schedule


def test_a_clean_sensor_keeps_its_rhythm_and_the_time() -> None:
    due = schedule("lidar", 10.7, 30.0, 1000.0, seed=1)
    assert np.allclose(np.diff(due.true_s), 1.0 / 10.7)
    assert np.allclose(due.stamps_s, 1000.0 + due.true_s, atol=1e-6)
    assert due.kept.all()
    assert 0.0 < due.true_s[0] < 1.0 / 10.7
    assert 30.0 - 1.0 / 10.7 < due.true_s[-1] <= 30.0


def test_offset_and_jitter_have_the_size_asked_for() -> None:
    due = schedule(
        "c", 10.0, 400.0, 0.0, seed=2, clock_offset_s=0.25, period_jitter_s=0.004, stamp_jitter_s=0.002
    )
    wrong = due.stamps_s - due.true_s
    assert wrong.mean() == pytest.approx(0.25, abs=2e-4)
    assert wrong.std() == pytest.approx(0.002, rel=0.08)
    # The gap between two firings has two jitters in it.
    assert np.diff(due.true_s).std() == pytest.approx(0.004 * np.sqrt(2.0), rel=0.08)


@pytest.mark.parametrize("seed", range(5))
def test_however_wild_the_jitter_no_two_readings_change_places(seed: int) -> None:
    due = schedule("c", 10.0, 100.0, 0.0, seed=seed, period_jitter_s=0.5, stamp_jitter_s=0.5)
    assert (np.diff(due.true_s) > 0.0).all()
    assert (np.diff(due.stamps_s) > 0.001).all()
    assert due.true_s.min() >= 0.0
    assert due.true_s.max() <= 100.0


def test_dropped_and_dead_readings_leave_the_others_as_they_were() -> None:
    clean = schedule("c", 20.0, 200.0, 0.0, seed=3, stamp_jitter_s=0.002)
    lossy = schedule(
        "c", 20.0, 200.0, 0.0, seed=3, stamp_jitter_s=0.002, dropped_share=0.1, dead_s=(100.0, 150.0)
    )
    assert (clean.stamps_s == lossy.stamps_s).all()
    dead = (lossy.true_s >= 100.0) & (lossy.true_s < 150.0)
    assert not lossy.kept[dead].any()
    assert lossy.kept[~dead].mean() == pytest.approx(0.9, abs=0.02)


def test_a_drive_shorter_than_a_period_has_no_reading() -> None:
    assert schedule("c", 1.0, 0.1, 0.0, seed=0).true_s.size == 0


def test_sensors_draw_from_numbers_of_their_own() -> None:
    draws = {generator(7, name, stream).random() for name in ("a", "b") for stream in (0, 1)}
    assert len(draws) == 4
    assert generator(7, "a", 1).random() == generator(7, "a", 1).random()
