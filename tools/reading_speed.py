"""What reading a log costs beside decoding its images or clouds alone, in CPU.

    PYTHONPATH=. python tools/reading_speed.py -o DIR [--repeats 5]

Frames of a room at 640 x 480 and turns of 64 x 1024 points are packed as folders and as bags. Alone means:
OpenCV on each image file, NumPy on each cloud, of bags the rosbags package before that. Passes take turns;
printed is the ratio of the fastest of each.
"""

from __future__ import annotations

import shutil
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

from slam.datasets import open_dataset
from slam.measurements import CameraIntrinsics, RgbdFrame
from tools.layouts import messages as ros
from tools.layouts.cameras import footage
from tools.layouts.lidars import ride
from tools.layouts.world import placed
from tools.pack_layouts import CAMERAS, Footage
from tools.pack_lidars import LIDARS, Turns
from tools.rgbd_bags import write_rgbd_bag

LENS = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
COUNT = 10


def images_alone(path: Path) -> None:
    """Each image file below a folder."""
    for file in sorted(path.rglob("*")):
        if file.suffix in (".png", ".jpg"):
            decoded(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))


def decoded(pixels: Any) -> Any:
    """RGB, or metres."""
    return pixels / np.float32(1000.0) if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def sound(points: Any) -> Any:
    """(N, 3) points but those that are none."""
    x, y, z = points.T
    return points[np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0.0) | (y != 0.0) | (z != 0.0))]


def clouds_alone(path: Path) -> None:
    """Each file of four floats a point."""
    for file in sorted(path.rglob("*.bin")):
        sound(np.ascontiguousarray(np.fromfile(file, "<f4").reshape(-1, 4)[:, :3]))


def bag_alone(path: Path) -> None:
    """Each message as rosbags has it, and what is in its bytes."""
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            kind = connection.msgtype.rpartition("/")[2]
            if kind == "CompressedImage":
                start = 12 if "compressedDepth" in message.format else 0
                decoded(cv2.imdecode(message.data[start:], cv2.IMREAD_UNCHANGED))
            elif kind == "Image" and message.encoding in ("16UC1", "mono16"):
                decoded(message.data.view("<u2").reshape(message.height, message.width))
            elif kind == "Image":
                decoded(message.data.reshape(message.height, message.width, 3))
            elif kind == "PointCloud2":
                rows = message.data.reshape(-1, message.point_step)
                sound(np.ascontiguousarray(rows[:, :12]).view("<f4"))


def ratio(path: Path, alone: Callable[[Path], None], repeats: int) -> tuple[float, float]:
    """Milliseconds of CPU of reading, and how many times that of decoding alone it is."""
    dataset, best = open_dataset(path), [np.inf, np.inf]
    deque(dataset, maxlen=0)  # what is found out about a bag before it is read is found out once
    for _ in range(repeats):
        for place, run in enumerate((lambda: deque(dataset, maxlen=0), lambda: alone(path))):
            before = time.process_time()
            run()
            best[place] = min(best[place], time.process_time() - before)
    return 1e3 * best[0], best[0] / best[1]


def main() -> None:
    """Pack, read, compare."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    taken = footage(LENS, count=COUNT)
    # Noise of a camera: a computed room packs better than any image.
    rng = np.random.default_rng(0)
    noisy = [np.clip(one + rng.normal(0, 4, one.shape), 0, 255).astype(np.uint8) for one in taken.colors]
    depths = [(one + rng.integers(0, 9, one.shape)).astype(np.uint16) for one in taken.depths_mm]
    taken = Footage(taken.stamps_s, noisy, depths, taken.poses, LENS)
    frames = [
        RgbdFrame(stamp_s, color, (depth / 1000.0).astype(np.float32), LENS)
        for stamp_s, color, depth in zip(taken.stamps_s, noisy, depths, strict=True)
    ]
    points, parts, poses = ride(placed(0.0, 0.0, 1.2), COUNT, np.linspace(-22.5, 22.5, 64), 1024)
    turns = Turns([0.1 * k for k in range(COUNT)], points, [0.1 * part for part in parts], poses)
    said = [
        ros.cloud("/points", ros.START_S + stamp, one, "lidar", {"t": (1e8 * part).astype("<u4")})
        for stamp, one, part in zip(turns.stamps_s, points, parts, strict=True)
    ]
    tests: dict[str, tuple[Callable[[Path], Path], Callable[[Path], None]]] = {
        "TUM, PNG": (lambda place: CAMERAS["tum"](place, taken), images_alone),
        "Open3D, JPEG and PNG": (lambda place: CAMERAS["open3d"](place, taken), images_alone),
        "ROS 1 bag, raw images": (lambda place: write_rgbd_bag(place, "realsense.bag", frames), bag_alone),
        "MCAP, PNG and compressedDepth": (
            lambda place: write_rgbd_bag(place, "compressed.mcap", frames),
            bag_alone,
        ),
        "KITTI raw, .bin": (lambda place: LIDARS["kitti_raw"](place, turns), clouds_alone),
        "MulRan, .bin": (lambda place: LIDARS["mulran"](place, turns), clouds_alone),
        "rosbag2, PointCloud2": (lambda place: ros.ros2(place / "bag", said), bag_alone),
    }
    print(f"{'log':32} {'CPU ms a frame':>14} {'ratio':>6}")
    for name, (write, alone) in tests.items():
        place = given.output / "speed"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        spent_ms, times = ratio(write(place), alone, given.repeats)
        print(f"{name:32} {spent_ms / COUNT:14.1f} {times:6.2f}", flush=True)
        shutil.rmtree(place)


if __name__ == "__main__":
    main()
