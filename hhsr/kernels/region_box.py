"""The box of an owner's surface within its region, in any rotated frame."""

import numpy as np
from numba import njit

from hhsr.kernels.cell import cell_model
from hhsr.kernels.layout import (
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    ERROR,
    PARTING,
    SLOPE_A,
    SLOPE_B,
    VALUE,
    integers,
    tables,
)
from hhsr.kernels.maps import cell_corners, cell_sphere, outside_region, quad_radius_ok, ray_thickness
from hhsr.kernels.part import TRIANGLES, part_arrays
from hhsr.kernels.polygon import ROOM, clip_polygon
from hhsr.kernels.unmanaged import entry


@njit(cache=True, error_model="numpy")
def _add(box, rotation, x, y, z, grow):
    for k in range(3):
        v = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
        box[k], box[3 + k] = min(box[k], v - grow), max(box[3 + k], v + grow)


@njit(cache=True, error_model="numpy")
def _add_steep(blob, ints, leaf, planes, count, face, a, b, half, rotation, box):
    """Add a cell too steep for its tangent plane, in 16 × 16 parts, each by its enclosing sphere."""
    part = half / 16.0
    for i in range(16):
        for j in range(16):
            ca, cb = a - half + (2 * i + 1) * part, b - half + (2 * j + 1) * part
            value, ga, gb, error, _, _, lo, hi = cell_model(
                blob, ints, leaf, face, ca, cb, part, part, np.bool_(False)
            )[:8]
            x, y, z, radius = cell_sphere(face, ca, cb, part, part, value, ga, gb, error, lo, hi)
            if not outside_region(blob, planes, count, x, y, z, radius):
                _add(box, rotation, x, y, z, radius)


@entry
def leaf_box(blob, leaf, planes, count, rotation, box):
    """Fill (6,) lowest and highest corner of R·(surface of a model leaf within its region); lowest > highest: empty."""
    ints, tab = integers(blob), tables(blob)
    corners, spare = np.empty((ROOM, 3)), np.empty((ROOM, 3))
    box[:3], box[3:] = np.inf, -np.inf
    n = ints[leaf + CELLS]
    for base in range(6 * n * n):
        face, i, j = base // (n * n), base // n % n, base % n
        word = ints[ints[leaf + PARTING] + base]
        if word & 8 == 0:
            continue
        s = 1 << (word & 7)
        half = 1.0 / (n * s)
        for cell in range(s * s):
            o = ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + cell)
            a, b = (2 * (i * s + cell // s) + 1) * half - 1.0, (2 * (j * s + cell % s) + 1) * half - 1.0
            value, ga, gb, error = tab[o + VALUE], tab[o + SLOPE_A], tab[o + SLOPE_B], tab[o + ERROR]
            if not quad_radius_ok(value, ga, gb, error, half, half):
                _add_steep(blob, ints, leaf, planes, count, face, a, b, half, rotation, box)
                continue
            thick = ray_thickness(face, a, b, half, half, value, ga, gb, error)
            cell_corners(face, a, b, half, value, ga, gb, corners)
            size = 4
            for k in range(count):
                q = planes + 4 * k
                size = clip_polygon(corners, size, spare, blob[q], blob[q + 1], blob[q + 2], blob[q + 3] + thick)
            for k in range(size):
                _add(box, rotation, corners[k, 0], corners[k, 1], corners[k, 2], thick)


@entry
def part_box(blob, part, planes, count, rotation, box):
    """Fill (6,) the same of a retained part's triangles within its region."""
    ints = integers(blob)
    corners, spare = np.empty((ROOM, 3)), np.empty((ROOM, 3))
    box[:3], box[3:] = np.inf, -np.inf
    if ints[part + TRIANGLES] == 0:
        return
    _, _, triangles = part_arrays(blob, ints, part)
    for i in range(triangles.shape[0]):
        corners[:3] = triangles[i]
        size = 3
        for k in range(count):
            q = planes + 4 * k
            size = clip_polygon(corners, size, spare, blob[q], blob[q + 1], blob[q + 2], blob[q + 3])
        for k in range(size):
            _add(box, rotation, corners[k, 0], corners[k, 1], corners[k, 2], 0.0)
