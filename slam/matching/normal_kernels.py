"""Compiled kernel of normals from the points of neighbouring cells."""

from __future__ import annotations

from fusion.kernel import ZERO, kernel
from fusion.voxel_hash import AXIS_BITS
from slam.matching.plane_kernels import across

# A cell farther from a plane than this share of its side hardly belongs to it.
_OFF = 0.125


@kernel(nogil=True)
def smooth_normals(keys, sums, size_m, begun, around, normals):  # type: ignore[no-untyped-def]
    """Return normals (V, 3) of the points in each cell and the 26 around it; vertical if undetermined.

    Fitted twice: in the second fit, a cell with its centre off the first plane has less weight, so that
    normals near an edge are those of one side.

    Parameters
    ----------
    keys, sums
        Of the cells: keys (V,), rising, and moments (V, 10).
    begun, around
        Nine zeros: where the search of each column of neighbours goes on; room (27, 4) for neighbours.
    """
    count = keys.shape[0]
    for i in range(count):
        nx = ny = nz = 0.0
        cells = ZERO
        for side in range(9):
            column = side // 3 - 1
            row = side % 3 - 1
            middle = keys[i] + (column << 2 * AXIS_BITS) + (row << AXIS_BITS)
            k = begun[side]
            while k < count and keys[k] < middle - 1:
                k += 1
            begun[side] = k
            while k < count and keys[k] <= middle + 1:
                layer = keys[k] - middle
                around[cells, 0] = sums[k, 0]
                around[cells, 1] = sums[k, 1] / sums[k, 0] - sums[i, 1] / sums[i, 0] + column * size_m
                around[cells, 2] = sums[k, 2] / sums[k, 0] - sums[i, 2] / sums[i, 0] + row * size_m
                around[cells, 3] = sums[k, 3] / sums[k, 0] - sums[i, 3] / sums[i, 0] + layer * size_m
                cells += 1
                k += 1
        for turn in range(2 if cells > 2 else 0):
            n = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
            for k in range(cells):
                a = around[k, 1]
                b = around[k, 2]
                c = around[k, 3]
                ratio = turn * (a * nx + b * ny + c * nz) / (_OFF * size_m)
                w = around[k, 0] / ((1.0 + ratio * ratio) * (1.0 + ratio * ratio))
                n += w
                x += w * a
                y += w * b
                z += w * c
                xx += w * a * a
                xy += w * a * b
                xz += w * a * c
                yy += w * b * b
                yz += w * b * c
                zz += w * c * c
            x /= n
            y /= n
            z /= n
            _, _, nx, ny, nz = across(
                xx / n - x * x, xy / n - x * y, xz / n - x * z, yy / n - y * y, yz / n - y * z, zz / n - z * z
            )
        normals[i, 0] = nx
        normals[i, 1] = ny
        normals[i, 2] = nz if cells > 2 else 1.0
