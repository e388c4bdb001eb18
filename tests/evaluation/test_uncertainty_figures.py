"""Ellipses are where the positions are, as large as they say, and drawn so that they can be seen."""

import io

import numpy as np
import pytest
from PIL import Image

from slam.evaluation.report_figures import map_png
from slam.evaluation.uncertainty_figures import ellipses, sigma_png


def poses(sigma_m: float, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Along a line of 20 m; the covariance is longer along y by two."""
    positions = np.column_stack([np.linspace(0.0, 20.0, count), np.zeros(count)])
    return positions, np.repeat([np.diag([sigma_m, 2.0 * sigma_m, 0.01]) ** 2], count, axis=0)


@pytest.mark.parametrize("sigma_m, times", [(1.0, 1), (0.05, 10), (0.005, 100)])
def test_outlines_hold_what_they_should(sigma_m: float, times: int) -> None:
    outlines, found = ellipses(*poses(sigma_m))
    assert found == times
    last = outlines[-26:][np.isfinite(outlines[-26:, 0])]
    assert last.mean(axis=0) == pytest.approx([20.0, 0.0], abs=times * sigma_m)
    # sqrt(chi-square of two degrees of freedom at 0.95)
    assert np.ptp(last, axis=0) == pytest.approx(
        2.0 * 2.448 * times * sigma_m * np.array([1.0, 2.0]), rel=0.02
    )


def test_a_robot_that_never_moved_has_ellipses_too() -> None:
    outlines, times = ellipses(np.zeros((1, 2)), np.zeros((1, 3, 3)))
    assert np.nanmax(np.abs(outlines)) == 0.0 and times == 1


@pytest.mark.parametrize("size", [3, 6])
def test_the_pictures_open(size: int) -> None:
    positions, _ = poses(0.1)
    covariances = np.repeat([np.eye(size) * 1e-4], len(positions), axis=0)
    drawn = [
        sigma_png(np.arange(200.0), covariances),
        map_png(positions, np.zeros((0, 4)), None, covariances),
    ]
    assert all(Image.open(io.BytesIO(png)).size[0] > 500 for png in drawn)
    without = map_png(positions, np.zeros((0, 4)), None)
    assert without != drawn[1]
