"""The compiled kernel of normals across the points of neighbouring cells."""

from __future__ import annotations

from fusion.kernel import ZERO, kernel
from fusion.voxel_hash import AXIS_BITS, key_of, slot_of
from slam.matching.plane_kernels import across

# A cell so much of its side off a plane is hardly of it.
_OFF = 0.125


@kernel
def smooth_normals(points, size_m, table, keys, sums, known, of_cells, normals):  # type: ignore[no-untyped-def]
    """Normals (N, 3) across the points in the cell of each and in the 26 around it; else upright.

    Fitted twice: the second time a cell whose middle lies off the first plane counts less, so that normals
    near an edge are those of one side.

    Parameters
    ----------
    table, keys, sums
        Of the cells of one size: slots, keys (V,) and moments (V, 10).
    known, of_cells
        (V,) all False, and room (V, 3): a cell is asked once.
    """
    mask = table.shape[0] - 1
    for i in range(points.shape[0]):
        own = key_of(points[i, 0], points[i, 1], points[i, 2], size_m)
        slot = slot_of(own, mask)
        while keys[table[slot]] != own:
            slot = (slot + 1) & mask
        cell = table[slot]
        for turn in range(0 if known[cell] else 2):
            nx = of_cells[cell, 0]
            ny = of_cells[cell, 1]
            nz = of_cells[cell, 2]
            n = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
            cells = ZERO
            for near in range(27):
                column = near // 9 - 1
                row = near // 3 % 3 - 1
                layer = near % 3 - 1
                key = own + (column << 2 * AXIS_BITS) + (row << AXIS_BITS) + layer
                slot = slot_of(key, mask)
                k = table[slot]
                while k >= 0 and keys[k] != key:
                    slot = (slot + 1) & mask
                    k = table[slot]
                if k < 0:
                    continue
                a = sums[k, 1] / sums[k, 0] - sums[cell, 1] / sums[cell, 0] + column * size_m
                b = sums[k, 2] / sums[k, 0] - sums[cell, 2] / sums[cell, 0] + row * size_m
                c = sums[k, 3] / sums[k, 0] - sums[cell, 3] / sums[cell, 0] + layer * size_m
                off = turn * (a * nx + b * ny + c * nz) / (_OFF * size_m)
                w = sums[k, 0] / ((1.0 + off * off) * (1.0 + off * off))
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
                cells += 1
            of_cells[cell, 0] = of_cells[cell, 1] = 0.0
            of_cells[cell, 2] = 1.0
            if cells > 2:
                x /= n
                y /= n
                z /= n
                _, _, of_cells[cell, 0], of_cells[cell, 1], of_cells[cell, 2] = across(
                    xx / n - x * x,
                    xy / n - x * y,
                    xz / n - x * z,
                    yy / n - y * y,
                    yz / n - y * z,
                    zz / n - z * z,
                )
            known[cell] = True
        for k in range(3):
            normals[i, k] = of_cells[cell, k]
