"""Small image files and lists of them, as the RGB-D formats lay them out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.datasets import Dataset, open_dataset
from slam.measurements import Measurement, RgbdFrame

WIDTH, HEIGHT = 64, 48


def color_image(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """(H, W, 3) RGB noise."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def depth_image(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint16]:
    """(H, W) steps, the first row without reading."""
    depth = np.random.default_rng(100 + seed).integers(2000, 20000, (height, width), dtype=np.uint16)
    depth[0] = 0
    return depth


def write_color(path: Path, image: NDArray[np.uint8] | None = None, seed: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = color_image(seed) if image is None else image
    assert cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return path


def write_depth(path: Path, image: NDArray[np.generic] | None = None, seed: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), depth_image(seed) if image is None else image)
    return path


def write_tum(folder: Path, count: int = 4, rate_hz: float = 10.0, start_s: float = 100.0) -> Path:
    """A TUM folder; the depth of frame k is 5 ms later than its colour."""
    lists: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for k in range(count):
        stamp_s = start_s + k / rate_hz
        write_color(folder / "rgb" / f"{k}.png", seed=k)
        write_depth(folder / "depth" / f"{k}.png", seed=k)
        lists["rgb"].append(f"{stamp_s:.6f} rgb/{k}.png")
        lists["depth"].append(f"{stamp_s + 0.005:.6f} depth/{k}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "groundtruth.txt").write_text("# truth\n100.0 1 2 3 0 0 0 1\n100.1 1 2 4 0 0 0.7071 0.7071\n")
    return folder


def read(path: Path, *, strict: bool = False) -> tuple[list[Measurement], Dataset]:
    dataset = open_dataset(path, strict=strict)
    return list(dataset), dataset


def frames(measurements: list[Measurement]) -> list[RgbdFrame]:
    return [m for m in measurements if isinstance(m, RgbdFrame)]


def dropped(dataset: Dataset) -> dict[str, int]:
    return {reason: tally.count for reason, tally in dataset.report.dropped.items()}
