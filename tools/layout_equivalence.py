"""One recording packed as each layout of a camera: each must give the trajectory of the original.

    PYTHONPATH=. python tools/layout_equivalence.py ../shared/data/rgbd/redkitchen -o DIR [NAME ...]

Maps the original and each packing by the default settings, and prints how far positions and headings of the
same frames are apart. Layouts of JPEG hold other colours than the original: they are compared with a packing
in the layout of TUM with the colours that JPEG leaves.
"""

from __future__ import annotations

import argparse
import shutil
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

import slam
from slam.datasets import open_dataset
from slam.estimates import Trajectory
from slam.measurements import FloatArray, RgbdFrame
from tools.pack_layouts import CAMERAS, Footage, packed
from tools.pack_scenes import SCENES

LAYOUTS = CAMERAS | SCENES
JPEG = frozenset(
    {"three_r_scan", "scannet", "scannet_sens", "replica", "open3d", "sun3d", "record3d", "polycam"}
)


def footage_of(path: Path, count: int) -> Footage:
    """The first frames of a recording with a truth for each."""
    dataset = open_dataset(path)
    frames = list(islice((one for one in dataset if isinstance(one, RgbdFrame)), count))
    truth = dataset.groundtruth()
    assert truth is not None
    poses = []
    for position, (x, y, z, w) in zip(truth.positions_m[:count], truth.quaternions_xyzw[:count], strict=True):
        pose = np.eye(4)
        pose[:3, :3] = _turn(x, y, z, w)
        pose[:3, 3] = position
        poses.append(pose)
    depths = [np.rint(frame.depth_m * 1000.0).astype(np.uint16) for frame in frames]
    stamps = [frame.stamp_s for frame in frames]
    return Footage(stamps, [frame.color for frame in frames], depths, poses, frames[0].intrinsics)


def _turn(x: float, y: float, z: float, w: float) -> FloatArray:
    """The rotation of a unit quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def through_jpeg(footage: Footage) -> Footage:
    """With the colours that are left of JPEG at its best."""
    colors = []
    for color in footage.colors:
        left = cv2.imdecode(np.frombuffer(packed(color, ".jpg"), np.uint8), cv2.IMREAD_COLOR)
        assert left is not None
        colors.append(np.ascontiguousarray(left[..., ::-1]))
    return Footage(footage.stamps_s, colors, footage.depths_mm, footage.poses, footage.lens)


def mapped(path: Path) -> Trajectory:
    """The trajectory of a map."""
    return slam.map_log(path).trajectory


def apart(first: Trajectory, second: Trajectory) -> tuple[float, float]:
    """Largest distance of the same frames, and largest angle between their turns since the first.

    A turn in the frame of the map is that of the robot, however its camera is mounted.
    """
    assert len(first) == len(second), f"{len(first)} and {len(second)} poses"
    distance_m = float(np.abs(first.positions_m - second.positions_m).max())
    turns = (
        [_turn(*row) @ _turn(*way.quaternions_xyzw[0]).T for row in way.quaternions_xyzw]
        for way in (first, second)
    )
    cosines = [0.5 * (np.trace(a.T @ b) - 1.0) for a, b in zip(*turns, strict=True)]
    return distance_m, float(np.arccos(np.clip(cosines, -1.0, 1.0)).max())


def main() -> None:
    """Pack, map, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("layouts", nargs="*", default=list(LAYOUTS))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    sharp = footage_of(given.recording, given.frames)
    footage = {False: sharp, True: through_jpeg(sharp)}
    wanted = {
        lossy: mapped(CAMERAS["tum"](given.output / f"original_{lossy}", footage[lossy]))
        for lossy in sorted({name in JPEG for name in given.layouts})
    }
    print(f"{'layout':16} {'frames':>6} {'position mm':>12} {'turn mrad':>10}")
    for name in given.layouts:
        place = given.output / name
        path = LAYOUTS[name](place, sharp)
        trajectory = mapped(path)
        distance_m, turn_rad = apart(wanted[name in JPEG], trajectory)
        print(f"{name:16} {len(trajectory):6} {1e3 * distance_m:12.4f} {1e3 * turn_rad:10.4f}", flush=True)
        shutil.rmtree(place)


if __name__ == "__main__":
    main()
