"""Rewrite an RGB-D dataset in the TUM layout: with fewer pixels, or several times as long.

    python tools/rgbd_sequences.py FOLDER OUT SHRINK TIMES

SHRINK 2 halves width and height. TIMES 4 is the log forward, backward, forward, backward: it remains
continuous, and contains nothing new.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from slam.datasets import open_dataset
from slam.datasets.dataset import Dataset
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics, FloatArray, RgbdFrame
from slam.storage.tum import write_tum

_STEPS_PER_M = 5000.0


def main() -> None:
    """Write one sequence; see above."""
    source, out, shrink, times = sys.argv[1:]
    dataset = open_dataset(Path(source))
    stamps_s = write_images(dataset, Path(out), int(shrink))
    write_lists(dataset, Path(out), stamps_s, int(times))


def write_images(dataset: Dataset, folder: Path, step: int) -> FloatArray:
    """Write every frame once, numbered, and the calibration; the stamps (N,)."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    stamps_s = []
    for frame in dataset:
        if not isinstance(frame, RgbdFrame):
            continue
        if not stamps_s:
            write_calibration(folder / "calibration.yaml", frame.intrinsics, step)
        # Pixel (u, v) of the small images is pixel (2 u, 2 v) of the large ones, in colour as in depth.
        color = frame.color
        for _ in range(step.bit_length() - 1):
            color = cv2.pyrDown(color)
        steps = np.rint(_STEPS_PER_M * frame.depth_m[::step, ::step])
        steps = np.where(steps < 65536.0, steps, 0.0).astype(np.uint16)
        number = f"{len(stamps_s):06d}"
        cv2.imwrite(str(folder / "rgb" / f"{number}.jpg"), cv2.cvtColor(color, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(folder / "depth" / f"{number}.png"), steps)
        stamps_s.append(frame.stamp_s)
    return np.array(stamps_s)


def write_calibration(path: Path, k: CameraIntrinsics, step: int) -> None:
    """Intrinsics of every ``step``-th pixel."""
    path.write_text(
        f"intrinsics: {{fx: {k.fx / step}, fy: {k.fy / step}, cx: {k.cx / step}, cy: {k.cy / step}, "
        f"width: {k.width // step}, height: {k.height // step}}}\ndepth_steps_per_m: {_STEPS_PER_M}\n"
    )


def write_lists(dataset: Dataset, folder: Path, stamps_s: FloatArray, times: int) -> None:
    """Image lists and truth, forward and backward by turns."""
    truth = dataset.groundtruth()
    if truth is None:
        sys.exit(f"{dataset.name} has no ground truth")
    nearest = np.abs(truth.stamps_s[None, :] - stamps_s[:, None]).argmin(axis=1)
    count = len(stamps_s)
    numbers = np.concatenate([np.arange(count)[:: -1 if turn % 2 else 1] for turn in range(times)])
    lasts_s = stamps_s[-1] - stamps_s[0] + stamps_s[1] - stamps_s[0]
    elapsed_s = np.concatenate([stamps_s - stamps_s[0] + turn * lasts_s for turn in range(times)])
    for kind, ending in (("rgb", "jpg"), ("depth", "png")):
        lines = [
            f"{stamp_s:.6f} {kind}/{number:06d}.{ending}\n"
            for stamp_s, number in zip(elapsed_s, numbers, strict=True)
        ]
        (folder / f"{kind}.txt").write_text("".join(lines))
    at = nearest[numbers]
    write_tum(
        folder / "groundtruth.txt", Trajectory(elapsed_s, truth.positions_m[at], truth.quaternions_xyzw[at])
    )


if __name__ == "__main__":
    main()
