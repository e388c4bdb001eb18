"""Extract the surface of a signed distance field as triangles, with one vertex per voxel that it crosses.

Surface nets, after Gibson, "Constrained elastic surface nets" (MICCAI 1998): a vertex is the mean of where
the surface cuts the edges of a cell of eight voxels, and an edge that is cut has a face of its four cells.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel
from slam.mapping.voxel_blocks import BAND_STEPS, COLOR_STEPS, SIDE, VOXELS, VoxelBlocks, coordinates, keys_at
from slam.measurements import Float32Array

Mesh = tuple[Float32Array, NDArray[np.uint8], Float32Array, NDArray[np.int32]]


def surface_of_blocks(blocks: VoxelBlocks, least_views: int) -> Mesh:
    """Extract the zero level of the field between voxels seen by enough frames; the blocks are cleared.

    Returns
    -------
    Vertices (V, 3) in metres, their RGB (V, 3) and unit normals (V, 3) towards where the surface was seen
    from, and faces (F, 3), counter-clockwise from that side.
    """
    # Corners of a cell by three bits (x, y, z), and the ends of its edges.
    bits, corners = (4, 2, 1), range(8)
    edges = np.array([(corner, corner | bit) for bit in bits for corner in corners if not corner & bit])
    offsets = np.array([[(corner // bit) % 2 for bit in bits] for corner in corners])
    places = coordinates(blocks.keys)
    above, below = (
        np.stack([blocks.find(keys_at(places + sign * offset)) for offset in offsets], axis=1)
        for sign in (1, -1)
    )
    fields = blocks.distance, blocks.weight, blocks.color, least_views, blocks.voxel_m
    tile, at_corners, batch = np.empty((SIDE + 1,) * 3), np.empty(8), VOXELS * VOXELS
    rows = ((3, np.float32), (3, np.uint8), (3, np.float32), (1, np.int32), (1, np.uint8))
    room = [np.empty((batch, columns), kind).squeeze() for columns, kind in rows]
    parts = [[part[:0] for part in room]]
    for first in range(0, len(blocks), VOXELS):
        some = slice(first, first + VOXELS)
        count = _vertices(first, places[some], above[some], *fields, edges, tile, at_corners, *room)
        parts.append([part[:count].copy() for part in room])
    vertices, colors, normals, cells, signs = (np.concatenate(part) for part in zip(*parts, strict=True))
    del room, parts, fields
    blocks.forget()
    starts = np.searchsorted(cells, VOXELS * np.arange(len(blocks) + 1))
    batches, triangles = [np.empty((0, 3), np.int32)], np.empty((6 * batch, 3), np.int32)
    for first in range(0, len(cells), batch):
        stop = min(first + batch, len(cells))
        count = _faces(first, stop, vertices, cells, signs, starts, below, np.empty(4, np.int64), triangles)
        batches.append(triangles[:count].copy())
    return vertices, colors, normals, np.concatenate(batches)


@kernel(nogil=True)
def _vertices(  # type: ignore[no-untyped-def]
    first, places, above, distance, weight, color, least, voxel_m, edges, tile, corners, *room
):
    """Write vertices of the blocks from number ``first`` on into ``room``; return their number.

    It has arrays for positions, colours, normals, cell numbers, and the signs of a cell's corners.
    """
    vertices, colors, normals, cells, signs = room
    unknown = 2.0 * BAND_STEPS
    count = ZERO
    for n in range(places.shape[0]):
        for x in range(SIDE + 1):
            for y in range(SIDE + 1):
                for z in range(SIDE + 1):
                    block = above[n, 4 * (x >> 3) + 2 * (y >> 3) + (z >> 3)]
                    i = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
                    known = block >= 0 and weight[block, i] >= least
                    tile[x, y, z] = distance[block, i] if known else unknown
        for i in range(VOXELS):
            x, y, z = i >> 6, (i >> 3) & 7, i & 7
            inside = ZERO
            for corner in range(8):
                corners[corner] = tile[x + (corner >> 2), y + ((corner >> 1) & 1), z + (corner & 1)]
                if corners[corner] == unknown:
                    inside = 256
                elif corners[corner] < 0.0:
                    inside |= 1 << corner
            if inside == 0 or inside >= 255:
                continue
            cells[count], signs[count] = (first + n) * VOXELS + i, inside
            _cell(places[n], x, y, z, above[n], color, edges, corners, colors[count], vertices[count])
            gx = gy = gz = 0.0
            for corner in range(8):
                gx += corners[corner] if corner & 4 else -corners[corner]
                gy += corners[corner] if corner & 2 else -corners[corner]
                gz += corners[corner] if corner & 1 else -corners[corner]
            length = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1.0)
            normals[count, 0], normals[count, 1], normals[count, 2] = gx / length, gy / length, gz / length
            for axis in range(3):
                vertices[count, axis] *= voxel_m
            count += 1
    return count


@kernel(nogil=True, inline="always")
def _cell(place, x, y, z, above, color, edges, corners, rgb, vertex):  # type: ignore[no-untyped-def]
    """Return mean position, in voxels, and colour of the surface's intersections with a cell's edges."""
    cut = ZERO
    px = py = pz = red = green = blue = 0.0
    for edge in range(edges.shape[0]):
        a, b = edges[edge, 0], edges[edge, 1]
        if (corners[a] < 0.0) == (corners[b] < 0.0):
            continue
        share = corners[a] / (corners[a] - corners[b])
        cut += 1
        for end in range(2):
            corner = edges[edge, end]
            part = share if end else 1.0 - share
            cx, cy, cz = x + (corner >> 2), y + ((corner >> 1) & 1), z + (corner & 1)
            px += part * cx
            py += part * cy
            pz += part * cz
            block = above[4 * (cx >> 3) + 2 * (cy >> 3) + (cz >> 3)]
            i = ((cx & 7) << 6) | ((cy & 7) << 3) | (cz & 7)
            red += part * color[block, i, 0]
            green += part * color[block, i, 1]
            blue += part * color[block, i, 2]
    vertex[0] = SIDE * place[0] + px / cut
    vertex[1] = SIDE * place[1] + py / cut
    vertex[2] = SIDE * place[2] + pz / cut
    rgb[0] = math.floor(red / (cut * COLOR_STEPS) + 0.5)
    rgb[1] = math.floor(green / (cut * COLOR_STEPS) + 0.5)
    rgb[2] = math.floor(blue / (cut * COLOR_STEPS) + 0.5)


@kernel(nogil=True)
def _faces(  # type: ignore[no-untyped-def]
    first, stop, vertices, cells, signs, starts, below, around, triangles
):
    """Write triangles around the cut edges at the first corner of each cell; return their number."""
    count = ZERO
    for vertex in range(first, stop):
        for axis in range(3):
            outside_ahead = signs[vertex] & 1
            if outside_ahead == (signs[vertex] >> (4 >> axis)) & 1:
                continue
            # The cells about the edge, counter-clockwise from its far end: back along both other axes,
            # along the second, at the edge, along the first.
            one, other = 4 >> ((axis + 1) % 3), 4 >> ((axis + 2) % 3)
            around[0] = _at(cells, starts, below, cells[vertex], one | other)
            around[1] = _at(cells, starts, below, cells[vertex], other)
            around[2] = vertex
            around[3] = _at(cells, starts, below, cells[vertex], one)
            if around[0] < 0 or around[1] < 0 or around[3] < 0:
                continue
            # Divide along the shorter diagonal: on a curved surface, the other one may fold it.
            across = along = 0.0
            for i in range(3):
                across += (vertices[around[0], i] - vertices[around[2], i]) ** 2
                along += (vertices[around[1], i] - vertices[around[3], i]) ** 2
            turn = 1 if along < across else 0
            for half in range(2):
                a, b, c = turn + 2 * half, (turn + 2 * half + 1) & 3, (turn + 2 * half + 2) & 3
                triangles[count, 0] = around[a]
                triangles[count, 1] = around[b if outside_ahead else c]
                triangles[count, 2] = around[c if outside_ahead else b]
                count += 1
    return count


@kernel(nogil=True)
def _at(cells: NDArray[Any], starts: NDArray[Any], below: NDArray[Any], cell: int, back: int) -> int:
    """Return the vertex of the cell one step back along the axes of the bits; -1 if there is none."""
    x, y, z = ((cell >> 6) & 7) - (back >> 2), ((cell >> 3) & 7) - ((back >> 1) & 1), (cell & 7) - (back & 1)
    block = below[cell // VOXELS, 4 * (x < 0) + 2 * (y < 0) + (z < 0)]
    if block < 0:
        return -1
    key = block * VOXELS + (((x & 7) << 6) | ((y & 7) << 3) | (z & 7))
    low, high = starts[block], starts[block + 1]
    while low < high:
        middle = (low + high) // 2
        if cells[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < starts[block + 1] and cells[low] == key else -1
