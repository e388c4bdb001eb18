"""How uncertain the poses are, drawn: over time, and as ellipses on the map."""

from __future__ import annotations

import numpy as np

from fusion.estimation import gate
from slam.evaluation.figure_parts import BLUE, figure_of, plain, png_of, thinned
from slam.measurements import FloatArray

_ELLIPSES, _CORNERS = 40, 24


def sigma_png(stamps_s: FloatArray, covariances: FloatArray) -> bytes:
    """Draw the standard deviations of position, where it is greatest, and yaw over time.

    Parameters
    ----------
    stamps_s
        (N,); they may run backward, so points are not joined.
    covariances
        (N, 3, 3) or (N, 6, 6), see `slam.Map.covariances`.
    """
    figure = figure_of(1000, 400)
    yaws = figure.add_axes((0.065, 0.12, 0.92, 0.38))
    axes = 2 if covariances.shape[1] == 3 else 3
    positions_m = np.sqrt(np.linalg.eigvalsh(covariances[:, :axes, :axes])[:, -1])
    yaws_deg = np.degrees(np.sqrt(covariances[:, -1, -1]))
    rows = thinned(np.column_stack([stamps_s - stamps_s.min(), 100.0 * positions_m, yaws_deg]))
    places = figure.add_axes((0.065, 0.58, 0.92, 0.38), sharex=yaws)
    for drawn, column, label in ((places, 1, "position, cm"), (yaws, 2, "yaw, degrees")):
        drawn.plot(rows[:, 0], rows[:, column], ".", color=BLUE, markersize=3, markeredgewidth=0)
        drawn.set(ylabel=f"sigma of the {label}")
        drawn.set_ylim(bottom=0.0)
        plain(drawn)
    places.tick_params(labelbottom=False)
    yaws.set(xlabel="time, s")
    return png_of(figure)


def ellipses(positions_xy: FloatArray, covariances: FloatArray) -> tuple[FloatArray, int]:
    """Outlines of the 95 % ellipses of some positions (N, 2), and how many times too large they are.

    Returns
    -------
    (M, 2) corners in the map frame, a row of nan after each ellipse; and the power of ten by which they are
    drawn larger, so that the largest can be seen.
    """
    chosen = np.unique(np.linspace(0, len(positions_xy) - 1, _ELLIPSES).astype(int))
    values, vectors = np.linalg.eigh(covariances[chosen][:, :2, :2])
    turns = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    around = np.concatenate([np.stack([np.cos(turns), np.sin(turns)]), np.full((2, 1), np.nan)], axis=1)
    radii = np.sqrt(gate(2, 0.95) * np.maximum(values, 0.0))
    seen = np.ptp(positions_xy, axis=0).max() / _ELLIPSES
    times = 10 ** max(0, int(np.ceil(np.log10(max(seen, 1e-9) / max(float(radii.max()), 1e-9)))))
    corners = times * (vectors * radii[:, None, :]) @ around + positions_xy[chosen][..., None]
    return corners.transpose(0, 2, 1).reshape(-1, 2), times
