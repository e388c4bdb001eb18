"""One recording packed as each layout of a camera, and as bags: each must give the original's trajectory.

    PYTHONPATH=. python tools/layout_equivalence.py ../shared/data/rgbd/redkitchen -o DIR [NAME ...]

Maps the original and each packing by the default settings, and prints how far positions and headings of the
same frames are apart. Layouts of JPEG hold other colours than the original: they are compared with a packing
in the layout of TUM with the colours that JPEG leaves.
"""

from __future__ import annotations

import shutil
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import slam
from slam.datasets import open_dataset
from slam.estimates import Trajectory
from slam.measurements import RgbdFrame
from tools.pack_layouts import CAMERAS, Footage, packed
from tools.pack_scenes import SCENES
from tools.rgbd_bags import PACKINGS, write_rgbd_bag


def bag(folder: Path, footage: Footage, packing: str) -> Path:
    """Footage as a bag."""
    frames = [
        RgbdFrame(stamp_s, color, depth_mm.astype(np.float32) / 1000.0, footage.lens)
        for stamp_s, color, depth_mm in zip(footage.stamps_s, footage.colors, footage.depths_mm, strict=True)
    ]
    folder.mkdir(parents=True)
    return write_rgbd_bag(folder, packing, frames)


LAYOUTS = CAMERAS | SCENES | {packing: partial(bag, packing=packing) for packing in PACKINGS}
JPEG = frozenset(
    {"three_r_scan", "scannet", "scannet_sens", "replica", "open3d", "sun3d", "record3d", "polycam"}
)


def footage_of(path: Path, count: int) -> Footage:
    """The first frames of a recording with a truth for each."""
    dataset = open_dataset(path)
    frames = list(islice((one for one in dataset if isinstance(one, RgbdFrame)), count))
    truth = dataset.groundtruth()
    assert truth is not None
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(truth.quaternions_xyzw[: len(frames)]).as_matrix()
    poses[:, :3, 3] = truth.positions_m[: len(frames)]
    depths = [np.rint(frame.depth_m * 1000.0).astype(np.uint16) for frame in frames]
    stamps = [frame.stamp_s for frame in frames]
    return Footage(stamps, [frame.color for frame in frames], depths, list(poses), frames[0].intrinsics)


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
    turns = [Rotation.from_quat(way.quaternions_xyzw) for way in (first, second)]
    since_first = [turn * turn[0].inv() for turn in turns]
    return distance_m, float((since_first[0].inv() * since_first[1]).magnitude().max())


def main() -> None:
    """Pack, map, compare."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
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
