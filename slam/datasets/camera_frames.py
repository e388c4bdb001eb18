"""Converts pairs of image files to frames: prefetched, and checked against the first frame."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.lens import Lens
from slam.datasets.budget import Budget
from slam.datasets.calibration import Calibration, same_aspect
from slam.datasets.dataset import WARNING, RecordFault
from slam.datasets.frame_pairs import FramePair
from slam.datasets.image_files import FILES, ImageSource
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array, RgbdFrame
from slam.vision.prefetch import prefetched

SIZES_DIFFER = "colour and depth of different aspect"
SIZE_CHANGED = "image size differs from the first frame's"
SIZE_NOTE = "colour resized to the depth image"


@dataclass(frozen=True, slots=True)
class Camera:
    """One camera of a recording.

    Attributes
    ----------
    pairs
        Its images, in the order of the log.
    quarter_turns
        Number of counter-clockwise 90-degree rotations that make the stored images upright.
    """

    sensor: str
    pairs: list[FramePair]
    calibration: Calibration
    quarter_turns: int = 0
    source: ImageSource = FILES


@dataclass(frozen=True, slots=True)
class _Images:
    """A decoded pair, or the reason why there is none."""

    camera: Camera
    pair: FramePair
    color: ColorImage | None = None
    depth_m: Float32Array | None = None
    resized_from: tuple[int, int] | None = None
    fault: RecordFault | None = None


def read_frames(
    requests: Iterable[tuple[Camera, FramePair]], account: Account
) -> Generator[tuple[int, RgbdFrame], None, None]:
    """Frames in the order of the pairs, each with the line number of its colour image; faults are counted."""
    sizes: dict[str, CameraIntrinsics] = {}
    budget = Budget(0)
    for images in prefetched(requests, lambda request: _decode(request, budget)):
        camera, number = images.camera, images.pair.color.number
        account.report.line_count += 1
        with account.refusing(camera.sensor, number):
            frame = _frame(images, sizes)
            if camera.calibration.assumed:
                account.report.note(f"{WARNING}{camera.sensor}: {camera.calibration.assumed}", number)
            if images.resized_from:
                width, height = images.resized_from
                account.report.note(f"{camera.sensor}: {SIZE_NOTE}, from {width} x {height}", number)
            account.report.accept(f"{camera.sensor} frame")
            yield number, frame


def _frame(images: _Images, sizes: dict[str, CameraIntrinsics]) -> RgbdFrame:
    """The frame, if it has the size of the camera's first frame, which ``sizes`` stores."""
    camera = images.camera
    if images.fault is not None or images.color is None or images.depth_m is None:
        raise images.fault or RecordFault(SIZES_DIFFER, "no images")
    height, width = images.depth_m.shape
    known = sizes.get(camera.sensor)
    if known is None:
        known = sizes[camera.sensor] = camera.calibration.intrinsics_for(width, height)
    if (known.width, known.height) != (width, height):
        raise RecordFault(SIZE_CHANGED, f"{width} x {height} after {known.width} x {known.height}")
    return RgbdFrame(
        stamp_s=images.pair.stamp_s,
        color=images.color,
        depth_m=images.depth_m,
        intrinsics=known,
        T_base_camera=camera.calibration.T_base_camera,
        sensor=camera.sensor,
    )


def _decode(request: tuple[Camera, FramePair], budget: Budget) -> _Images:
    """Both images, upright and of equal size; runs on the prefetching thread."""
    camera, pair = request
    calibration = camera.calibration
    try:
        depth_m = camera.source.depth(pair.depth, calibration, budget)
        color = camera.source.color(pair.color, budget)
        stored = (color.shape[1], color.shape[0])
        color = _fitted(color, depth_m, calibration)
    except RecordFault as fault:
        return _Images(camera, pair, fault=fault)
    if turns := camera.quarter_turns % 4:
        color = np.ascontiguousarray(np.rot90(color, turns))
        depth_m = np.ascontiguousarray(np.rot90(depth_m, turns))
    resized = color.size != 3 * stored[0] * stored[1]
    return _Images(camera, pair, color, depth_m, stored if resized else None)


def _fitted(color: ColorImage, depth_m: Float32Array, calibration: Calibration) -> ColorImage:
    """The colour image at the size of the depth image, warped to the depth image's lens."""
    size, target = (color.shape[1], color.shape[0]), (depth_m.shape[1], depth_m.shape[0])
    if (lens := calibration.color_lens) is not None:
        return _warped(lens, color, calibration.intrinsics_for(*target))
    if size == target:
        return color
    if not same_aspect(size, target):
        raise RecordFault(SIZES_DIFFER, f"{size[0]} x {size[1]} and {target[0]} x {target[1]}")
    return resized(color, target)


def _warped(lens: Lens, color: ColorImage, seen_by: CameraIntrinsics) -> ColorImage:
    """An image warped to the lens of another camera at the same position."""
    import cv2

    known = (color.shape[1], color.shape[0])
    calibrated = (lens.intrinsics.width, lens.intrinsics.height)
    if calibrated not in (known, (0, 0)):
        raise RecordFault(SIZES_DIFFER, f"colour {known}, its lens {calibrated}")
    size, maps = _lookup(lens, known, seen_by)
    shrunk = color if size == known else resized(color, size)
    if maps is None:
        return shrunk
    columns, rows = maps
    return np.asarray(cv2.remap(shrunk, columns, rows, cv2.INTER_LINEAR))


@lru_cache(maxsize=16)
def _lookup(lens: Lens, stored: tuple[int, int], seen_by: CameraIntrinsics) -> tuple[tuple[int, int], Any]:
    """The size to which an image is reduced (by averaging) before the lookup, and the columns and rows to
    look up; None if reducing is sufficient.
    """
    known = replace(lens.intrinsics, width=stored[0], height=stored[1])
    lens = replace(lens, intrinsics=known)
    if lens.maps(seen_by) is None:
        return (seen_by.width, seen_by.height), None
    scale = min(1.0, seen_by.fx / known.fx)
    width, height = (max(1, round(side * scale)) for side in (known.width, known.height))
    across, down = width / known.width, height / known.height
    shrunk = CameraIntrinsics(
        known.fx * across,
        known.fy * down,
        (known.cx + 0.5) * across - 0.5,
        (known.cy + 0.5) * down - 0.5,
        width,
        height,
    )
    return (width, height), replace(lens, intrinsics=shrunk).maps(seen_by)


def resized(color: ColorImage, target: tuple[int, int]) -> ColorImage:
    """The image at another width and height."""
    import cv2

    how = cv2.INTER_AREA if target[0] < color.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(color, target, interpolation=how))
