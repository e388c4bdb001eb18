"""Cloud and images of a map for its page, thinned to a given size."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.mapping.cloud_map import ramp
from slam.mapping.dense_map import ColoredCloud
from slam.matching.local_cloud import moved
from slam.measurements import AnyFloatArray, FloatArray, spatial
from slam.storage.map_clouds import MapClouds
from slam.storage.map_contents import MapContents

# Limits of a page: points of the cloud, images or keyframe clouds, pixels along an image's longer side.
_POINTS, _IMAGES, _SIDE_PX = 200_000, 120, 200
# Distant outliers would shrink everything else.
_OUTSIDE_PERCENT = 0.1
_STEPS = np.iinfo(np.uint16).max
# Cosines between a normal and the upward direction: ever narrower cones around the floors and tables.
_CONES = (0.8, 0.9, 0.95, 0.97)
_LEAST_SHARE = 0.02


def cloud_data(contents: MapContents, cloud: ColoredCloud | None) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the coloured cloud of the images, or else of the 3D lidar, and a line about its size.

    Points are (N, 3) in steps of ``step_m`` from ``low``, map frame; ``up`` is the upward direction. A
    hand-held camera does not know it, yet most of what faces up is a floor or a table. ``by_intensity`` are
    colours by intensity, if the lidar reports intensities that differ.
    """
    up = np.array([0.0, 0.0, 1.0])
    intensities: AnyFloatArray | None = None
    if cloud is not None and len(cloud.points_map):
        total, step = f"{len(cloud.points_map):,} points", max(1, -(-len(cloud.points_map) // _POINTS))
        points, colors = cloud.points_map[::step].astype(np.float64), cloud.colors[::step]
        intensities = None if cloud.intensities is None else cloud.intensities[::step]
        if not contents.planar and contents.clouds is None:
            up = _upward(cloud.normals_map)
    elif contents.clouds is not None and len(contents.clouds):
        points, intensities, total = _of_keyframes(contents.clouds, contents)
        colors = ramp(points[:, 2])
    else:
        return None, []
    low, high = np.percentile(points, [_OUTSIDE_PERCENT, 100.0 - _OUTSIDE_PERCENT], axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    step_m = max(float((high - low).max()), 1e-3) / _STEPS
    steps = np.rint((points[inside] - low) / step_m).astype(np.uint16)
    data = {"points": steps, "colors": colors[inside], "low": low, "step_m": step_m, "up": up}
    if intensities is not None and np.ptp(intensities := np.nan_to_num(intensities[inside])):
        data["by_intensity"] = ramp(intensities)
    return data, [f"The cloud: {len(steps):,} of {total}, evenly sampled."]


def _of_keyframes(clouds: MapClouds, contents: MapContents) -> tuple[FloatArray, FloatArray | None, str]:
    """Return (N, 3) sampled points of keyframes in the map, their intensities (N,), and the total number."""
    keys, total, parts, intensities_of = _even(len(clouds)), 0, list[FloatArray](), list[FloatArray]()
    share = _POINTS // len(keys) + 1
    for key in keys:
        rows = clouds.rows(key)
        total += len(rows)
        rows = rows[:: max(1, -(-len(rows) // share))]
        parts.append(moved(rows, spatial(contents.node_poses[key])))
        # A view would keep the whole keyframe in memory.
        intensities_of.append(rows[:, 3].copy() if rows.shape[1] > 3 else np.full(len(rows), np.nan))
    intensity, size = np.concatenate(intensities_of), f"{total:,} points of {len(keys):,} keyframes"
    return np.vstack(parts), None if np.isnan(intensity).all() else intensity, size


def _even(count: int) -> list[int]:
    """Return evenly sampled keyframes, up to the limit of a page."""
    return np.unique(np.linspace(0, count - 1, min(_IMAGES, count)).astype(int)).tolist()


def _upward(normals: NDArray[np.float32]) -> FloatArray:
    """Return (3,) the direction that most surfaces near z face."""
    up = np.array([0.0, 0.0, 1.0])
    for cosine in _CONES:
        around = normals[normals @ up > cosine]
        if len(around) < _LEAST_SHARE * len(normals):
            break
        mean = around.mean(axis=0, dtype=np.float64)
        up = mean / np.linalg.norm(mean)
    return up


def image_data(contents: MapContents) -> tuple[dict[str, Any] | None, list[str]]:
    """Return small images of camera keyframes, one JPEG after the other, and a line about their size."""
    from PIL import Image

    frames = contents.frames
    if frames is None or not len(frames):
        return None, []
    files, heads = list[bytes](), []
    for index in _even(len(frames)):
        frame = frames.frame(index)
        image = Image.fromarray(frame.color)
        image.thumbnail((_SIDE_PX, _SIDE_PX))
        buffer = io.BytesIO()
        image.save(buffer, format="jpeg", quality=70)
        files.append(buffer.getvalue())
        heads.append(frames.head(index))
    names = sorted({head.sensor for head in heads})
    data = {
        "first": np.concatenate([[0], np.cumsum([len(file) for file in files])]).astype(np.int32),
        "bytes": np.frombuffer(b"".join(files), np.uint8),
        "node": np.array([head.node for head in heads], np.int32),
        "stamps_s": np.array([head.stamp_s for head in heads]),
        "camera": np.array([names.index(head.sensor) for head in heads], np.uint8),
        "cameras": names,
    }
    return data, [f"Images: {len(files):,} of {len(frames):,}, at most {_SIDE_PX} pixels wide."]
