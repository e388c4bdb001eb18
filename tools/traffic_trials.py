"""What traffic leaves in a 3D lidar's cloud, and what is lost of things that stand.

    python tools/traffic_trials.py MAP [--boxes FILE]      # a real map, by boxes marked by hand
    python tools/traffic_trials.py MAP --street FOLDER     # of ``scanweave simulate --street --undistorted``

The boxes of ``tools/city_boxes.csv`` are of the city's 80 scans. They were drawn by hand over clouds of
keyframes seen from above, coloured by height: a centre and a yaw in the lidar's frame, a moving one then
drawn in to 0.1 m around its points 0.2 m over the ground and higher. A moving one is of the points of its
keyframe, and none where that cloud is no keyframe; a fixed one of those of all.

Left and lost are shares of points, and of voxels of 10 cm.
"""

from __future__ import annotations

import csv
import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import gtsam
import numpy as np

from slam.config import Config
from slam.mapping.cloud_map import CloudTiles
from slam.mapping.cloud_passers_by import PassedBy, passed_by
from slam.mapping.elevation import elevation
from slam.matching.local_cloud import moved
from slam.measurements import FloatArray, spatial
from slam.outputs.finished_map import load_map
from slam.simulation.street_mesh import Label
from slam.storage.map_contents import MapContents

_VOXEL_M = 0.1
_SAME_S = 0.02  # stamps of a box and of its keyframe
_Marked = Iterator[tuple[str, str, FloatArray]]  # whether it moves, what it is, points in the map


def main() -> None:
    """Print one Markdown table."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("--boxes", type=Path, default=Path(__file__).with_name("city_boxes.csv"))
    parser.add_argument("--street", type=Path, help="the recording, with its labels")
    arguments = parser.parse_args()
    with closing(load_map(arguments.map)) as saved:
        found = saved.contents
        gone = looked_through(found, Config())
        marked = labelled(arguments.street, found) if arguments.street else boxed(arguments.boxes, found)
        print("| | points | gone | voxels | gone |\n|---|---|---|---|---|")
        sums = {"moving": np.zeros(4, int), "fixed": np.zeros(4, int)}
        for kind, what, points in marked:
            row = scored(points, gone)
            sums[kind] += row
            if not arguments.street:
                print(line(f"{kind}: {what}", row))
        for kind, row in sums.items():
            print(line(f"**{kind}**", row))


def looked_through(found: MapContents, config: Config) -> PassedBy:
    """What the map's cloud goes without."""
    poses, clouds = [spatial(pose) for pose in found.node_poses], found.clouds
    assert clouds is not None
    assert found.ground_m is not None
    ground = elevation(clouds, poses, found.ground_m, config.cloud_map.plan_range_m)
    assert ground is not None
    with tempfile.TemporaryFile() as file:
        tiles = CloudTiles(clouds, poses, config.grid.resolution_m, file)
        reach_m = config.cloud_odometry.range_max_m
        return passed_by(tiles.points(), tiles.seen(), poses, found.T_base_lidar, ground, reach_m)


def boxed(path: Path, found: MapContents) -> _Marked:
    """The points in boxes of a table."""
    poses, clouds = [spatial(pose) for pose in found.node_poses], list(found.clouds or ())
    way, stamps_s = found.trajectory.poses(), found.trajectory.stamps_s
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            at = int(np.argmin(np.abs(stamps_s - float(row["stamp_s"]))))
            if abs(stamps_s[at] - float(row["stamp_s"])) > _SAME_S:
                raise SystemExit(f"no cloud at {row['stamp_s']} s: this is another log")
            own = np.flatnonzero(np.abs(found.stamps_s - stamps_s[at]) <= _SAME_S).tolist()
            middle, size = (
                np.array([float(row[name]) for name in names])
                for names in (("x_m", "y_m", "z_m"), ("length_m", "width_m", "height_m"))
            )
            T_lidar_box = gtsam.Pose3(gtsam.Rot3.Yaw(np.radians(float(row["yaw_deg"]))), middle)
            T_map_box = way[at].compose(found.T_base_lidar).compose(T_lidar_box)
            inside = [np.zeros((0, 3))]
            for one in own if row["kind"] == "moving" else range(len(clouds)):
                points = moved(clouds[one], T_map_box.inverse().compose(poses[one]))
                inside.append(moved(points[(np.abs(points) < 0.5 * size).all(axis=1)], T_map_box))
            yield row["kind"], f"{row['what']}, {row['stamp_s']} s", np.concatenate(inside)


def labelled(folder: Path, found: MapContents) -> _Marked:
    """The points of a simulated recording's keyframes as they were measured, by what they are on."""
    for pose, reading in zip(found.node_poses, found.readings.tolist(), strict=True):
        points = np.fromfile(folder / "velodyne" / f"{reading:06d}.bin", "<f4").reshape(-1, 4)[:, :3]
        labels = np.fromfile(folder / "labels" / f"{reading:06d}.label", "<u4") & 0xFFFF
        placed = moved(points.astype(np.float64), spatial(pose).compose(found.T_base_lidar))
        moves = labels >= Label.MOVING_CAR
        yield "moving", str(reading), placed[moves]
        yield "fixed", str(reading), placed[~moves]


def scored(points: FloatArray, gone: PassedBy) -> np.ndarray:
    """Points and how many have gone, voxels and how many have gone whole."""
    out = gone.holds(points)
    voxels, stay = (
        len(np.unique(np.floor(some / _VOXEL_M).astype(np.int64), axis=0)) for some in (points, points[~out])
    )
    return np.array([len(points), np.count_nonzero(out), voxels, voxels - stay])


def line(what: str, row: np.ndarray) -> str:
    """A row of the table."""
    points, out, voxels, empty = row
    return f"| {what} | {points} | {out / max(points, 1):.2%} | {voxels} | {empty / max(voxels, 1):.2%} |"


if __name__ == "__main__":
    main()
