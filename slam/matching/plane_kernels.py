"""Compiled kernels of planes in voxels: moments, fits, and the normal equations of points on planes."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import NONE, ZERO, kernel
from fusion.voxel_hash import AXIS, AXIS_BITS, HALF, entry_of, key_of, key_of_cell, slot_of

# A single ring of the lidar is a line: its second extent is noise, and determines no plane.
_LEAST_EXTENT = 0.12
_LEAST_FLATNESS = 9.0
_LEAST_POINTS = 6


@kernel(nogil=True)
def count_points(points, sign, sizes, known, table, keys, sums, marks, touched):  # type: ignore[no-untyped-def]
    """Add points (N, 3) to the moments of their voxels of every size, or remove them; return both counts.

    Parameters
    ----------
    sign
        1.0 or -1.0.
    sizes
        Sides of the voxels, each half of the one before.
    known
        Voxels so far; the arrays have room for a voxel more of each size a point.
    table, keys, sums
        Slots, keys (V,) and moments (V, 10).
    marks, touched
        (V,) all False; set for the voxels whose numbers are written into ``touched``.
    """
    count = np.int64(known)
    changed = ZERO
    last = sizes.shape[0] - 1
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        column = math.floor(x / sizes[last])
        row = math.floor(y / sizes[last])
        layer = math.floor(z / sizes[last])
        for level in range(last + 1):
            a = column >> (last - level)
            b = row >> (last - level)
            c = layer >> (last - level)
            key = key_of_cell(a, b, c) | (level << 3 * AXIS_BITS)
            slot = slot_of(key, table, keys)
            k = np.int64(table[slot])
            if k < 0:
                k = count
                table[slot] = k
                keys[k] = key
                for moment in range(10):
                    sums[k, moment] = 0.0
                count += 1
            if not marks[k]:
                marks[k] = True
                touched[changed] = k
                changed += 1
            # Relative to the corner of its voxel, a moment loses no digits.
            u = x - a * sizes[level]
            v = y - b * sizes[level]
            w = z - c * sizes[level]
            sums[k, 0] += sign
            sums[k, 1] += sign * u
            sums[k, 2] += sign * v
            sums[k, 3] += sign * w
            sums[k, 4] += sign * u * u
            sums[k, 5] += sign * u * v
            sums[k, 6] += sign * u * w
            sums[k, 7] += sign * v * v
            sums[k, 8] += sign * v * w
            sums[k, 9] += sign * w * w
    return count, changed


@kernel(inline="always")
def across(xx, xy, xz, yy, yz, zz):  # type: ignore[no-untyped-def]
    """Least and middle eigenvalue of a symmetric matrix, and the unit eigenvector of the least.

    By the angle of Smith 1961, "Eigenvalues of a symmetric 3 x 3 matrix"; exact to the square root of the
    machine's where the lower two are the same, as on a line.
    """
    mean = (xx + yy + zz) / 3
    a = xx - mean
    b = yy - mean
    c = zz - mean
    off_diagonal = xy * xy + xz * xz + yz * yz
    p = math.sqrt((a * a + b * b + c * c + 2.0 * off_diagonal) / 6)
    least = mean
    middle = mean
    if p > 0.0:
        det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
        angle = math.acos(min(max(det / (2.0 * p * p * p), -1.0), 1.0)) / 3
        least = mean + 2.0 * p * math.cos(angle + 2.0 * math.pi / 3)
        middle = 3 * mean - least - (mean + 2.0 * p * math.cos(angle))
    a = xx - least
    b = yy - least
    c = zz - least
    # The longest cross product of two rows of the shifted matrix.
    nx = xy * yz - xz * b
    ny = xz * xy - a * yz
    nz = a * b - xy * xy
    square = nx * nx + ny * ny + nz * nz
    ux = xy * c - xz * yz
    uy = xz * xz - a * c
    uz = a * yz - xy * xz
    other = ux * ux + uy * uy + uz * uz
    if other > square:
        nx, ny, nz, square = ux, uy, uz, other
    ux = b * c - yz * yz
    uy = yz * xz - xy * c
    uz = xy * yz - b * xz
    other = ux * ux + uy * uy + uz * uz
    if other > square:
        nx, ny, nz, square = ux, uy, uz, other
    if square > 0.0:
        length = math.sqrt(square)
        nx /= length
        ny /= length
        nz /= length
    else:
        nx, ny, nz = 0.0, 0.0, 1.0
    return least, middle, nx, ny, nz


@kernel
def fit_planes(keys, sums, sizes, thickness_m, rough, lidar, least_sine, marks, touched, flat, planes):  # type: ignore[no-untyped-def]
    """Fit each touched voxel: a plane (2), a rough one (1) or none; their marks are cleared.

    Into ``planes`` (V, 6) go center and normal; of rough ones, which count where ``rough`` is 1 and not 0,
    it is shorter by as much as they are thicker than ``thickness_m``. A ring that meets several walls is
    flat, but goes where the lidar goes: planes along its rays are none.
    """
    for n in range(touched.shape[0]):
        i = touched[n]
        marks[i] = False
        flat[i] = 0
        count = sums[i, 0]
        if count < _LEAST_POINTS:
            continue
        size_m = sizes[keys[i] >> 3 * AXIS_BITS]
        x = sums[i, 1] / count
        y = sums[i, 2] / count
        z = sums[i, 3] / count
        least, middle, nx, ny, nz = across(
            sums[i, 4] / count - x * x,
            sums[i, 5] / count - x * y,
            sums[i, 6] / count - x * z,
            sums[i, 7] / count - y * y,
            sums[i, 8] / count - y * z,
            sums[i, 9] / count - z * z,
        )
        planes[i, 0] = x + (((keys[i] >> 2 * AXIS_BITS) & AXIS) - HALF) * size_m
        planes[i, 1] = y + (((keys[i] >> AXIS_BITS) & AXIS) - HALF) * size_m
        planes[i, 2] = z + ((keys[i] & AXIS) - HALF) * size_m
        thin = least < thickness_m * thickness_m
        length = 1.0 if thin else thickness_m / math.sqrt(least)
        planes[i, 3] = nx * length
        planes[i, 4] = ny * length
        planes[i, 5] = nz * length
        x = planes[i, 0] - lidar[0]
        y = planes[i, 1] - lidar[1]
        z = planes[i, 2] - lidar[2]
        least_m = least_sine * math.sqrt(x * x + y * y + z * z)
        if (
            middle > (_LEAST_EXTENT * size_m) ** 2
            and middle > _LEAST_FLATNESS * least
            and abs(x * nx + y * ny + z * nz) * length >= least_m
        ):
            flat[i] = 2 if thin else rough


@kernel
def pair_up(points, pose, sizes, table, keys, flat, planes, last_at, which, plane, residuals):  # type: ignore[no-untyped-def]
    """Find the plane of the largest voxel with one around each point (N, 3), or a rough one; count them.

    Parameters
    ----------
    pose
        (4, 4) or (3, 4) ``T_map_base``, of points in the base frame.
    sizes
        Sides of the voxels, each half of the one before.
    table, keys, flat, planes
        Of the voxels: slots, keys (V,), and what `fit_planes` makes of them.
    last_at
        (2, N) key of the smallest voxel of each point at the last pose, and its plane: -1 if none is known.
    which, plane, residuals
        (N,) each: room for numbers of points, of their voxels, and distances.
    """
    count = ZERO
    last = sizes.shape[0] - 1
    for i in range(points.shape[0]):
        a = points[i, 0]
        b = points[i, 1]
        c = points[i, 2]
        x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
        y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        column = math.floor(x / sizes[last])
        row = math.floor(y / sizes[last])
        layer = math.floor(z / sizes[last])
        cell = key_of_cell(column, row, layer)
        if cell != last_at[0, i]:
            k = NONE
            for level in range(last + 1):
                key = key_of_cell(column >> (last - level), row >> (last - level), layer >> (last - level))
                key |= level << 3 * AXIS_BITS
                here = entry_of(key, table, keys)
                if here >= 0 and flat[here] > (flat[k] if k >= 0 else 0):
                    k = here
                    if flat[k] == 2:
                        break
            last_at[0, i] = cell
            last_at[1, i] = k
        k = last_at[1, i]
        if k < 0:
            continue
        which[count] = i
        plane[count] = k
        x -= planes[k, 0]
        y -= planes[k, 1]
        z -= planes[k, 2]
        residuals[count] = x * planes[k, 3] + y * planes[k, 4] + z * planes[k, 5]
        count += 1
    return count


@kernel
def pull(points, pose, size_m, table, keys, sums, reach_m, pulls):  # type: ignore[no-untyped-def]
    """Return sums (16,) of the pulls of the largest voxels' centres on points (N, 3), base frame.

    Of weights, points, their products, and the pulls that turn and shift. The nearest centre in the voxel of
    a point and the 26 around it pulls; the weights are Geman-McClure, as wide as a voxel.
    """
    for i in range(points.shape[0]):
        a = points[i, 0]
        b = points[i, 1]
        c = points[i, 2]
        x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
        y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        own = key_of(x, y, z, size_m)
        # From here on relative to the corner of the voxel.
        x -= math.floor(x / size_m) * size_m
        y -= math.floor(y / size_m) * size_m
        z -= math.floor(z / size_m) * size_m
        least = reach_m * reach_m
        dx = dy = dz = 0.0
        for neighbour in range(27):
            column = neighbour // 9 - 1
            row = neighbour // 3 % 3 - 1
            layer = neighbour % 3 - 1
            key = own + (column << 2 * AXIS_BITS) + (row << AXIS_BITS) + layer
            k = entry_of(key, table, keys)
            if k < 0 or sums[k, 0] < 0.5:
                continue
            ux = x - column * size_m - sums[k, 1] / sums[k, 0]
            uy = y - row * size_m - sums[k, 2] / sums[k, 0]
            uz = z - layer * size_m - sums[k, 3] / sums[k, 0]
            square = ux * ux + uy * uy + uz * uz
            if square < least:
                least = square
                dx = ux
                dy = uy
                dz = uz
        if least >= reach_m * reach_m:
            continue
        weight = size_m * size_m / (size_m * size_m + least)
        weight *= weight
        ex = pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz
        ey = pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz
        ez = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
        pulls[0] += weight
        pulls[1] += weight * a
        pulls[2] += weight * b
        pulls[3] += weight * c
        pulls[4] += weight * a * a
        pulls[5] += weight * a * b
        pulls[6] += weight * a * c
        pulls[7] += weight * b * b
        pulls[8] += weight * b * c
        pulls[9] += weight * c * c
        pulls[10] += weight * (b * ez - c * ey)
        pulls[11] += weight * (c * ex - a * ez)
        pulls[12] += weight * (a * ey - b * ex)
        pulls[13] += weight * ex
        pulls[14] += weight * ey
        pulls[15] += weight * ez


@kernel
def normal_equations(points, pose, planes, which, plane, residuals, kernel_m, weights, gradients, sums):  # type: ignore[no-untyped-def]
    """Write weights (M,) and gradients (M, 6) of squared distances for a motion of the base.

    Cauchy weights, zero beyond two kernels. Into ``sums`` (7, 6) go the Hessian and the gradients' sum.
    """
    for n in range(residuals.shape[0]):
        i = which[n]
        k = plane[n]
        residual = residuals[n]
        u = residual / kernel_m
        weight = 1.0 / (1.0 + u * u) if abs(u) <= 2.0 else 0.0
        weights[n] = weight
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        j3 = pose[0, 0] * planes[k, 3] + pose[1, 0] * planes[k, 4] + pose[2, 0] * planes[k, 5]
        j4 = pose[0, 1] * planes[k, 3] + pose[1, 1] * planes[k, 4] + pose[2, 1] * planes[k, 5]
        j5 = pose[0, 2] * planes[k, 3] + pose[1, 2] * planes[k, 4] + pose[2, 2] * planes[k, 5]
        gradients[n, 0] = y * j5 - z * j4
        gradients[n, 1] = z * j3 - x * j5
        gradients[n, 2] = x * j4 - y * j3
        gradients[n, 3] = j3
        gradients[n, 4] = j4
        gradients[n, 5] = j5
        for row in range(6):
            weighted = weight * gradients[n, row]
            for column in range(row, 6):
                sums[row, column] += weighted * gradients[n, column]
        for row in range(6):
            gradients[n, row] *= weight * residual
            sums[6, row] += gradients[n, row]
    for row in range(1, 6):
        for column in range(row):
            sums[row, column] = sums[column, row]
