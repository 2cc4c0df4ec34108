"""The surface of all model leaves as flat facets with proven thickness, under one hierarchy of discs.

A facet is a cell of a leaf's map whose surface may lie in the leaf's region. Facets are sorted along a Morton curve
over each
face; a square of four makes a node of level 0 (codes of −1 fill up where one is missing), four nodes one of the next
level: no links are stored. A disc holds all surface of its
facets: no farther than THICK from the plane through its centre (slots 0–2) across its normal (3–5), and within that no
farther than RADIUS from the centre. Discs are in the tree's frame, those of nodes float32, rounded outward.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.cell import cell_model
from hhsr.kernels.layout import (
    CELL_BITS,
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    ERROR,
    FINEST_PARTING,
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

FAN = 4  # facets of a node of level 0, and nodes of a node above
THICK, RADIUS, DISC_SIZE = 6, 7, 8
SLACK = 1e-6  # more than float32 rounds, relative


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _put_disc(disc, frame, cx, cy, cz, nx, ny, nz, thick, radius):
    """Write a disc given in the leaf's frame, in the tree's."""
    for k in range(3):
        disc[k] = frame[k] + frame[3 + 3 * k] * cx + frame[4 + 3 * k] * cy + frame[5 + 3 * k] * cz
        disc[3 + k] = frame[3 + 3 * k] * nx + frame[4 + 3 * k] * ny + frame[5 + 3 * k] * nz
    disc[THICK], disc[RADIUS] = thick, radius


@njit(cache=True, nogil=True, error_model="numpy")
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
                _, _, _, _, _, _, lo, hi, _, _ = cell_model(blob, ints, leaf, face, a, b, half, half)
                x, y, z, radius = cell_sphere(face, a, b, half, half, value, ga, gb, error, lo, hi)
                if not outside_region(blob, planes, count, x, y, z, radius):
                    _put_disc(discs[found], frame, x, y, z, 0.0, 0.0, 1.0, radius, radius)
                    codes[found] = code
                    found += 1
                continue
            whole = True
            slant = ray_thickness(face, a, b, half, half, value, ga, gb, error)
            cell_corners(face, a, b, half, value, ga, gb, corners)
            size = 4
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


@njit(cache=True, error_model="numpy")
def _spread(x):
    """Return the lowest 16 bits of x with a zero between each."""
    x &= 0xFFFF
    x = (x | (x << 8)) & 0x00FF00FF
    x = (x | (x << 4)) & 0x0F0F0F0F
    x = (x | (x << 2)) & 0x33333333
    return (x | (x << 1)) & 0x55555555


@njit(cache=True, nogil=True, error_model="numpy")
def place_facets(blob, codes, keys, groups):
    """Fill (m,) places of the facets along a Morton curve over each face, and (m,) the square of four of each."""
    ints = integers(blob)
    for q in range(codes.shape[0]):
        owner, base, cell = codes[q] >> 24, (codes[q] >> 9) & 0x7FFF, (codes[q] >> 1) & 0xFF
        leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * owner + OWNER_RECORD]
        n = ints[leaf + CELLS]
        k = ints[ints[leaf + PARTING] + base] & 7
        finer = FINEST_PARTING - k
        i = ((base // n % n << k) + (cell >> k)) << finer
        j = ((base % n << k) + (cell & ((1 << k) - 1))) << finer
        place = (_spread(i) << 1) | _spread(j)
        keys[q] = (((owner << 3) + base // (n * n)) << 32) | place
        groups[q] = (keys[q] >> (2 * finer + 2)) << 3 | k


def level_sizes(facets: int) -> list[int]:
    """Return the nodes of each level, lowest first, until one node of FAN or fewer is left."""
    sizes = [-(-facets // FAN)] if facets else []
    while sizes and sizes[-1] > FAN:
        sizes.append(-(-sizes[-1] // FAN))
    return sizes


@njit(cache=True, nogil=True, error_model="numpy")
def fill_nodes(discs, sizes, nodes):
    """Fill the levels' discs (Σ sizes, 8) float32, lowest level first, from the sorted facets' discs (m, 8).

    A disc of negative radius is none; every node has one that is.
    """
    start, span = 0, 1
    for level in range(sizes.shape[0]):
        span *= FAN
        for i in range(sizes[level]):
            first, last = i * span, min((i + 1) * span, discs.shape[0])
            out = nodes[start + i]
            for k in range(6):
                total = 0.0
                count = 0
                for q in range(first, last):
                    if discs[q, RADIUS] >= 0.0:
                        total += discs[q, k]
                        count += 1
                out[k] = total / count
            nx, ny, nz = np.float64(out[3]), np.float64(out[4]), np.float64(out[5])
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 1e-3:
                out[3], out[4], out[5] = nx / length, ny / length, nz / length
            else:
                out[3], out[4], out[5] = 0.0, 0.0, 1.0
            # The stored normal's own length, off 1 by its rounding, is allowed for by SLACK.
            nx, ny, nz = np.float64(out[3]), np.float64(out[4]), np.float64(out[5])
            thick = radius = 0.0
            for q in range(first, last):
                if discs[q, RADIUS] < 0.0:
                    continue
                rx, ry, rz = discs[q, 0] - out[0], discs[q, 1] - out[1], discs[q, 2] - out[2]
                along = rx * nx + ry * ny + rz * nz
                aside = math.sqrt(max(rx * rx + ry * ry + rz * rz - along * along, 0.0))
                turn = min(abs(nx * discs[q, 3] + ny * discs[q, 4] + nz * discs[q, 5]), 1.0)
                tilt = math.sqrt(1.0 - turn * turn) + SLACK
                thick = max(thick, abs(along) + turn * discs[q, THICK] + tilt * discs[q, RADIUS])
                radius = max(radius, aside + discs[q, RADIUS] + tilt * discs[q, THICK])
            grow = SLACK * (abs(out[0]) + abs(out[1]) + abs(out[2]) + radius + thick)
            out[THICK], out[RADIUS] = thick + grow, radius + grow
        start += sizes[level]
