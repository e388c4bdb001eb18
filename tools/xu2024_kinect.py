"""A half-real check: a real Kinect's noise, and a lidar curve cut from the mesh of all its frames.

The lidar is virtual: 7-Scenes has none. The frames are fused into a TSDF with their own poses; the curve is
cast through its mesh at a height below each camera, with a lidar's noise. Depth inserted by the repair is
compared with the mesh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from learn_repair_odds import RIGHT_PIXEL_M, by_rank, reliability
from numpy.typing import NDArray

import fusion
from fusion.panorama import native_slice
from slam.comparison.open3d_library import load_open3d
from slam.simulation.ray_caster import RayCaster

INTRINSICS = fusion.Intrinsics(585.0, 585.0, 320.0, 240.0)
EVERY, FRAMES, VOXEL_M = 5, 500, 0.015
BELOW_M = 0.25  # of the virtual lidar under the camera
BEAMS, APERTURE_RAD, REACH_M = 682, 4.1847, 5.6
NOISE_SHARE = 0.01
_TEST_EVERY = 10
_BAND_M = 0.03


def half_real_check(folder: Path) -> dict[str, float]:
    """Holes filled, their median error against the mesh, and what became of good readings."""
    down = _down(folder)
    scene = _mesh(folder)
    rng = np.random.default_rng(0)
    rig, kept = fusion.Rig(), []
    for index in range(0, FRAMES, _TEST_EVERY):
        depth, pose = _frame(folder, index)
        level = _level(pose, down)
        scan = _virtual_scan(scene, pose, level, rng)
        image = fusion.DepthImage(depth, INTRINSICS, level @ pose[:3, :3], range_max_m=4.5)
        rig.add(fusion.register(scan, image))
        kept.append((scan, image, _truth(scene, pose, depth.shape)))
    estimate = rig.estimate()
    assert estimate is not None
    filled, chances, replaced, odds, worse, holes, good, changed = [], [], [], [], 0, 0, 0, 0
    for scan, image, truth in kept:
        repaired = fusion.denoise(scan, image, estimate)
        source, after = repaired.depth_source[0], repaired.depth_m[0]
        was_hole = image.depth_m == 0.0
        new = (source == fusion.Provenance.FILLED) & np.isfinite(truth)
        filled.append(np.abs(after - truth)[new & was_hole])
        chances.append(repaired.depth_probability[0][new & was_hole])
        replaced.append(np.abs(after - truth)[new & ~was_hole])
        possible = fusion.denoise(scan, image, estimate, least_probability=0.0)
        put = (possible.depth_source[0] == fusion.Provenance.FILLED) & np.isfinite(truth)
        right = np.abs(possible.depth_m[0] - truth) <= RIGHT_PIXEL_M
        odds.append(np.column_stack([possible.depth_probability[0][put], right[put]]))
        on_plane = _on_plane(image, truth, estimate.height_m)
        holes += int((was_hole & on_plane).sum())
        fine = (np.abs(image.depth_m - truth) < _BAND_M) & on_plane
        good += int(fine.sum())
        changed += int((fine & new).sum())
        worse += int((fine & new & (np.abs(after - truth) > np.abs(image.depth_m - truth) + 0.05)).sum())
    errors, others, telling, sure = (np.concatenate(parts) for parts in (filled, replaced, odds, chances))
    print(f"half-real, predicted and true: {reliability(telling[:, 0].astype(float), telling[:, 1] > 0.5)}")
    print(f"half-real, tenths of what is filled: {by_rank(sure.astype(float), errors <= RIGHT_PIXEL_M)}")
    return {
        "frames": float(len(kept)),
        "height_found_m": estimate.height_m,
        "height_true_m": -BELOW_M,
        "yaw_found_deg": float(np.degrees(estimate.yaw_rad)),
        "holes_filled_pixels": float(errors.size),
        "holes_on_plane_pixels": float(holes),
        "holes_filled_off": float((errors > RIGHT_PIXEL_M).mean()) if errors.size else float("nan"),
        "replaced_pixels": float(others.size),
        "replaced_off": float((others > RIGHT_PIXEL_M).mean()) if others.size else float("nan"),
        "median_error_m": float(np.median(errors)) if errors.size else float("nan"),
        "good_pixels": float(good),
        "good_changed": changed / max(good, 1),
        "good_made_worse": worse / max(good, 1),
        "slice_readings": float(np.isfinite(native_slice(kept[0][1], estimate.height_m).ranges_m).sum()),
    }


def _frame(folder: Path, index: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Raw depth in metres, 0 in a hole, and the pose, made a rotation again."""
    import cv2

    raw = cv2.imread(str(folder / f"frame-{index:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
    assert raw is not None
    depth = np.where(raw == 65535, 0, raw).astype(np.float32) * np.float32(1e-3)
    pose = np.loadtxt(folder / f"frame-{index:06d}.pose.txt")
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    return depth, pose


def _down(folder: Path) -> NDArray[np.float64]:
    """Down in the world: given in the first camera."""
    numbers = (folder / "gravity-direction.txt").read_text(encoding="ascii").split()
    found = np.array([float(word) for word in numbers if _is_number(word)][:3])
    _, first = _frame(folder, 0)
    down = first[:3, :3] @ found
    return np.asarray(down / np.linalg.norm(down))


def _is_number(word: str) -> bool:
    """Whether a word can be read as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _level(pose: NDArray[np.float64], down: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) from the world to the level frame: z up, x where the camera looks."""
    up = -down
    ahead = pose[:3, 2] - (pose[:3, 2] @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up])


def _mesh(folder: Path) -> RayCaster:
    """A ray caster of the TSDF's mesh."""
    o3d = load_open3d()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1), (1)), VOXEL_M, 16, 20000
    )
    matrix = o3d.core.Tensor(
        [[INTRINSICS.fx, 0.0, INTRINSICS.cx], [0.0, INTRINSICS.fy, INTRINSICS.cy], [0.0, 0.0, 1.0]]
    )
    for index in range(0, FRAMES, EVERY):
        depth, pose = _frame(folder, index)
        image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(depth))
        extrinsic = o3d.core.Tensor(np.linalg.inv(pose))
        blocks = grid.compute_unique_block_coordinates(image, matrix, extrinsic, 1.0, 4.0)
        grid.integrate(blocks, image, matrix, extrinsic, 1.0, 4.0)
    mesh = grid.extract_triangle_mesh(weight_threshold=3.0)
    return RayCaster(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy())


def _cast(
    scene: RayCaster, origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.float32]:
    """(N,) distances in lengths of the directions, ``inf`` where nothing is."""
    return scene.cast(np.hstack([np.tile(origin, (len(directions), 1)), directions]).astype(np.float32))[0]


def _virtual_scan(
    scene: RayCaster, pose: NDArray[np.float64], level: NDArray[np.float64], rng: np.random.Generator
) -> fusion.LidarCurve:
    """A lidar under the camera, level, that looks the same way."""
    step = APERTURE_RAD / (BEAMS - 1)
    bearings = -0.5 * APERTURE_RAD + step * np.arange(BEAMS)
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(BEAMS)]) @ level
    ranges = _cast(scene, pose[:3, 3] - BELOW_M * level[2], directions)
    noisy = ranges * (1.0 + NOISE_SHARE * rng.standard_normal(BEAMS))
    return fusion.LidarCurve(noisy.astype(np.float32), -0.5 * APERTURE_RAD, step, REACH_M)


def _truth(scene: RayCaster, pose: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """(H, W) depth of the mesh."""
    col, row = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    rays = np.stack(
        [(col - INTRINSICS.cx) / INTRINSICS.fx, (row - INTRINSICS.cy) / INTRINSICS.fy, np.ones(shape)],
        axis=-1,
    ).reshape(-1, 3)
    return _cast(scene, pose[:3, 3], rays @ pose[:3, :3].T).reshape(shape)


def _on_plane(image: fusion.DepthImage, truth: NDArray[np.float32], height_m: float) -> NDArray[np.bool_]:
    """(H, W) pixels whose point in the mesh lies in the band about the lidar's plane."""
    rows, cols = np.indices(truth.shape)
    rays = np.stack(
        [
            (cols - INTRINSICS.cx) / INTRINSICS.fx,
            (rows - INTRINSICS.cy) / INTRINSICS.fy,
            np.ones(truth.shape),
        ],
        axis=-1,
    )
    depth = np.where(np.isfinite(truth), truth, 0.0)
    above = (rays @ image.R_level_camera[2]) * depth
    return (np.abs(above - height_m) < _BAND_M) & (depth > 0.0)
