"""A hierarchy of discs over the facets, sixteen children a node, laid out so that one loop bounds all of them.

A disc holds all surface of its facets: no farther than THICK from the plane through its centre (slots 0–2) across its
normal (3–5), and within that no farther than RADIUS from the centre. Discs of level 0 hold one facet each, those of a
level above sixteen of the level below. Block i of a level holds its discs 16i … 16i + 15 as DISC_SIZE rows of sixteen
float32, rounded outward, in the tree's frame.
"""

import math

import numpy as np

from hhsr.kernels.disc_bounds import WIDE
from hhsr.kernels.facets import RADIUS, THICK
from hhsr.kernels.unmanaged import entry, unmanaged

TOP = 2  # blocks of the highest level
STEPS = 8  # of a disc's centre towards the farthest of its facets
SLACK = 1e-6  # more than float32 rounds, relative


def level_sizes(facets: int) -> list[int]:
    """Return how many discs each level has, lowest first, until a few blocks are enough.

    One for two blocks would be asked of every search, and rule out neither.
    """
    sizes = [facets] if facets else []
    while sizes and sizes[-1] > TOP * WIDE:
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


@entry
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
