"""Mutual repair of lidar and depth: Xu2024 Eq. (6)-(8), 2.3.2, at the resolution of each sensor.

Readings are paired by position and not by index: each curve is reprojected to the other's frame. If both
have a reading and they differ by more than eps, the paper does not say which is wrong. Here it is the one
that its own neighbours do not support. If both are consistent, the difference is real (a low cupboard in
front of a wall) and both are kept. A nearer reading of the lidar is replaced only if it is a flying point at
an edge. Candidate values for holes and for such readings are used only if they are likely to be right
(`fusion.repair_odds`): both sensors see through glass, and most wide holes are glass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.alignment import EPS_OVER_E, rigid_fit
from fusion.checks import instance, numbers
from fusion.curves import BESIDE, HEIGHT_STEP_M, Curve, DepthImage, Float32Array, FloatArray, LidarCurve
from fusion.estimation import TINY, gate, median_to_sigma
from fusion.panorama import Depths, ImageView, as_images, lookup_of, native_slice, native_step_rad
from fusion.registration import Grade, Registration
from fusion.repair import Provenance, ProvenanceArray, replace_readings, smooth_outliers
from fusion.repair_odds import BEAM_ODDS, PIXEL_ODDS, beam_candidates, probabilities
from fusion.repair_pixels import pixel_candidates
from fusion.reprojection import reproject, smooth, without_bumps
from fusion.rig import RigEstimate
from fusion.showing import one_line, shaded, with_pictures

LEAST_EPS_SHARE = 0.025  # of the range: below, the lidar's own noise would be classified as burrs
_BURR_RAD = math.radians(1.4)  # longest run of readings that can be a burr; two squares of pixels
_LONE_RAD = math.radians(0.3)  # single readings of a camera
_LIDAR_SLACK, _CAMERA_SLACK = 0.04, 0.01  # noise of the difference of two neighbours, as a share of the range


@dataclass(frozen=True)
class Denoised:
    """A scan and its depth images after the repair.

    Attributes
    ----------
    ranges_m, lidar_source
        (N,) ranges of the repaired scan, invalid readings unchanged, and the `Provenance` of each beam.
    depth_m, depth_source
        For each camera (H, W) repaired depth, and the `Provenance` of each pixel.
    lidar_probability, depth_probability
        (N,) and for each camera (H, W): probability that an inserted value is right: a range within 0.2 m, a
        depth within 0.1 m. ``nan`` where nothing was inserted.
    lidar_sigma_m, depth_sigma_m
        Standard deviation of an inserted value, provided it is right.
    applied
        False if the grade of the pair did not allow any repair; then nothing was changed.
    """

    ranges_m: Float32Array
    lidar_source: ProvenanceArray
    depth_m: tuple[Float32Array, ...]
    depth_source: tuple[ProvenanceArray, ...]
    lidar_probability: Float32Array
    depth_probability: tuple[Float32Array, ...]
    lidar_sigma_m: Float32Array
    depth_sigma_m: tuple[Float32Array, ...]
    applied: bool

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, *(shaded(np.where(depth > 0.0, depth, np.nan)) for depth in self.depth_m))


def denoise(
    scan: LidarCurve,
    depth: Depths,
    registration: Registration | RigEstimate,
    *,
    least_grade: Grade = Grade.HIGH,
    least_probability: float = 0.95,
) -> Denoised:
    """Repair a scan and its depth images with each other.

    Parameters
    ----------
    scan, depth
        The scan and the images that were registered.
    registration
        Registration of this pair, or better the estimate of the rig from all pairs of a drive.
    least_grade
        A single pair with a lower grade is not repaired.
    least_probability
        A value that is less likely to be right is not inserted: a hole is better than a wrong value. A line
        across a hole must reach this probability at both ends. The mean of two readings that agree is always
        used, however likely it is that both look through glass.

    Raises
    ------
    ValueError
        If the cameras are not those that were registered, or an argument is of a wrong type.

    Examples
    --------
    A lidar beam has no return, and a camera sees the surface there.

    >>> import fusion, numpy as np
    >>> def ranges_m(bearings):  # to the walls of a room of 6 m by 4 m, from a position in it
    ...     rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ...     return ((np.array([3.0, 2.0]) - np.sign(rays) * [0.5, 0.3]) / np.abs(rays)).min(axis=1)
    >>> beams, slopes = np.linspace(-np.pi, np.pi, 721, endpoint=False), (79.5 - np.arange(160)) / 120
    >>> camera = fusion.Intrinsics(fx=120, fy=120, cx=79.5, cy=59.5)
    >>> depth_m = ranges_m(np.arctan(slopes) + 0.9) * np.cos(np.arctan(slopes))  # looks 0.9 rad to the left
    >>> depth = fusion.DepthImage(np.tile(depth_m, (120, 1)).astype(np.float32), camera)
    >>> true_m = ranges_m(beams)
    >>> seen_m = np.where(abs(beams - 0.9) < 0.004, np.inf, true_m)
    >>> scan = fusion.LidarCurve(seen_m, -np.pi, 2 * np.pi / 721)
    >>> repaired = fusion.denoise(scan, depth, fusion.register(scan, depth))
    >>> int((repaired.lidar_source == fusion.Provenance.FILLED).sum())
    1
    >>> bool(np.abs(repaired.ranges_m - true_m).max() < 0.05)
    True
    """
    instance(scan, LidarCurve, "scan")
    instance(registration, (Registration, RigEstimate), "registration")
    numbers(least_probability, (), "least_probability")
    instance(least_grade, Grade, "least_grade")
    images = as_images(depth)
    if isinstance(registration, RigEstimate):
        matrices = [None if fit is None else fit.T_laser_level for fit in registration.alignments]
    elif registration.grade >= least_grade:
        rng = np.random.default_rng(0)
        matrices = [rigid_fit(*pairs, rng) for pairs in matched_curves(registration)]
    else:
        matrices = []
    return repair_by(scan, images, registration, matrices, least_probability)


def repair_by(
    scan: LidarCurve,
    images: tuple[DepthImage, ...],
    registration: Registration | RigEstimate,
    matrices: Sequence[FloatArray | None],
    least_probability: float,
) -> Denoised:
    """As `denoise`, with (3, 3) transforms from each camera's level plane to the lidar's; None if unknown."""
    if not any(matrix is not None for matrix in matrices):
        return _unchanged(scan, images)
    if len(matrices) != len(images):
        raise ValueError(f"{len(images)} images for {len(matrices)} registered cameras")
    candidates = find_candidates(scan, images, registration, matrices)
    return _insert(scan, images, candidates, least_probability)


def _view(image: DepthImage, registration: Registration | RigEstimate) -> ImageView:
    """Return the curve of an image that the registration selected."""
    height = registration.height_m
    low, high = registration.height_range_m if isinstance(registration, RigEstimate) else (height, height)
    return ImageView(native_slice(image, height), lookup_of(image, native_step_rad(image)), low, high)


def matched_curves(registration: Registration) -> list[tuple[FloatArray, FloatArray]]:
    """Return `matched_points` of each camera from a single pair, the camera's points first."""
    curves = [stack.curve(registration.v) for stack in registration.stacks]
    return [matched_points(registration.curve, curve, registration.yaw_rad) for curve in curves]


def matched_points(lidar: Curve, camera: Curve, yaw_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return points of the camera and of the lidar, (N, 2) each, at samples where both have one."""
    at = np.round((camera.bearings_rad() + yaw_rad - lidar.start_angle_rad) / lidar.step_rad).astype(int)
    inside = (at >= 0) & (at < lidar.ranges_m.size)
    of_camera, of_lidar = camera.points()[inside], lidar.points()[at[inside]]
    in_both = np.isfinite(of_camera).all(axis=1) & np.isfinite(of_lidar).all(axis=1)
    return of_camera[in_both], of_lidar[in_both]


@dataclass(frozen=True)
class Candidates:
    """Candidate values for a scan and its images, before they are checked.

    Attributes
    ----------
    source, kinds, beams
        `Provenance` of replaced readings, and the results of `beam_candidates`, counter-clockwise.
    pixels
        Results of `pixel_candidates`, by the index of the image.
    sigma_shares, pixel_sigma_share
        (5,) by `Provenance`, and of pixels: standard deviation of right values, as a share of the range.
    """

    source: ProvenanceArray
    kinds: NDArray[np.intp]
    beams: FloatArray
    pixels: dict[int, FloatArray]
    sigma_shares: FloatArray
    pixel_sigma_share: float


def find_candidates(
    scan: LidarCurve,
    images: Sequence[DepthImage],
    registration: Registration | RigEstimate,
    matrices: Sequence[FloatArray | None],
) -> Candidates:
    """Reproject and compare; arguments as for `repair_by`."""
    views = {
        camera: (_view(images[camera], registration), matrix)
        for camera, matrix in enumerate(matrices)
        if matrix is not None
    }
    ranges = scan.valid_ranges_m()
    flip, step = scan.step_rad < 0.0, abs(scan.step_rad)
    own = ranges[::-1].copy() if flip else ranges
    start = scan.start_angle_rad + (scan.step_rad * (own.size - 1) if flip else 0.0)
    other = np.full(own.size, np.nan, dtype=np.float32)
    noise = []
    for view, matrix in views.values():
        reprojected, rough = _seen_by_lidar(view.curve, matrix, (start, step, own.size))
        np.fmin(other, reprojected, out=other)
        noise.append(rough)
    share = eps_of(own, other)
    burr = max(1, round(_BURR_RAD / step))
    clean = without_bumps(own, step, 1, burr, _LIDAR_SLACK)
    steady = smooth(clean, step, BESIDE, _LIDAR_SLACK)
    mine, theirs = roughness(clean, steady), max([rough for rough in noise if rough >= 0.0], default=math.nan)
    trust = mine**2 / max(mine**2 + theirs**2, TINY) if np.isfinite(mine + theirs) else 0.0
    replaced, source = replace_readings(own, other, share, burr, trust)
    smooth_outliers(replaced, steady, source, math.sqrt(gate()) * mine)
    kinds, beams = beam_candidates(own, steady, other, replaced, source, share, 5 * burr)
    pixels = {
        camera: _pixel_candidates(
            images[camera], view, matrix, steady, beams[0, :, 3], (start, step), (share, mine)
        )
        for camera, (view, matrix) in views.items()
    }
    # Agreeing readings differ by the noise of both, and by the error of the reprojection.
    agreed = source == Provenance.AVERAGED
    spread = float(np.median(np.abs(own - other)[agreed] / own[agreed])) if agreed.any() else share
    carried = math.sqrt(max(spread**2 - mine**2, theirs**2)) if np.isfinite(mine + theirs) else share
    mean = math.hypot((1.0 - trust) * mine, trust * carried)
    shares = median_to_sigma() * np.array([math.nan, carried, mine, math.nan, mean])
    # A pixel's value is a range smoothed over at least `BESIDE` readings, on the image's own surfaces.
    smoothed = median_to_sigma() * math.hypot(carried, mine / math.sqrt(BESIDE))
    return Candidates(source, kinds, beams, pixels, shares, smoothed)


def _insert(
    scan: LidarCurve, images: tuple[DepthImage, ...], candidates: Candidates, least_probability: float
) -> Denoised:
    """Insert the candidates that are likely enough to be right."""
    result = _unchanged(scan, images)
    judged = probabilities(candidates.kinds, candidates.beams[..., 1:], BEAM_ODDS)
    best, beam = judged.argmax(axis=0), np.arange(candidates.source.size)
    chance = judged[best, beam]
    hole = candidates.source == Provenance.HOLE
    kind = np.where(hole, np.where(best == 0, Provenance.FILLED, Provenance.INTERPOLATED), candidates.source)
    # A line across a hole is right if both of its ends are; both may have passed through the same pane.
    line = hole & (kind == Provenance.INTERPOLATED)
    least = np.where(line, math.sqrt(max(least_probability, 0.0)), least_probability)
    least = np.where(kind == Provenance.AVERAGED, 0.0, least)
    taken = np.flatnonzero(chance >= np.maximum(least, 0.0))
    at = candidates.source.size - 1 - taken if scan.step_rad < 0.0 else taken
    value, kind = candidates.beams[best[taken], taken, 0], kind[taken]
    result.ranges_m[at], result.lidar_source[at] = value, kind
    result.lidar_probability[at] = chance[taken]
    result.lidar_sigma_m[at] = np.hypot(candidates.sigma_shares[kind] * value, 0.5 * HEIGHT_STEP_M)
    for camera, rows in candidates.pixels.items():
        pixel, kinds = rows[:, 0].astype(np.intp), rows[:, 1].astype(np.intp)
        chance = probabilities(kinds, rows[:, 3:], PIXEL_ODDS)
        taken = np.flatnonzero(chance >= least_probability)
        taken = taken[np.argsort(chance[taken])]  # of several heights, the most likely comes last
        at, value = pixel[taken], rows[taken, 2]
        depth, source = result.depth_m[camera].ravel(), result.depth_source[camera].ravel()
        burrs = pixel[kinds != 0]
        depth[burrs], source[burrs] = 0.0, Provenance.HOLE
        depth[at], source[at] = value, Provenance.FILLED
        result.depth_probability[camera].ravel()[at] = chance[taken]
        sigma_m = np.hypot(candidates.pixel_sigma_share * value, 0.5 * HEIGHT_STEP_M)
        result.depth_sigma_m[camera].ravel()[at] = sigma_m
    return replace(result, applied=True)


def eps_of(own: Float32Array, other: Float32Array) -> float:
    """Return eps of the paper, from the mean residual E, as a share of the range.

    It is a share, since the noise of both sensors grows with the range; the paper has one eps for all ranges.
    Each residual is limited to a twentieth of the range: real differences (a low cupboard) can be metres, and
    a few of them would hide all outliers.
    """
    in_both = np.isfinite(own) & np.isfinite(other)
    if not in_both.any():
        return LEAST_EPS_SHARE
    errors = np.abs(own[in_both] - other[in_both]) / own[in_both]
    mean = float(np.minimum(errors, 2.0 * LEAST_EPS_SHARE).mean())
    return max(EPS_OVER_E * mean, LEAST_EPS_SHARE)


def _seen_by_lidar(
    piece: Curve, matrix: FloatArray, beams: tuple[float, float, int]
) -> tuple[Float32Array, float]:
    """Return a camera's curve at the lidar's beams, without its own contradictions, and its noise."""
    lone, bump = round(_LONE_RAD / piece.step_rad), round(_BURR_RAD / piece.step_rad)
    clean = without_bumps(piece.ranges_m, piece.step_rad, max(1, lone), max(2, bump), _CAMERA_SLACK)
    reprojected: Float32Array = reproject(
        clean, piece.start_angle_rad, piece.step_rad, matrix, beams, _CAMERA_SLACK
    )
    return reprojected, roughness(clean, smooth(clean, piece.step_rad, BESIDE, _CAMERA_SLACK))


def roughness(ranges: Float32Array, steady: Float32Array) -> float:
    """Return the noise of a curve as a share of the range, from the residual of smoothing; else ``nan``."""
    errors = np.abs(ranges - steady) / ranges
    return float(np.nanmedian(errors)) if np.isfinite(errors).any() else math.nan


def _pixel_candidates(
    image: DepthImage,
    view: ImageView,
    matrix: FloatArray,
    lidar: Float32Array,
    lost: FloatArray,
    beams: tuple[float, float],
    shares: tuple[float, float],
) -> FloatArray:
    """Return the lidar's candidates for an image; ``lost`` is the number of holes around each beam."""
    step = view.curve.step_rad
    columns = (view.curve.start_angle_rad, step, view.curve.ranges_m.size)
    predicted = reproject(lidar, beams[0], beams[1], np.linalg.inv(matrix), columns, _LIDAR_SLACK)
    if not np.isfinite(predicted).any():
        return np.zeros((0, 14))
    points = Curve(predicted, columns[0], step).points() @ matrix[:2, :2].T + matrix[:2, 2]
    turned = (np.arctan2(points[:, 1], points[:, 0]) - beams[0]) % (2.0 * math.pi)
    beam = np.nan_to_num(turned / beams[1]).round().astype(np.intp).clip(0, lidar.size - 1)
    aside = max(1, round(0.5 * beams[1] / step))
    return pixel_candidates(
        np.ascontiguousarray(image.depth_m, dtype=np.float32),
        (view.lookup.pixel, view.lookup.range_of_depth, view.lookup.slopes),
        np.stack([predicted, _shifted(predicted, -aside), _shifted(predicted, aside)]),
        np.nan_to_num(lost[beam]),
        view.heights(float(np.nanmin(predicted))),
        image.range_max_m,
        *shares,
        (2 * round((_BURR_RAD / step) ** 2), max(1, round((_LONE_RAD / step) ** 2))),
        5 * max(1, round(_BURR_RAD / step)),
    )


def _shifted(ranges: Float32Array, columns: int) -> Float32Array:
    """Shift a curve along its columns; ``nan`` at columns without source."""
    moved = np.roll(ranges, columns)
    moved[slice(columns) if columns > 0 else slice(columns, None)] = np.nan
    return moved


def _unchanged(scan: LidarCurve, images: tuple[DepthImage, ...]) -> Denoised:
    """Return the input, with holes marked."""
    lidar = np.isnan(scan.valid_ranges_m()) * np.uint8(Provenance.HOLE)
    depths = tuple(np.array(image.depth_m, dtype=np.float32, order="C") for image in images)
    sources = tuple(
        (~((depth > 0.0) & (depth <= image.range_max_m))) * np.uint8(Provenance.HOLE)
        for depth, image in zip(depths, images, strict=True)
    )
    ranges = np.array(scan.ranges_m, dtype=np.float32)
    prob, sigma_m = (np.full(ranges.size, np.nan, np.float32) for _ in range(2))
    probs, sigmas_m = (tuple(np.full(depth.shape, np.nan, np.float32) for depth in depths) for _ in range(2))
    return Denoised(ranges, lidar, depths, sources, prob, probs, sigma_m, sigmas_m, False)
