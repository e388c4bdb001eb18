"""What is reported of a repair: less where a gap is wider, among holes, and where the camera contradicts."""

from __future__ import annotations

import numpy as np
import pytest

import fusion
from fusion.repair_odds import BEAM_ODDS, PIXEL_ODDS, beam_candidates, probabilities

CAMERA, LINE = 0, 1


def stated(holes, camera=None, count=81):
    """(2, N) probabilities for holes in a flat wall that the camera sees, or something else."""
    wall = (2.0 / np.cos(0.4 + 0.006 * np.arange(count))).astype(np.float32)
    own = wall.copy()
    own[holes] = np.nan
    source = np.where(np.isnan(own), fusion.Provenance.HOLE, fusion.Provenance.MEASURED).astype(np.uint8)
    other = wall if camera is None else np.full(count, camera, np.float32)
    kinds, found = beam_candidates(own, own, other, own, source, 0.025, 20)
    return probabilities(kinds, found[..., 1:], BEAM_ODDS), found, wall


def test_the_wider_a_hole_the_less_likely_is_what_fills_it():
    chances = [stated(list(range(40, 40 + width)))[0][LINE, 40] for width in (1, 2, 3, 6)]
    assert chances[0] > 0.95
    assert (np.diff(chances) < 0.0).all()


def test_nothing_is_put_between_ends_that_are_far_away_or_missing():
    chance, found, wall = stated([*range(3), *range(30, 55)])
    assert (chance[:, 0] == -1.0).all() and (chance[:, 30] == -1.0).all()
    assert chance[LINE, 42] > 0.0  # 13 beams to either end
    assert found[LINE, 42, 0] == pytest.approx(wall[42], abs=0.02)


def test_holes_around_and_a_camera_that_sees_another_surface_speak_against():
    alone = stated([40])[0]
    assert stated([40, *range(30, 38, 2), *range(43, 51, 2)])[0][LINE, 40] < alone[LINE, 40]
    assert stated([40], camera=4.5)[0][CAMERA, 40] < 0.5 < alone[CAMERA, 40]


def test_an_odds_table_has_a_weight_for_every_pair_of_features():
    for odds, features in ((BEAM_ODDS, 6), (PIXEL_ODDS, 11)):
        assert odds.shape[1] == (features + 1) * (features + 2) // 2
        kinds = np.array([0, -1])
        chance = probabilities(kinds, np.zeros((2, features)), odds)
        assert chance == pytest.approx([1.0 / (1.0 + np.exp(-odds[0, 0])), -1.0])
