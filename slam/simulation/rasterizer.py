"""Rasterises triangles for a camera: equivalent to `RayCaster` for a whole image, several times as fast.

Homogeneous rasterization (Olano and Greer 1997, Triangle Scan Conversion using 2D Homogeneous Coordinates):
the edge functions of a triangle, and the inverse depth in it, are affine in the pixel coordinates. So
no triangle is clipped, and each row of a triangle is one run of pixels.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import kernel
from slam.measurements import CameraIntrinsics, Float32Array, FloatArray
from slam.simulation.home_model import Int32Array


def rasterize(
    vertices_camera: FloatArray, triangles: Int32Array, intrinsics: CameraIntrinsics
) -> tuple[Float32Array, Int32Array]:
    """Return the first surface at each pixel.

    Parameters
    ----------
    vertices_camera
        (V, 3) in the optical frame.
    triangles
        (T, 3) indices of vertices.

    Returns
    -------
    (H * W,) depth, ``inf`` without a surface, and (H * W,) index of the triangle, -1 without one.
    """
    lens, shape = intrinsics, (intrinsics.height, intrinsics.width)
    to_pixels = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    depth_m, triangle = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
    _draw((vertices_camera @ to_pixels.T)[triangles], depth_m, triangle)
    return depth_m.ravel(), triangle.ravel()


@kernel(nogil=True)
def _draw(corners: FloatArray, depth_m: Float32Array, triangle: Int32Array) -> None:
    """Find the nearest triangle of each pixel; (T, 3, 3) ``corners`` are homogeneous pixels, depth last."""
    height, width = depth_m.shape
    plane = np.empty((3, 3))  # edge functions, not negative inside: coefficients of column, row and 1
    nearness = np.empty((corners.shape[0], 3))  # inverse depth in the plane of each triangle, likewise
    for face in range(corners.shape[0]):
        x, y, z = corners[face, :, 0], corners[face, :, 1], corners[face, :, 2]
        top, bottom, behind = np.inf, -np.inf, 0
        for n in range(3):
            m, k = (n + 1) % 3, (n + 2) % 3
            plane[n, 0] = y[m] * z[k] - z[m] * y[k]
            plane[n, 1] = z[m] * x[k] - x[m] * z[k]
            plane[n, 2] = x[m] * y[k] - y[m] * x[k]
            if z[n] > 0.0:
                top, bottom = min(top, y[n] / z[n]), max(bottom, y[n] / z[n])
            else:
                behind += 1
        volume = x[0] * plane[0, 0] + y[0] * plane[0, 1] + z[0] * plane[0, 2]
        if behind == 3 or volume == 0.0:
            continue
        if behind:
            top, bottom = 0.0, height - 1.0
        # Two triangles with a common edge have the same coefficients up to the sign: no pixel is missed.
        for axis in range(3):
            nearness[face, axis] = (plane[0, axis] + plane[1, axis] + plane[2, axis]) / volume
            for n in range(3):
                plane[n, axis] = math.copysign(1.0, volume) * plane[n, axis]
        for row in range(math.ceil(max(top, 0.0)), math.floor(min(bottom, height - 1.0)) + 1):
            low, high = 0.0, width - 1.0
            for n in range(3):
                slope, level = plane[n, 0], plane[n, 1] * row + plane[n, 2]
                if slope > 0.0:
                    low = max(low, -level / slope)
                elif slope < 0.0:
                    high = min(high, -level / slope)
                elif level < 0.0:
                    high = -1.0
            if low > high:
                continue
            at, step = np.float32(nearness[face, 1] * row + nearness[face, 2]), np.float32(nearness[face, 0])
            for col in range(math.ceil(low), math.floor(high) + 1):
                at_col = at + step * np.float32(col)
                if at_col > depth_m[row, col]:
                    depth_m[row, col], triangle[row, col] = at_col, face
    for row in range(height):
        for col in range(width):
            face = triangle[row, col]
            if face < 0:
                depth_m[row, col] = np.inf
            else:
                inverse = nearness[face, 0] * col + nearness[face, 1] * row + nearness[face, 2]
                depth_m[row, col] = 1.0 / inverse
