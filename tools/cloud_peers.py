"""Compare Scanweave with KISS-ICP and small_gicp on the same clouds of a 3D lidar: CPU, memory, sharpness.

    python tools/cloud_peers.py FOLDER [--repeat N]      a KITTI folder (velodyne/*.bin, times.txt)

Scanweave runs the whole command with all its output files; the others are odometry only, each with one thread
and its own settings (KISS-ICP 1.3: voxels of a hundredth of the range; small_gicp, if installed: voxels of 1
m, clouds thinned to 0.25 m). Runs alternate, and the minimum CPU time counts. Sharpness of a map is the mean
distance of points of every second cloud from planes fitted to the others, in voxels of 1 m.
"""

# Only the standard library here, because a child starts with its parent's peak memory.
from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

REPO = Path(__file__).parents[1]
METHODS = ("scanweave", "kiss_icp", "small_gicp")
_RANGE_M = 100.0


def main() -> None:
    """Measure and print one row per method."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--child", choices=[*METHODS, "sharpness"], help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        CHILDREN[options.child](options.folder, options.out)
        return
    print("| | CPU s | peak MB | mean distance from planes, mm (points on planes) |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        costs: dict[str, list[tuple[float, float]]] = {name: [] for name in METHODS}
        for _ in range(options.repeat):
            for name in METHODS:
                cost = child(name, options.folder, Path(folder) / name)
                costs[name] += [] if cost is None else [cost]
        for name, measured in costs.items():
            if measured:
                cpu_s, peak_mb = min(cpu for cpu, _ in measured), max(peak for _, peak in measured)
                print(f"| {name} | {cpu_s:.1f} | {peak_mb:.0f} | ", end="", flush=True)
                child("sharpness", options.folder, Path(folder) / name)


def child(name: str, folder: Path, out: Path) -> tuple[float, float] | None:
    """CPU seconds and peak memory of a method from the kernel; None if it is not installed."""
    command = [sys.executable, __file__, str(folder), "--child", name, "--out", str(out)]
    # Installed packages have bytecode; compiling all sources again would take 2 CPU seconds.
    kept = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPO), "PYTHONDONTWRITEBYTECODE": ""}
    process = subprocess.Popen(command, env={**os.environ, **kept})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return None if process.returncode else (usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0)


def scanweave(folder: Path, out: Path) -> None:
    """Run the whole command."""
    from slam.cli import main as command

    sys.argv = ["scanweave", "map", str(folder), "-o", str(out), "--force", "--quiet"]
    command()


def kiss_icp(folder: Path, out: Path) -> None:
    """KISS-ICP's odometry."""
    import numpy as np
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.registration.max_num_threads = 1
    config.data.deskew = False
    config.mapping.voxel_size = 0.01 * config.data.max_range
    odometry, poses = KissICP(config), []
    for points in clouds(folder):
        odometry.register_frame(points, np.zeros(0))
        poses.append(odometry.last_pose.copy())
    np.save(out.with_suffix(".npy"), np.array(poses))


def small_gicp(folder: Path, out: Path) -> None:
    """small_gicp, each cloud against a voxel map of those before."""
    try:
        import small_gicp as gicp
    except ImportError:
        sys.exit(1)
    import numpy as np

    voxels = gicp.GaussianVoxelMap(1.0)
    voxels.set_lru(horizon=100, clear_cycle=10)
    pose, step, poses = np.eye(4), np.eye(4), list[object]()
    for points in clouds(folder):
        near = points[np.einsum("ij,ij->i", points, points) < _RANGE_M**2]
        cloud, _ = gicp.preprocess_points(near, 0.25, num_threads=1)
        if poses:
            limits = {"max_correspondence_distance": 1.0, "num_threads": 1}
            found = gicp.align(voxels, cloud, pose @ step, **limits).T_target_source
            pose, step = found, np.linalg.inv(pose) @ found
        voxels.insert(cloud, pose)
        poses.append(pose.copy())
    np.save(out.with_suffix(".npy"), np.array(poses))


def sharpness(folder: Path, out: Path) -> None:
    """Print the distance of points of every second cloud from planes through the others."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from fusion.height_band import thin_to_voxels
    from slam.matching.plane_voxels import PlaneVoxels
    from slam.storage.tum import read_tum

    if out.is_dir():
        trajectory = read_tum(out / "trajectory.tum")
        poses = np.tile(np.eye(4), (len(trajectory), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(trajectory.quaternions_xyzw).as_matrix()
        poses[:, :3, 3] = trajectory.positions_m
    else:
        poses = np.load(out.with_suffix(".npy"))
    planes, others = PlaneVoxels(1.0, 0.2), []
    for number, (points, T) in enumerate(zip(clouds(folder), poses, strict=True)):
        near = points[np.einsum("ij,ij->i", points, points) < _RANGE_M**2]
        placed = thin_to_voxels(near, 0.25) @ T[:3, :3].T + T[:3, 3]
        if number % 2:
            others.append(placed)
        else:
            planes.add(placed)
    found = [planes.residuals(points, np.eye(4)).distances_m for points in others]
    distances_m = np.abs(np.concatenate(found))
    share = len(distances_m) / sum(len(points) for points in others)
    print(f"{1e3 * distances_m.mean():.2f} ({share:.3f}) |", flush=True)


def clouds(folder: Path):  # type: ignore[no-untyped-def]
    """(N, 3) points of each file."""
    import numpy as np

    for path in sorted((folder / "velodyne").glob("*.bin")):
        yield np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)


CHILDREN = {"scanweave": scanweave, "kiss_icp": kiss_icp, "small_gicp": small_gicp, "sharpness": sharpness}

if __name__ == "__main__":
    main()
