"""Pictures of the concepts for the gallery: each calls the code that it explains, and draws the result."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from gallery_maps import INK, TRUTH, Work, aligned, layer, painted, small, window
from PIL import Image

import fusion
import slam
from slam.evaluation.figure_parts import BLUE, GREEN, ORANGE, RED, figure_of
from slam.mapping.occupancy_grid import OCCUPIED
from slam.matching.planar import compose, transform_points
from slam.measurements import AnyFloatArray, FloatArray, row_from_pose2

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS_95 = 2.4477  # radius of the 95 % ellipse of two dimensions, in standard deviations
# Error of the initial guess in the picture of a match: x, y, yaw.
GUESS_OFF = np.array([0.25, -0.15, 0.12])
BEGUN_S = 20.0  # start of the robot of the other day


def panels(count: int, width_px: int = 1500, height_px: int = 520) -> tuple[Figure, list[Axes]]:
    """Square drawings side by side, in metres, without axes."""
    figure = figure_of(width_px, height_px)
    found = []
    for number in range(count):
        axes = figure.add_axes((number / count + 0.008, 0.02, 1 / count - 0.016, 0.88))
        axes.set_aspect("equal")
        axes.set_axis_off()
        found.append(axes)
    return figure, found


def titled(axes: Axes, title: str) -> None:
    """Add a title of one line above a drawing."""
    axes.set_title(title, fontsize=13, color=INK, loc="left")


def dots(axes: Axes, points: AnyFloatArray, color: str, size: float = 3.0) -> None:
    """(N, 2) points."""
    axes.plot(points[:, 0], points[:, 1], ".", color=color, markersize=size, markeredgewidth=0)


def ellipse(axes: Axes, center: FloatArray, covariance: FloatArray, color: str, scale: float = 1.0) -> None:
    """The 95 % ellipse of a (2, 2) covariance, drawn larger by ``scale``."""
    values, vectors = np.linalg.eigh(covariance)
    around = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(around), np.sin(around)])
    rim = (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle
    axes.plot(*(center[:, None] + scale * SIGMAS_95 * rim), color=color, linewidth=1.6)


def robot(axes: Axes, pose: FloatArray, color: str, length_m: float = 0.5) -> None:
    """Draw the pose of a robot."""
    tip = pose[:2] + length_m * np.array([np.cos(pose[2]), np.sin(pose[2])])
    axes.plot(*np.stack([pose[:2], tip], axis=1), color=color, linewidth=2.4)
    axes.plot(*pose[:2], "o", color=color, markersize=8)


def factors(work: Work) -> Image.Image:
    """A scan before and after matching, and one in a corridor with its covariance."""
    house = slam.load_map(work.visited)
    last = 12
    scans = [scan for scan in house.keyframe_scans[: last + 1] if scan is not None]
    poses = house.keyframe_poses[: last + 1]
    house.close()
    guess = compose(poses[last], GUESS_OFF)
    known = np.concatenate(
        [in_frame(scan, pose) for scan, pose in zip(scans[:last], poses[:last], strict=True)]
    )
    motion = slam.match_scans(scans[:last], scans[last], guess, reference_poses=poses[:last])
    found = row_from_pose2(motion.T_reference_base)
    figure, (before, after, corridor) = panels(3)
    for axes, pose, color in ((before, guess, ORANGE), (after, found, BLUE)):
        dots(axes, known, "#8a96a3", 4.0)
        dots(axes, in_frame(scans[last], pose), color, 5.0)
        robot(axes, pose, color)
        near(axes, found[:2] - (0.5, 0.8), 3.6)
    off_m, off_deg = np.hypot(*GUESS_OFF[:2]), np.degrees(GUESS_OFF[2])
    titled(before, f"The guess is {100 * off_m:.0f} cm and {off_deg:.0f} degrees off")
    sigma_mm = 1000 * np.sqrt(np.diag(motion.covariance)[:2].max())
    titled(after, f"Aligned to the local map: sigma {sigma_mm:.1f} mm, {motion.inlier_share:.0%} fit")
    draw_corridor(corridor)
    return small(figure)


def draw_corridor(axes: Axes) -> None:
    """Two scans of an empty corridor, and the covariance of their match."""
    bearings_rad = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    ranges_m = 0.9 / np.maximum(np.abs(np.sin(bearings_rad)), 1e-9)
    ranges_m[ranges_m > 4.5] = np.inf
    scan = slam.LaserScan(0.0, ranges_m.astype(np.float32), -np.pi, np.pi / 180, 8.0)
    motion = slam.match_scans(scan, scan)
    dots(axes, scan.points_laser(), BLUE, 5.0)
    robot(axes, np.zeros(3), BLUE)
    ellipse(axes, np.zeros(2), motion.covariance[:2, :2], RED)
    near(axes, np.zeros(2), 3.6)
    along_m, across_m = np.sqrt(np.diag(motion.covariance)[:2])
    titled(axes, f"A corridor: sigma {along_m:.0f} m along it (red), {1000 * across_m:.1f} mm across")


def in_frame(scan: slam.LaserScan, pose: FloatArray) -> FloatArray:
    """(N, 2) points of a scan that was taken at a pose of the base."""
    return transform_points(scan.points_laser(), compose(pose, row_from_pose2(scan.T_base_laser)))


def near(axes: Axes, center: FloatArray, reach_m: float) -> None:
    """Show a square about a point."""
    axes.set_xlim(center[0] - 1.05 * reach_m, center[0] + 1.05 * reach_m)
    axes.set_ylim(center[1] - reach_m, center[1] + reach_m)


def loops(work: Work) -> Image.Image:
    """A campus without loops and with them; the accepted loops."""
    figure, drawn = panels(2, height_px=640)
    for axes, taken in zip(drawn, (False, True), strict=True):
        house = slam.load_map(work.campus(loops=taken))
        way, true_way, rmse_m = aligned(house, work.folder / "campus")
        poses, candidates = house.keyframe_poses, house.loops
        house.close()
        axes.plot(*true_way.T, color=TRUTH, linewidth=5.0)
        axes.plot(*way.T, color=BLUE, linewidth=1.2)
        kept = [loop for loop in candidates if loop.accepted]
        if taken:
            title = f"{len(kept)} loops (red) of {len(candidates)} candidates, {rmse_m:.2f} m RMSE"
            for loop in kept:
                axes.plot(*poses[[loop.place, loop.keyframe], :2].T, color=RED, linewidth=2.5)
        else:
            title = f"Steps alone, {rmse_m:.1f} m RMSE (green: the true way)"
        titled(axes, title)
    return small(figure)


def repair(_: Work) -> Image.Image:
    """The end of a corridor seen by lidar and camera, before and after they have repaired each other."""
    rng = np.random.default_rng(3)
    bearings_rad = np.radians(np.arange(-90.0, 90.0, 0.5))
    wall_m = np.where(bearings_rad < 0.0, 1.2, 0.8)
    true_m = np.minimum(3.0 / np.cos(bearings_rad), wall_m / np.abs(np.sin(bearings_rad) + 1e-9))
    ranges_m = true_m + rng.normal(0.0, 0.008, true_m.size)
    holes, legs = np.array([150, 172, 173, 190, 205]), np.array([160, 181, 198])
    ranges_m[holes] = np.nan
    ranges_m[legs] -= 0.8
    scan = fusion.LidarCurve(ranges_m, -np.pi / 2, np.radians(0.5), 20.0)
    x_over_z = (np.arange(320) - 159.5) / 260.0
    depth_m = np.minimum(3.0, np.where(x_over_z > 0.0, 1.2, 0.8) / np.abs(x_over_z))
    image_m = np.tile(depth_m.astype(np.float32), (240, 1))
    depth = fusion.DepthImage(image_m, fusion.Intrinsics(260.0, 260.0, 159.5, 119.5))
    pair = fusion.register(scan, depth)
    repaired = fusion.denoise(scan, depth, pair)
    figure, (before, after) = panels(2, 1300, 360)
    seen = np.stack([x_over_z * depth_m, depth_m], axis=1)
    for axes, values_m in ((before, ranges_m), (after, repaired.ranges_m)):
        points = values_m[:, None] * np.stack([-np.sin(bearings_rad), np.cos(bearings_rad)], axis=1)
        dots(axes, seen, "#f0c9a0", 7.0)
        dots(axes, points, BLUE, 5.0)
        dots(axes, points[legs], RED, 10.0)
        dots(axes, points[holes], GREEN, 12.0)
        axes.set_xlim(-1.5, 1.5)
        axes.set_ylim(1.9, 3.2)
    titled(
        before, f"Lidar (blue) with {len(holes)} holes and {len(legs)} legs of a chair (red); depth (orange)"
    )
    filled = int(np.isfinite(repaired.ranges_m[holes]).sum())
    titled(after, f"{filled} holes are filled (green); what the lidar alone sees stays")
    return small(figure)


def layers(work: Work) -> Image.Image:
    """The lidar layer and the camera layer of a home, and the navigation map."""
    found = {name: layer(work.home, name) for name in ("lidar", "depth", "decision")}
    seen = window(*(one.values for one in found.values()))
    figure, drawn = panels(3)
    head = ("Lidar, at its own height", "Cameras, over the robot's height", "Both: what a robot may drive by")
    for axes, name, title in zip(drawn, found, head, strict=True):
        values = found[name].values
        image = painted(values)
        if name == "decision":
            image[(found["lidar"].values != OCCUPIED) & (values == OCCUPIED)] = (217, 115, 13)
        axes.imshow(image[seen], origin="lower", interpolation="nearest")
        titled(axes, title)
    return small(figure)


def localisation(work: Work) -> Image.Image:
    """Localisation on another day: hypotheses at the start, and the path once localised."""
    house = slam.load_map(work.visited)
    localizer = slam.Localizer(house)
    log = list(slam.open_dataset(work.visit(2)))
    way: list[FloatArray] = []
    outputs = [
        localizer.add(measurement) for measurement in log if measurement.stamp_s > log[0].stamp_s + BEGUN_S
    ]
    done = [output for output in outputs if output is not None]
    for output in done:
        if output.state is slam.State.TRACKING and output.pose is not None:
            way += [row_from_pose2(past.pose) for past in output.recovered] + [row_from_pose2(output.pose)]
    found_s = next(output.stamp_s for output in done if output.state is slam.State.TRACKING) - done[0].stamp_s
    figure, (search, track) = panels(2, 1300, 620)
    for axes in (search, track):
        draw_walls(axes, house)
    house.close()
    for one in done[0].hypotheses:
        robot(search, row_from_pose2(one.pose), ORANGE, 0.6)
    share = max(one.probability for one in done[0].hypotheses)
    titled(search, f"The first scan: here with {share:.0%}; else elsewhere, or in no map")
    track.plot(*np.array(way)[:, :2].T, color=BLUE, linewidth=1.6)
    titled(track, f"Found after {found_s:.1f} s; the way before is known then, too")
    return small(figure)


def draw_walls(axes: Axes, house: slam.Map) -> None:
    """The grid of a map, in metres."""
    grid = house.grid
    assert grid is not None
    states, corner = grid.states(), grid.T_map_grid
    size_m = grid.resolution_m * np.array(states.shape)
    extent = (corner.x(), corner.x() + size_m[1], corner.y(), corner.y() + size_m[0])
    axes.imshow(painted(states), origin="lower", extent=extent, interpolation="nearest")
    rows, columns = window(states)
    axes.set_xlim(*(corner.x() + grid.resolution_m * np.array([columns.start, columns.stop])))
    axes.set_ylim(*(corner.y() + grid.resolution_m * np.array([rows.start, rows.stop])))


def uncertainty(work: Work) -> Image.Image:
    """The path through the campus, and its uncertainty."""
    house = slam.load_map(work.campus(loops=True))
    covariances, stamps_s = house.covariances, house.trajectory.stamps_s
    positions_m = house.trajectory.positions_m[:, :2]
    poses = house.keyframe_poses
    house.close()
    assert covariances is not None
    figure, (axes,) = panels(1, 1100, 640)
    axes.plot(*positions_m.T, color=BLUE, linewidth=1.2)
    scale = 3.0
    for row in range(0, len(stamps_s), len(stamps_s) // 70):
        ellipse(axes, positions_m[row], covariances[row, :2, :2], ORANGE, scale)
    robot(axes, poses[0], GREEN, 5.0)
    titled(
        axes, f"95 % ellipses of the position, drawn {scale:.0f} times as large; green: the pose that is held"
    )
    return small(figure)
