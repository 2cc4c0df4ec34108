"""A hierarchy of discs over the facets, sixteen children a node, laid out so that one loop bounds all of them.

A disc holds all surface of its facets: no farther than THICK from the plane through its centre (slots 0–2) across its
normal (3–5), and within that no farther than RADIUS from the centre. Discs of level 0 hold one facet each, those of a
level above sixteen of the level below. Block i of a level holds its discs 16i … 16i + 15 as DISC_SIZE rows of sixteen
float32, rounded outward, in the tree's frame.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.facets import RADIUS, THICK
from hhsr.kernels.unmanaged import inlined, unmanaged

DISC_SIZE = 8
WIDE = 16
BLOCK = WIDE * DISC_SIZE
STEPS = 8  # of a disc's centre towards the farthest of its facets
SLACK = 1e-6  # more than float32 rounds, relative


def level_sizes(facets: int) -> list[int]:
    """Return how many discs each level has, lowest first, until one block is enough."""
    sizes = [facets] if facets else []
    while sizes and sizes[-1] > WIDE:
        sizes.append(-(-sizes[-1] // WIDE))
    return sizes


@unmanaged
def _centre_disc(facets, first, last, nx, ny, nz, disc):
    """Move a disc's centre, along its axis n to the middle of its facets, and across it to where the farthest is near.

    Across: steps towards the farthest, each shorter (Bădoiu and Clarkson, 2003, "Smaller core-sets for balls").
    """
    low, high = np.inf, -np.inf
    for q in range(first, last):
        rx, ry, rz = facets[q, 0] - disc[0], facets[q, 1] - disc[1], facets[q, 2] - disc[2]
        along = rx * nx + ry * ny + rz * nz
        turn = min(abs(nx * facets[q, 3] + ny * facets[q, 4] + nz * facets[q, 5]), 1.0)
        reach = turn * facets[q, THICK] + math.sqrt(1.0 - turn * turn) * facets[q, RADIUS]
        low, high = min(low, along - reach), max(high, along + reach)
    move = 0.5 * (low + high)
    if not abs(move) < np.inf:
        return
    cx, cy, cz = disc[0] + move * nx, disc[1] + move * ny, disc[2] + move * nz
    for turn in range(STEPS):
        far = fx = fy = fz = 0.0
        for q in range(first, last):
            rx, ry, rz = facets[q, 0] - cx, facets[q, 1] - cy, facets[q, 2] - cz
            along = rx * nx + ry * ny + rz * nz
            rx, ry, rz = rx - along * nx, ry - along * ny, rz - along * nz
            aside = math.sqrt(rx * rx + ry * ry + rz * rz) + facets[q, RADIUS]
            if aside > far:
                far, fx, fy, fz = aside, rx, ry, rz
        share = 1.0 / (3.0 + turn)
        cx, cy, cz = cx + share * fx, cy + share * fy, cz + share * fz
    disc[0], disc[1], disc[2] = cx, cy, cz


@njit(cache=True, nogil=True, error_model="numpy")
def fill_discs(facets, sizes, blocks):
    """Fill the blocks (Σ ⌈size/16⌉, DISC_SIZE, 16) float32, lowest level first, from the facets' discs (m, 8)."""
    start, span = 0, 1
    for level in range(sizes.shape[0]):
        for i in range(sizes[level]):
            out = blocks[start + i // WIDE, :, i % WIDE]
            first, last = i * span, min((i + 1) * span, facets.shape[0])
            for k in range(6):
                total = 0.0
                for q in range(first, last):
                    total += facets[q, k]
                out[k] = total / (last - first)
            nx, ny, nz = np.float64(out[3]), np.float64(out[4]), np.float64(out[5])
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 1e-3:
                out[3], out[4], out[5] = nx / length, ny / length, nz / length
            else:
                out[3], out[4], out[5] = 0.0, 0.0, 1.0
            # The direction that was stored is the disc's axis, exactly.
            nx, ny, nz = np.float64(out[3]), np.float64(out[4]), np.float64(out[5])
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx / length, ny / length, nz / length
            if span > 1:
                _centre_disc(facets, first, last, nx, ny, nz, out)
            thick = radius = 0.0
            for q in range(first, last):
                rx, ry, rz = facets[q, 0] - out[0], facets[q, 1] - out[1], facets[q, 2] - out[2]
                along = rx * nx + ry * ny + rz * nz
                aside = math.sqrt(max(rx * rx + ry * ry + rz * rz - along * along, 0.0))
                turn = min(abs(nx * facets[q, 3] + ny * facets[q, 4] + nz * facets[q, 5]), 1.0)
                tilt = math.sqrt(1.0 - turn * turn) + SLACK
                thick = max(thick, abs(along) + turn * facets[q, THICK] + tilt * facets[q, RADIUS])
                radius = max(radius, aside + facets[q, RADIUS] + tilt * facets[q, THICK])
            grow = SLACK * (abs(out[0]) + abs(out[1]) + abs(out[2]) + radius + thick)
            out[THICK], out[RADIUS] = thick + grow, radius + grow
        start += -(-sizes[level] // WIDE)
        span *= WIDE


# The loops below run in lanes, in float32 throughout: `loose` (mm) is more than that rounds at the coordinates at hand.
LOOSE = 2e-6
MOST = 1e38  # a squared distance that float32 still holds
_SHORT, _LONG, _NONE, _ALL = np.float32(1.0 - 1e-6), np.float32(1.0 + 1e-6), np.float32(0.0), np.float32(1.0)
_TINY, _BLUR = np.float32(1e-30), np.float32(4e-6)  # mm²; what float32 leaves of a squared cosine, and more


@inlined
def bound_to_point(blocks, i, x, y, z, loose, most, bounds):
    """Fill bounds (16,) float32 with lower bounds of the squared distances of a point to the discs of a block.

    Returns a mask: bit c is set where bound c is no more than `most`. blocks: (…, DISC_SIZE, 16) float32.
    """
    k, mask, limit = np.uint64(i), np.uint32(0), np.float32(min(most, MOST)) * _LONG
    px, py, pz, e = np.float32(x), np.float32(y), np.float32(z), np.float32(loose)
    for c in range(bounds.shape[0]):
        rx, ry, rz = px - blocks[k, 0, c], py - blocks[k, 1, c], pz - blocks[k, 2, c]
        h = abs(rx * blocks[k, 3, c] + ry * blocks[k, 4, c] + rz * blocks[k, 5, c])
        along = max(h * _SHORT - (blocks[k, 6, c] + e), _NONE)
        h *= _LONG
        aside = math.sqrt(max(rx * rx + ry * ry + rz * rz - h * h, _NONE)) * _SHORT
        aside = max(aside - (blocks[k, 7, c] + e), _NONE)
        bounds[c] = (along * along + aside * aside) * _SHORT
        mask |= np.uint32(np.uint32(bounds[c] <= limit) << np.uint32(c))
    return mask


@inlined
def bound_to_segment(blocks, i, x, y, z, dx, dy, dz, loose, most, bounds):
    """Do as `bound_to_point` for p + t·d: by the slab about a disc's plane, and by the plane across the shortest way.

    The shortest way from the disc's centre to the segment has a direction u in which no point of the segment lies
    farther back; the disc reaches RADIUS·√(1 − (n·u)²) + THICK that way. Roundings turn u by less than loose/length.
    """
    k, mask, limit = np.uint64(i), np.uint32(0), np.float32(min(most, MOST)) * _LONG
    px, py, pz, e = np.float32(x), np.float32(y), np.float32(z), np.float32(loose)
    vx, vy, vz = np.float32(dx), np.float32(dy), np.float32(dz)
    over = np.float32(1.0 / (dx * dx + dy * dy + dz * dz))
    for c in range(bounds.shape[0]):
        rx, ry, rz = px - blocks[k, 0, c], py - blocks[k, 1, c], pz - blocks[k, 2, c]
        nx, ny, nz = blocks[k, 3, c], blocks[k, 4, c], blocks[k, 5, c]
        h = rx * nx + ry * ny + rz * nz
        g = h + (vx * nx + vy * ny + vz * nz)
        thick, radius = blocks[k, 6, c] + e, blocks[k, 7, c] + e
        # Both ends on one side: the nearer one's height; else the segment meets the plane.
        slab = max(min(h, g), -max(h, g)) * _SHORT - thick
        # A t off the nearest point's by rounding: its distance hardly grows.
        t = min(max(-(rx * vx + ry * vy + rz * vz) * over, _NONE), _ALL)
        rx, ry, rz = rx + t * vx, ry + t * vy, rz + t * vz
        length2 = max(rx * rx + ry * ry + rz * rz, _TINY)
        length = math.sqrt(length2)
        h = rx * nx + ry * ny + rz * nz
        aside = math.sqrt(max(_ALL - h * h / length2, _NONE) + _BLUR) + e / length
        low = max(max(slab, length * _SHORT - radius * aside - thick), _NONE)
        bounds[c] = low * low * _SHORT
        mask |= np.uint32(np.uint32(bounds[c] <= limit) << np.uint32(c))
    return mask


# The place of a lone bit: the top five bits of its product with de Bruijn's number tell all 32 apart.
_DE_BRUIJN = 0x077CB531
_PLACES = np.empty(32, dtype=np.int64)
for _k in range(32):
    _PLACES[((_DE_BRUIJN << _k) & 0xFFFFFFFF) >> 27] = _k


@unmanaged
def lowest_bit(mask):
    """Return (c, rest): the place of the lowest bit of a mask that is not 0, and the mask without it."""
    bit = np.int64(mask) & -np.int64(mask)
    return _PLACES[(bit * _DE_BRUIJN & 0xFFFFFFFF) >> 27], np.int64(mask) ^ bit
