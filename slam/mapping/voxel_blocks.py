"""Blocks of voxels near surfaces: which blocks a depth image touches, and the update of each voxel.

A truncated signed distance field after Curless and Levoy, "A volumetric method for building complex models
from range images" (SIGGRAPH 1996), with equal weights. Blocks are numbered as they come.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel
from fusion.voxel_hash import AXIS, AXIS_BITS, HALF, key_of
from slam.measurements import ColorImage, Float32Array, FloatArray

Keys = NDArray[np.int64]

# Voxels along a block's side, and in it; half a side is the band on either side of a surface.
SIDE = 8
VOXELS = SIDE * SIDE * SIDE
# In the whole numbers that are kept: a distance of one band, one step of colour, the most frames.
BAND_STEPS = float(np.iinfo(np.int16).max)
COLOR_STEPS = float(np.iinfo(np.uint16).max // np.iinfo(np.uint8).max)
MOST_WEIGHT = float(np.iinfo(np.uint16).max)


class VoxelBlocks:
    """The blocks that were touched so far.

    Attributes
    ----------
    keys
        (B,) of the blocks, see `fusion.voxel_hash`, as they came.
    distance
        (B, 512) mean signed distance to the surface, in `BAND_STEPS` a band, positive before it.
    weight
        (B, 512) frames that measured a voxel.
    color
        (B, 512, 3) mean RGB, in `COLOR_STEPS`.
    """

    def __init__(self, voxel_m: float) -> None:
        self.voxel_m = voxel_m
        self.keys: Keys = np.empty(0, np.int64)
        self._order = np.empty(0, np.int64)
        self.forget()

    def __len__(self) -> int:
        return len(self.keys)

    @staticmethod
    def bytes_each() -> int:
        """Memory of a block."""
        return VOXELS * 5 * np.dtype(np.uint16).itemsize

    def touched(
        self, depth_m: Float32Array, camera: tuple[float, float, float, float], T_map_camera: FloatArray
    ) -> Keys:
        """(N,) keys of the blocks within the band of what a depth image saw, in order.

        Parameters
        ----------
        depth_m
            (H, W), 0 where there is no reading.
        camera
            fx, fy, cx, cy.
        T_map_camera
            (4, 4).
        """
        side_m = SIDE * self.voxel_m
        # Two rays that are looked at lie no farther apart than half a block.
        step = max(1, int(0.5 * side_m * camera[0] / max(float(depth_m.max()), side_m)))
        keys = np.empty(3 * (-(-depth_m.shape[0] // step)) * (-(-depth_m.shape[1] // step)), np.int64)
        count = _touch(depth_m, step, *camera, T_map_camera, 0.5 * side_m, side_m, keys)
        return np.unique(keys[:count])

    def find(self, keys: Keys) -> NDArray[np.int64]:
        """Numbers of blocks, -1 where there is none."""
        if not len(self):
            return np.full(keys.shape, -1)
        place = np.searchsorted(self.keys, keys, sorter=self._order).clip(max=len(self) - 1)
        blocks = self._order[place]
        return np.where(self.keys[blocks] == keys, blocks, -1)

    def add(self, keys: Keys) -> None:
        """Take blocks that are new, all voxels unknown."""
        self.keys = np.concatenate([self.keys, keys])
        self._order = np.argsort(self.keys)
        if len(self.keys) > len(self.weight):
            room = len(self.keys) + len(self.keys) // SIDE
            for values in (self.distance, self.weight, self.color):
                # In place: a copy would hold all of them twice.
                values.resize((room, *values.shape[1:]), refcheck=False)

    def forget(self) -> None:
        """Give up all but the keys."""
        self.distance = np.empty((0, VOXELS), np.int16)
        self.weight = np.empty((0, VOXELS), np.uint16)
        self.color = np.empty((0, VOXELS, 3), np.uint16)

    def integrate(
        self,
        numbers: NDArray[np.int64],
        depth_m: Float32Array,
        color: ColorImage,
        camera: tuple[float, float, float, float],
        T_camera_map: FloatArray,
    ) -> None:
        """Add a frame to blocks by number; see `touched`."""
        places = coordinates(self.keys[numbers])
        fields = self.distance, self.weight, self.color
        _integrate(numbers, places, depth_m, color, *camera, T_camera_map, self.voxel_m, *fields)


def coordinates(keys: Keys) -> NDArray[np.int64]:
    """(N, 3) places of blocks along x, y and z, in blocks."""
    return np.stack([(keys >> 2 * AXIS_BITS), (keys >> AXIS_BITS) & AXIS, keys & AXIS], axis=1) - HALF


def keys_at(places: NDArray[np.int64]) -> Keys:
    """(N,) keys of blocks at places (N, 3); the inverse of `coordinates`."""
    column, row, layer = ((places + HALF) & AXIS).T
    return np.asarray((column << 2 * AXIS_BITS) | (row << AXIS_BITS) | layer)


@kernel(nogil=True)
def _touch(  # type: ignore[no-untyped-def]
    depth, step, fx, fy, cx, cy, T, band_m, side_m, keys
):
    """Keys of the blocks on every ``step``-th ray, at the surface and a band before and behind; how many."""
    count = ZERO
    for v in range(0, depth.shape[0], step):
        for u in range(0, depth.shape[1], step):
            if depth[v, u] <= 0.0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            for side in range(-1, 2):
                z = depth[v, u] + side * band_m
                keys[count] = key_of(
                    (T[0, 0] * x + T[0, 1] * y + T[0, 2]) * z + T[0, 3],
                    (T[1, 0] * x + T[1, 1] * y + T[1, 2]) * z + T[1, 3],
                    (T[2, 0] * x + T[2, 1] * y + T[2, 2]) * z + T[2, 3],
                    side_m,
                )
                count += 1
    return count


@kernel(nogil=True)
def _integrate(  # type: ignore[no-untyped-def]
    numbers, places, depth, color, fx, fy, cx, cy, T, voxel_m, distance, weight, mean_color
):
    """Add a frame's reading to the mean of every voxel that it measures."""
    height, width = depth.shape
    per_band = 1.0 / (SIDE // 2 * voxel_m)
    for n in range(numbers.shape[0]):
        block = numbers[n]
        for i in range(VOXELS):
            px = voxel_m * (SIDE * places[n, 0] + (i >> 6))
            py = voxel_m * (SIDE * places[n, 1] + ((i >> 3) & 7))
            pz = voxel_m * (SIDE * places[n, 2] + (i & 7))
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if z <= 0.0:
                continue
            inverse = 1.0 / z
            u = math.floor(fx * (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) * inverse + cx + 0.5)
            v = math.floor(fy * (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) * inverse + cy + 0.5)
            if u < 0 or v < 0 or u >= width or v >= height or depth[v, u] <= 0.0:
                continue
            share = (depth[v, u] - z) * per_band
            if share < -1.0:
                continue
            views = float(weight[block, i])
            newest = 1.0 / (views + 1.0)
            steps = BAND_STEPS * min(share, 1.0)
            distance[block, i] = math.floor((views * distance[block, i] + steps) * newest + 0.5)
            for channel in range(3):
                mean = views * mean_color[block, i, channel] + COLOR_STEPS * color[v, u, channel]
                mean_color[block, i, channel] = math.floor(mean * newest + 0.5)
            weight[block, i] = min(views + 1.0, MOST_WEIGHT)
