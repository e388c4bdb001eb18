"""Trajectories in the format of the KITTI odometry benchmark: a 3 x 4 matrix per line, times in a file."""

from __future__ import annotations

from pathlib import Path

from slam.estimates import Trajectory
from slam.storage.files import write_lines


def write_kitti(path: Path, trajectory: Trajectory) -> list[Path]:
    """Write poses in the frame of the first one, row by row, and ``times.txt`` in seconds from the first.

    Beside ``NAME.txt`` these are ``NAME_times.txt``.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    poses = trajectory.poses()
    first = poses[0].inverse()
    rows = (first.compose(pose).matrix()[:3].ravel().tolist() for pose in poses)
    write_lines(path, (" ".join(f"{value:.9e}" for value in row) for row in rows))
    # Beside another name, there may be the times of a data set.
    times = path.with_name("times.txt" if path.name == "poses.txt" else f"{path.stem}_times.txt")
    begun_s = trajectory.stamps_s[0]
    write_lines(times, (f"{stamp_s - begun_s:.6e}" for stamp_s in trajectory.stamps_s.tolist()))
    return [path, times]
