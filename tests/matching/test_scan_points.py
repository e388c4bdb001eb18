"""From a sweep to oriented points: a wall's normal is known, and so is where it ends."""

import math

import gtsam
import numpy as np
import pytest
from flat_worlds import box, corridor, points_of, room, sweep
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import LaserScan

MOUNTS = [
    gtsam.Pose2(),
    gtsam.Pose2(0.3, -0.1, 0.0),
    gtsam.Pose2(0.0, 0.0, math.pi),
    gtsam.Pose2(-0.2, 0.4, 2.1),
]


def scan_of(ranges: list[float], step_rad: float = math.radians(1.0), start_rad: float = 0.0) -> LaserScan:
    return LaserScan(0.0, np.array(ranges, dtype=np.float32), start_rad, step_rad, 30.0)


def wall(distance_m: float, bearing_rad: float) -> np.ndarray:
    """A long straight wall whose foot point lies at a bearing."""
    along = np.array([-math.sin(bearing_rad), math.cos(bearing_rad)])
    foot = distance_m * np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
    return np.concatenate([foot - 500 * along, foot + 500 * along])[None, :]


def assert_unit_or_zero(points: ScanPoints) -> None:
    lengths = np.linalg.norm(points.normals_base, axis=1)
    assert ((np.abs(lengths - 1.0) < 1e-5) | (lengths == 0.0)).all()


@pytest.mark.parametrize("bearing_rad", np.linspace(-math.pi, math.pi, 9))
@pytest.mark.parametrize("distance_m", [0.3, 1.0, 4.0, 12.0])
def test_a_walls_normals_face_the_sensor(distance_m: float, bearing_rad: float) -> None:
    points = points_of(sweep(wall(distance_m, bearing_rad), np.zeros(3), beams=721))
    oriented, normals = points.oriented()
    facing = -np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
    np.testing.assert_allclose(normals, np.tile(facing, (len(normals), 1)), atol=1e-3)
    # A shallow beam spaces its points too far for a fit; up to 65 degrees every point has a normal.
    assert len(oriented) >= 2 * 65 * 2
    np.testing.assert_allclose(oriented @ -facing, distance_m, atol=1e-4)


@pytest.mark.parametrize("bearing_rad", np.linspace(-math.pi, math.pi, 9))
@pytest.mark.parametrize("distance_m", [1.0, 4.0, 12.0])
def test_noise_turns_the_normals_little(distance_m: float, bearing_rad: float) -> None:
    scan = sweep(wall(distance_m, bearing_rad), np.zeros(3), beams=721, sigma_m=0.01)
    points = points_of(scan)
    assert_unit_or_zero(points)
    facing = -np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
    cosines = points.oriented()[1] @ facing
    assert np.median(cosines) > math.cos(math.radians(12.0))
    assert (cosines > 0.0).mean() > 0.99


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.0, -0.5, 2.0)])
def test_points_lie_on_the_walls_in_the_base_frame(mount: gtsam.Pose2, pose: tuple[float, ...]) -> None:
    """The mount is respected: the same room, whatever way the laser is bolted on."""
    points = points_of(sweep(box(-3, -2, 3, 2), pose, mount=mount))
    assert len(points) == 361
    T = gtsam.Pose2(*pose)
    world = np.array([T.transformFrom(p) for p in points.points_base.astype(float)])
    off_wall = np.minimum(np.abs(np.abs(world[:, 0]) - 3.0), np.abs(np.abs(world[:, 1]) - 2.0))
    assert off_wall.max() < 1e-4
    oriented, normals = points.oriented()
    laser = mount.translation()
    assert (((laser - oriented) * normals).sum(axis=1) > 0.0).all()
    # Away from the corners each normal is one of the four of the room.
    turned = np.sort(np.abs(normals @ T.rotation().matrix().T), axis=1)
    assert (turned[:, 0] < 1e-3).mean() > 0.9


def test_a_laser_that_counts_clockwise() -> None:
    scan = sweep(room(), (0.5, 0.2, 0.3))
    flipped = LaserScan(0.0, scan.ranges_m[::-1].copy(), -scan.start_angle_rad, -scan.step_rad, 30.0)
    ours, other = points_of(scan), points_of(flipped)
    np.testing.assert_allclose(other.points_base[::-1], ours.points_base, atol=1e-5)
    np.testing.assert_allclose(other.normals_base[::-1], ours.normals_base, atol=1e-4)


def test_a_gap_splits_the_fit() -> None:
    """Two walls, one behind the other: no normal leans across the step between them."""
    segments = np.array([[2.0, -9.0, 2.0, 0.0], [4.0, 0.0, 4.0, 9.0]])
    points = points_of(sweep(segments, np.zeros(3), beams=361, fov_rad=math.pi / 2))
    oriented, normals = points.oriented()
    assert (np.abs(oriented[:, 0] - 2.0) < 1e-3).sum() > 100
    assert (np.abs(oriented[:, 0] - 4.0) < 1e-3).sum() > 100
    np.testing.assert_allclose(normals, np.tile([-1.0, 0.0], (len(normals), 1)), atol=1e-3)


def test_a_beam_without_return_splits_the_fit() -> None:
    ranges = [2.0, 2.0, math.inf, 2.0, 2.0]
    assert len(points_of(scan_of(ranges))) == 4
    assert len(points_of(scan_of(ranges)).oriented()[0]) == 0, "two points a side make no line"
    ranges[2] = 2.0
    assert len(points_of(scan_of(ranges)).oriented()[0]) == 5


def test_a_beam_without_return_is_no_point_at_the_sensor() -> None:
    """So near that the sensor itself would pass for a neighbour on the wall."""
    wide = scan_of([0.15, 0.15, math.nan, 0.15, 0.15], step_rad=0.2)
    assert len(points_of(wide)) == 4
    assert len(points_of(wide).oriented()[0]) == 0


def test_scattered_points_have_no_normal() -> None:
    rng = np.random.default_rng(0)
    points = points_of(scan_of(rng.uniform(1.0, 20.0, 180).tolist()))
    assert len(points) == 180
    assert len(points.oriented()[0]) < 9


@pytest.mark.parametrize(
    "ranges",
    [[], [1.0], [math.inf] * 50, [math.nan] * 50, [0.05] * 50, [45.0] * 50, [0.0] * 50, [-1.0] * 50],
    ids=["no beam", "one beam", "no return", "nan", "too near", "too far", "zero", "negative"],
)
def test_nothing_usable(ranges: list[float]) -> None:
    points = points_of(scan_of(ranges))
    assert len(points) == (1 if ranges == [1.0] else 0)
    assert points.points_base.shape == points.normals_base.shape == (len(points), 2)
    oriented, normals = points.oriented()
    assert oriented.shape == normals.shape == (0, 2)


def test_the_limits_are_the_callers() -> None:
    scan = scan_of([0.5, 1.0, 2.0, 3.0, 4.0])
    assert len(extract_points(scan, 0.9, 3.5, 4)) == 3


def test_a_corridor_has_normals_across_only() -> None:
    _, normals = points_of(sweep(corridor(), (0.0, 0.2, 0.0))).oriented()
    assert len(normals) > 250
    assert np.abs(normals[:, 0]).max() < 1e-3


@settings(deadline=None, max_examples=100)
@given(
    arrays(np.float32, st.integers(0, 60), elements=st.floats(width=32)),
    st.floats(-0.1, 0.1),
    st.integers(1, 10),
)
def test_any_ranges_give_finite_points(ranges: np.ndarray, step_rad: float, neighbours: int) -> None:
    scan = LaserScan(0.0, ranges, 0.1, step_rad, 30.0, gtsam.Pose2(0.1, 0.2, 3.0))
    points = extract_points(scan, 0.1, 40.0, neighbours)
    assert np.isfinite(points.points_base).all()
    exact = ranges.astype(np.float64)
    assert len(points) == ((exact > 0.1) & (exact < 40.0)).sum()
    assert_unit_or_zero(points)


def test_a_map_learns_the_wall_between_readings_far_apart() -> None:
    points = points_of(sweep(wall(1.2, math.pi / 2), np.zeros(3), beams=361, sigma_m=0.005))
    walls = points.walls_base[points.walls_base[:, 0] > 0.0]
    np.testing.assert_allclose(walls[:, 1], 1.2, atol=0.05)
    np.testing.assert_allclose(np.unique(np.sign(points.wall_normals_base[:, 1])), [-1.0])
    reach_m = walls[:, 0].max()
    assert reach_m > 2.0 * points.oriented()[0][:, 0].max(), "farther than normals are known"
    assert np.diff(np.sort(walls[:, 0])).max() < 0.25, "without a hole"


def test_no_wall_is_drawn_across_a_door_or_round_a_corner() -> None:
    # A wall to 3 m, a room behind a door to 5 m whose far wall is seen, and the wall again.
    segments = np.array(
        [[-50.0, 1.0, 3.0, 1.0], [5.0, 1.0, 60.0, 1.0], [3.0, 1.0, 3.0, 9.0], [3.0, 9.0, 9.0, 9.0]]
    )
    walls = points_of(sweep(segments, np.zeros(3), beams=361)).walls_base
    assert len(walls)
    assert not ((walls[:, 0] > 3.1) & (walls[:, 0] < 4.9) & (np.abs(walls[:, 1] - 1.0) < 0.3)).any()
    off_m = np.minimum(
        np.abs(walls[:, 1] - 1.0), np.minimum(np.abs(walls[:, 0] - 3.0), np.abs(walls[:, 1] - 9.0))
    )
    assert off_m.max() < 0.05


def test_scattered_readings_make_no_walls() -> None:
    rng = np.random.default_rng(3)
    assert not len(points_of(scan_of(rng.uniform(1.0, 20.0, 360).tolist())).walls_base)
