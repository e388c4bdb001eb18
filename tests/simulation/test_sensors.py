"""Simulated sensors: exact geometry, data sheet noise, the same bytes from the same seed."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.simulation.faults import NO_FAULTS, Fault
from slam.simulation.home import Home, Part, Thing, assemble, generate_home
from slam.simulation.rigs import RIGS, camera_pose
from slam.simulation.scene import NOTHING, PERSON, Scene
from slam.simulation.sensor_models import (
    HOKUYO_URG_04LX,
    KINECT_V1,
    REALSENSE_D435I,
    RPLIDAR_A2,
    SICK_LMS_180,
    VLP_16,
    XTION_PRO_LIVE,
    CameraModel,
    LidarModel,
)
from slam.simulation.sensors import render_rgbd, scan_lidar, scan_lidar_3d

LIDARS = [RPLIDAR_A2, HOKUYO_URG_04LX, SICK_LMS_180]
CAMERAS = [KINECT_V1, XTION_PRO_LIVE, REALSENSE_D435I]
HALF_X, HALF_Y, HEIGHT = 2.0, 1.5, 2.5


def empty_room() -> Home:
    """Four walls 4 m x 3 m about the origin, a floor and a ceiling."""
    walls = [
        Part((HALF_X + 0.05, 0.0), (0.05, HALF_Y), 0.0, HEIGHT),
        Part((-HALF_X - 0.05, 0.0), (0.05, HALF_Y), 0.0, HEIGHT),
        Part((0.0, HALF_Y + 0.05), (HALF_X + 0.1, 0.05), 0.0, HEIGHT),
        Part((0.0, -HALF_Y - 0.05), (HALF_X + 0.1, 0.05), 0.0, HEIGHT),
        Part((0.0, 0.0), (3.0, 3.0), -0.1, 0.0),
        Part((0.0, 0.0), (3.0, 3.0), HEIGHT, HEIGHT + 0.1),
    ]
    return assemble([Thing("wall", (wall,)) for wall in walls], [], [], (0.0, 0.0, 0.0))


ROOM = Scene(empty_room())
HOME = generate_home(1)
FURNISHED = Scene(HOME)


def at(x: float, y: float, z: float, yaw_rad: float) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Yaw(yaw_rad), np.array([x, y, z]))


def exact(model: LidarModel) -> LidarModel:
    """The lidar without noise, steps and faults, and with all the range of the room."""
    return replace(
        model, resolution_m=1e-6, sigma_m=0.0, sigma_share=0.0, sigma_share_far=0.0, faults=NO_FAULTS
    )


def analytic_ranges(model: LidarModel, x: float, y: float, yaw_rad: float) -> np.ndarray:
    bearings = yaw_rad + model.start_angle_rad + model.step_rad * np.arange(model.beams)
    c, s = np.cos(bearings), np.sin(bearings)
    with np.errstate(divide="ignore"):
        return np.minimum((np.copysign(HALF_X, c) - x) / c, (np.copysign(HALF_Y, s) - y) / s)


@pytest.mark.parametrize("model", LIDARS, ids=lambda m: m.name)
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.9, -0.7, 0.4), (-1.5, 1.1, -2.7)])
def test_ranges_in_an_empty_room_are_exact_to_a_millimetre(
    model: LidarModel, pose: tuple[float, float, float]
) -> None:
    x, y, yaw = pose
    scan = scan_lidar(ROOM, at(x, y, 0.3, yaw), exact(model), np.random.default_rng(0))
    truth = analytic_ranges(model, *pose)
    assert np.abs(scan.ranges_m - truth).max() < 1e-3
    assert np.abs(scan.true_ranges_m - truth).max() < 1e-3
    assert not scan.fault.any()


def test_a_tilted_lidar_meets_the_floor() -> None:
    down = gtsam.Pose3(gtsam.Rot3.Ypr(0.0, 0.6, 0.0), np.array([0.0, 0.0, 0.5]))
    scan = scan_lidar(ROOM, down, exact(SICK_LMS_180), np.random.default_rng(0))
    assert scan.ranges_m[90] == pytest.approx(0.5 / math.sin(0.6), abs=1e-3)


@pytest.mark.parametrize("model", LIDARS, ids=lambda m: m.name)
def test_range_noise_is_the_data_sheets(model: LidarModel) -> None:
    model = replace(model, faults=NO_FAULTS)
    pose, rng = at(0.0, 0.0, 0.3, 0.0), np.random.default_rng(3)
    scans = [scan_lidar(ROOM, pose, model, rng) for _ in range(300)]
    truth = scans[0].true_ranges_m
    error = np.stack([scan.ranges_m for scan in scans]) - truth
    share = (
        model.sigma_share
        + max(0.0, model.sigma_share_far - model.sigma_share) * (truth / model.range_max_m) ** 2
    )
    sigma = np.hypot(model.sigma_m + share * truth, model.resolution_m / math.sqrt(12.0))
    assert (error / sigma).std() == pytest.approx(1.0, abs=0.02)
    assert abs((error / sigma).mean()) < 0.02
    steps = np.stack([scan.ranges_m for scan in scans]).astype(float) / model.resolution_m
    assert np.abs(steps - np.round(steps)).max() < 1e-2


def test_no_return_and_too_near_are_distinguished() -> None:
    wide = replace(HOKUYO_URG_04LX, range_min_m=1.6, range_max_m=1.9, faults=NO_FAULTS, sigma_share=0.0)
    wide = replace(wide, sigma_m=0.0, sigma_share_far=0.0)
    scan = scan_lidar(ROOM, at(0.0, 0.0, 0.3, 0.0), wide, np.random.default_rng(0))
    near, far = scan.true_ranges_m < 1.599, scan.true_ranges_m > 1.901
    assert near.any() and far.any()
    assert np.isnan(scan.ranges_m[near]).all() and np.isposinf(scan.ranges_m[far]).all()
    assert (scan.fault[near | far] == Fault.HOLE_RANGE).all()


def camera_at(x: float, y: float, z: float, yaw_rad: float) -> gtsam.Pose3:
    return at(x, y, 0.0, yaw_rad).compose(camera_pose((0.0, 0.0, z)))


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
def test_depth_of_a_wall_and_a_floor_is_exact_before_noise(camera: CameraModel) -> None:
    image = render_rgbd(ROOM, camera_at(0.0, 0.0, 0.9, 0.0), camera, np.random.default_rng(0))
    k = camera.intrinsics
    across = (np.arange(k.width) - k.cx) / k.fx
    down = ((np.arange(k.height) - k.cy) / k.fy)[:, None]
    with np.errstate(divide="ignore"):
        floor = np.where(down > 0.0, 0.9 / down, np.inf)
        ceiling = np.where(down < 0.0, (HEIGHT - 0.9) / -down, np.inf)
        sides = HALF_Y / np.abs(across)
    truth = np.minimum(np.minimum(HALF_X, sides), np.minimum(floor, ceiling))
    assert np.abs(image.true_depth_m - truth).max() < 1e-3


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
@pytest.mark.parametrize("depth_m", [1.0, 2.0, 3.3])
def test_depth_noise_grows_with_the_square(camera: CameraModel, depth_m: float) -> None:
    camera = replace(camera, faults=NO_FAULTS)
    image = render_rgbd(ROOM, camera_at(HALF_X - depth_m, 0.0, 0.9, 0.0), camera, np.random.default_rng(5))
    wall = np.abs(image.true_depth_m - depth_m) < 1e-4
    error = (image.depth_m - image.true_depth_m)[wall]
    noise = math.hypot(camera.disparity_sigma_px, camera.disparity_step_px / math.sqrt(12.0))
    sigma = depth_m**2 / camera.focal_baseline_px_m * noise
    assert error.std() == pytest.approx(sigma, rel=0.06)
    # Only the depths of whole disparity steps occur, rounded to the stored unit.
    levels = np.unique(image.depth_m[wall]).astype(float)
    steps = np.round(camera.focal_baseline_px_m / levels / camera.disparity_step_px)
    whole = camera.focal_baseline_px_m / (steps * camera.disparity_step_px)
    assert np.abs(whole - levels).max() <= 0.5001 * camera.depth_unit_m


def test_fields_of_view_and_sizes_are_the_data_sheets() -> None:
    def fov(camera: CameraModel) -> tuple[float, float]:
        k = camera.intrinsics
        return (
            math.degrees(2.0 * math.atan(0.5 * k.width / k.fx)),
            math.degrees(2.0 * math.atan(0.5 * k.height / k.fy)),
        )

    assert fov(KINECT_V1) == pytest.approx((57.0, 43.0))
    assert fov(XTION_PRO_LIVE) == pytest.approx((58.0, 47.0), abs=1.0)
    assert fov(REALSENSE_D435I) == pytest.approx((69.0, 42.0), abs=0.5)
    assert [lidar.beams for lidar in LIDARS] == [400, 682, 181]
    assert HOKUYO_URG_04LX.step_rad * 681 == pytest.approx(4.1847)
    assert RPLIDAR_A2.step_rad * RPLIDAR_A2.beams == pytest.approx(2.0 * math.pi)


def test_the_same_seed_gives_the_same_bytes() -> None:
    x, y, yaw = HOME.start_xy_yaw
    camera, lidar = camera_at(x, y, 0.9, yaw + 1.0), at(x, y, 0.3, yaw)
    one, same, other = (
        render_rgbd(FURNISHED, camera, XTION_PRO_LIVE, np.random.default_rng(s), (x + 1.5, y))
        for s in (1, 1, 2)
    )
    assert one.color.tobytes() == same.color.tobytes() != other.color.tobytes()
    assert one.depth_m.tobytes() == same.depth_m.tobytes() != other.depth_m.tobytes()
    assert one.fault.tobytes() == same.fault.tobytes()
    scans = [scan_lidar(FURNISHED, lidar, RPLIDAR_A2, np.random.default_rng(s)) for s in (1, 1, 2)]
    assert scans[0].ranges_m.tobytes() == scans[1].ranges_m.tobytes() != scans[2].ranges_m.tobytes()


def test_two_views_of_a_wall_show_the_same_picture() -> None:
    quiet = replace(REALSENSE_D435I, color_sigma=0.0, faults=NO_FAULTS)
    near = render_rgbd(ROOM, camera_at(0.0, 0.0, 0.9, 0.0), quiet, np.random.default_rng(0)).color
    moved = render_rgbd(ROOM, camera_at(0.0, 0.2, 0.9, 0.0), quiet, np.random.default_rng(0)).color
    # 0.2 m to the left, on a wall 2 m away: 46.56 pixels of 465.6; compare the whole columns between.
    shift = 0.2 * quiet.intrinsics.fx / 2.0
    a, b = near[100:250, 200:400].astype(float), moved[100:250]
    best = min(np.abs(a - b[:, 200 + s : 400 + s]).mean() for s in (math.floor(shift), math.ceil(shift)))
    wrong = np.abs(a - b[:, 215:415]).mean()
    assert best < 0.35 * wrong
    assert a.std() > 8.0


def test_images_hold_enough_corners_for_orb() -> None:
    import cv2

    x, y, yaw = HOME.start_xy_yaw
    for turn in np.linspace(0.0, 2.0 * math.pi, 6, endpoint=False):
        color = render_rgbd(
            FURNISHED, camera_at(x, y, 0.9, yaw + turn), XTION_PRO_LIVE, np.random.default_rng(0)
        ).color
        assert len(cv2.ORB_create(1000).detect(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))) > 150


def test_a_person_is_a_cylinder() -> None:
    scan = scan_lidar(
        ROOM, at(-1.0, 0.0, 0.3, 0.0), exact(SICK_LMS_180), np.random.default_rng(0), (0.5, 0.0)
    )
    assert scan.ranges_m[90] == pytest.approx(1.25, abs=1e-3)
    half_angle = math.degrees(math.asin(0.25 / 1.5))
    assert np.count_nonzero(scan.fault == Fault.PERSON) == 2 * math.floor(half_angle) + 1
    rays = np.array(
        [
            [-1.0, 0.0, 0.3, 1.0, 0.0, 0.0],
            [-1.0, 0.0, 1.75, 1.0, 0.0, 0.0],  # over the head
            [-1.0, 0.0, 2.2, 1.0, 0.0, -0.35],  # from above on to the head
            [-1.0, 0.0, 0.3, -1.0, 0.0, 0.0],  # away
            [0.5, 0.1, 0.3, 1.0, 0.0, 0.0],  # from inside
        ],
        dtype=np.float32,
    )
    hits = ROOM.cast(rays, (0.5, 0.0))
    assert (hits.obstacle == PERSON).tolist() == [True, False, True, False, False]
    assert hits.range_m[2] == pytest.approx(0.5 / 0.35, abs=1e-4)
    np.testing.assert_allclose(hits.normal[[0, 2]], [[-1, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(ROOM.cast(rays).obstacle >= 0, True)


def test_the_person_is_met_from_every_side() -> None:
    # In the open, so that only the person is met: the surface where it says, and nothing of it before.
    center, rng = np.array([40.3, -30.2]), np.random.default_rng(4)
    bearings = rng.uniform(-math.pi, math.pi, 500)
    origins = center + 2.0 * np.column_stack([np.cos(bearings), np.sin(bearings)])
    aims = center + rng.uniform(-0.35, 0.35, (500, 2)) - origins
    rays = np.column_stack([origins, np.full(500, 1.0), aims, np.zeros(500)]).astype(np.float32)
    hits = ROOM.cast(rays, (40.3, -30.2))
    along = (aims * (center - origins)).sum(axis=1) / (aims**2).sum(axis=1)
    missed_by = np.linalg.norm(origins + along[:, None] * aims - center, axis=1)
    clear = np.abs(missed_by - 0.25) > 1e-3
    np.testing.assert_array_equal((hits.obstacle == PERSON)[clear], missed_by[clear] < 0.25)
    met = hits.obstacle == PERSON
    points = origins[met] + hits.range_m[met, None] * aims[met]
    np.testing.assert_allclose(np.linalg.norm(points - center, axis=1), 0.25, atol=2e-4)
    assert ((hits.normal[met, :2] * aims[met]).sum(axis=1) < 0.0).all()


def test_rays_that_meet_nothing_and_no_rays_at_all() -> None:
    away = np.array([[0.0, 0.0, 9.0, 0.0, 0.0, 1.0]], dtype=np.float32)
    hits = ROOM.cast(away)
    assert np.isposinf(hits.range_m[0]) and hits.triangle[0] == NOTHING and hits.obstacle[0] == NOTHING
    assert ROOM.cast(np.empty((0, 6), dtype=np.float32)).range_m.size == 0


def test_a_ring_lidar_sees_walls_floor_and_ceiling() -> None:
    model = replace(VLP_16, sigma_m=0.0, resolution_m=1e-6, faults=NO_FAULTS)
    pose = at(0.3, -0.2, 0.7, 0.5)
    cloud = scan_lidar_3d(ROOM, pose, model, np.random.default_rng(0))
    assert len(cloud.points_laser) == 16 * 1800 == len(cloud.ring)
    world = cloud.points_laser @ pose.rotation().matrix().T + pose.translation()
    from_walls = np.minimum(HALF_X - np.abs(world[:, 0]), HALF_Y - np.abs(world[:, 1]))
    from_all = np.minimum(from_walls, np.minimum(world[:, 2], HEIGHT - world[:, 2]))
    assert np.abs(from_all).max() < 1e-3
    assert (np.diff(cloud.time_s) >= 0.0).all() and cloud.time_s[-1] < 1.0 / model.rate_hz
    noisy = scan_lidar_3d(ROOM, pose, replace(VLP_16, faults=NO_FAULTS), np.random.default_rng(0))
    error = np.linalg.norm(noisy.points_laser, axis=1) - noisy.true_ranges_m
    assert error.std() == pytest.approx(0.03, rel=0.03)


def test_cameras_of_the_panorama_lie_on_their_sides() -> None:
    rig = RIGS["xu2024"]
    forward = {camera.name: camera.T_base_camera.rotation().matrix()[:, 2] for camera in rig.cameras}
    yaws = {name: round(math.degrees(math.atan2(axis[1], axis[0]))) for name, axis in forward.items()}
    assert yaws == {"RGBD_1": -45, "RGBD_2": -90, "RGBD_3": 45, "RGBD_4": 0}
    for camera in rig.cameras:
        assert camera.T_base_camera.z() == pytest.approx(0.92)
        # The image's right edge is up, so a turn of 90 degrees counter-clockwise makes it upright.
        np.testing.assert_allclose(camera.T_base_camera.rotation().matrix()[:, 0], [0, 0, 1], atol=1e-9)
    upright = np.rot90(
        render_rgbd(ROOM, rig.cameras[3].T_base_camera, XTION_PRO_LIVE, np.random.default_rng(0)).true_depth_m
    )
    assert upright.shape == (320, 240)
    assert upright[-1, 120] < upright[0, 120]  # the floor, 0.92 m below, is nearer than the ceiling


@pytest.mark.parametrize("name", sorted(RIGS))
def test_every_rig_sees_something(name: str) -> None:
    rig = RIGS[name]
    rng = np.random.default_rng(0)
    base = at(*HOME.start_xy_yaw[:2], 0.0, 0.3)
    if rig.lidar:
        scan = scan_lidar(FURNISHED, base.compose(rig.lidar.T_base_laser), rig.lidar.model, rng)
        assert np.isfinite(scan.ranges_m).mean() > 0.5
    for camera in rig.cameras[:1]:
        image = render_rgbd(FURNISHED, base.compose(camera.T_base_camera), camera.model, rng)
        assert (image.depth_m > 0.0).mean() > 0.1
        np.testing.assert_array_equal(image.depth_m > 0.0, ~np.isin(image.fault, range(1, 8)))
    assert rig.lidar or rig.cameras
