"""The surface of all model leaves as flat facets with proven thickness.

A facet is a cell of a leaf's map whose surface may lie in the leaf's region. Over them stands the
hierarchy of `hhsr.kernels.discs`, in the order of `hhsr.kernels.disc_order`: no links are stored.
"""

import math

import numpy as np

from hhsr.kernels.cell import cell_model
from hhsr.kernels.layout import (
    CELL_BITS,
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    ERROR,
    FRAME,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_RECORD,
    PARTING,
    SLOPE_A,
    SLOPE_B,
    VALUE,
    integers,
    tables,
)
from hhsr.kernels.maps import (
    cell_corners,
    cell_sphere,
    model_thickness,
    outside_region,
    plane_of,
    quad_radius_ok,
    ray_thickness,
)
from hhsr.kernels.polygon import ROOM, clip_polygon
from hhsr.kernels.unmanaged import entry, inlined, unmanaged

THICK, RADIUS = 6, 7  # of a facet's disc (`hhsr.kernels.discs`)


@unmanaged
def facet_cell(ints, leaf, code):
    """Return (slot, face, a, b, half) of the cell of a facet's code: its float32 slot, centre and half side."""
    bits = ints[leaf + CELL_BITS]
    base, cell = (code >> 9) & 0x7FFF, (code >> 1) & 0xFF
    word = ints[ints[leaf + PARTING] + base]
    k = word & 7
    half = 1.0 / (1 << (bits + k))
    i, j = (
        ((base >> bits & (1 << bits) - 1) << k) + (cell >> k),
        ((base & (1 << bits) - 1) << k) + (cell & (1 << k) - 1),
    )
    slot = ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + cell)
    return slot, base >> 2 * bits, (2 * i + 1) * half - 1.0, (2 * j + 1) * half - 1.0, half


@inlined
def facet_slot(ints, code):
    """Return the float32 slot of the cell of a facet's code."""
    leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * (code >> 24) + OWNER_RECORD]
    word = ints[ints[leaf + PARTING] + ((code >> 9) & 0x7FFF)]
    return ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + ((code >> 1) & 0xFF))


@unmanaged
def _put_disc(disc, frame, cx, cy, cz, nx, ny, nz, thick, radius):
    """Write a disc given in the leaf's frame, in the tree's."""
    for k in range(3):
        disc[k] = frame[k] + frame[3 + 3 * k] * cx + frame[4 + 3 * k] * cy + frame[5 + 3 * k] * cz
        disc[3 + k] = frame[3 + 3 * k] * nx + frame[4 + 3 * k] * ny + frame[5 + 3 * k] * nz
    disc[THICK], disc[RADIUS] = thick, radius


@entry
def list_facets(blob, owner, leaf, planes, count, codes, discs):
    """Fill codes (m,) and discs (m, 8) of the facets of a leaf; return how many. Call with m the number of its cells.

    A code holds the owner, the base cell, the cell in it, and in its lowest bit whether no cut touches the facet.
    """
    ints, tab = integers(blob), tables(blob)
    corners, spare = np.empty((ROOM, 3)), np.empty((ROOM, 3))
    n = ints[leaf + CELLS]
    o = ints[leaf + FRAME]
    frame = blob[o : o + 12]
    found = 0
    for base in range(6 * n * n):
        word = ints[ints[leaf + PARTING] + base]
        if word & 8 == 0:
            continue
        s = 1 << (word & 7)
        for cell in range(s * s):
            code = (((owner << 15) + base) << 9) + (cell << 1)
            o, face, a, b, half = facet_cell(ints, leaf, code)
            value, ga, gb, error = tab[o + VALUE], tab[o + SLOPE_A], tab[o + SLOPE_B], tab[o + ERROR]
            if not quad_radius_ok(value, ga, gb, error, half, half):
                lo, hi = cell_model(blob, ints, leaf, face, a, b, half, half, np.bool_(False))[6:8]
                x, y, z, radius = cell_sphere(face, a, b, half, half, value, ga, gb, error, lo, hi)
                if not outside_region(blob, planes, count, x, y, z, radius):
                    _put_disc(discs[found], frame, x, y, z, 0.0, 0.0, 1.0, radius, radius)
                    codes[found] = code
                    found += 1
                continue
            whole = True
            slant = ray_thickness(face, a, b, half, half, value, ga, gb, error)
            cell_corners(face, a, b, half, value, ga, gb, corners)
            size = np.int64(4)
            for k in range(count):
                q = planes + 4 * k
                for i in range(size):
                    h = blob[q] * corners[i, 0] + blob[q + 1] * corners[i, 1] + blob[q + 2] * corners[i, 2]
                    whole = whole and h < blob[q + 3] - slant
                size = clip_polygon(corners, size, spare, blob[q], blob[q + 1], blob[q + 2], blob[q + 3] + slant)
            if size == 0:
                continue
            cx = cy = cz = radius = 0.0
            for i in range(size):
                cx, cy, cz = cx + corners[i, 0] / size, cy + corners[i, 1] / size, cz + corners[i, 2] / size
            for i in range(size):
                d2 = (corners[i, 0] - cx) ** 2 + (corners[i, 1] - cy) ** 2 + (corners[i, 2] - cz) ** 2
                radius = max(radius, math.sqrt(d2))
            gx, gy, gz = plane_of(face, a, b, value, ga, gb)
            g = math.sqrt(gx * gx + gy * gy + gz * gz)
            thick = model_thickness(face, a, b, half, half, value, ga, gb, error)
            _put_disc(discs[found], frame, cx, cy, cz, gx / g, gy / g, gz / g, thick, radius + slant)
            codes[found] = code + (1 if whole else 0)
            found += 1
    return found
