"""How well a part could be told as a radius over directions: a cheap bound for many cuts and centres (DESIGN §3)."""

import math

import numpy as np
from numba import njit, prange

CELLS_PER_EDGE = 4
CELLS = 6 * CELLS_PER_EDGE * CELLS_PER_EDGE
SUMS = 10
GRAZING = 0.2


@njit(cache=True, nogil=True)
def add_member(x, y, z, normals, i, sums):
    """Add sample i, at (x, y, z) from a centre that sees it, to the sums of its cell of directions."""
    r = math.sqrt(x * x + y * y + z * z) + 1e-12
    cosine = (x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2]) / r
    w = max(abs(cosine), GRAZING)
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, a, b = (0 if x >= 0.0 else 1), y / ax, z / ax
    elif ay >= az:
        face, a, b = (2 if y >= 0.0 else 3), x / ay, z / ay
    else:
        face, a, b = (4 if z >= 0.0 else 5), x / az, y / az
    # cells of nearly equal solid angle: the warp's slope is 4/3 at a face's middle, 2/3 at its edge
    a = 0.5 * CELLS_PER_EDGE * (1.0 + a * (4.0 - abs(a)) / 3.0)
    b = 0.5 * CELLS_PER_EDGE * (1.0 + b * (4.0 - abs(b)) / 3.0)
    ia, ib = min(int(a), CELLS_PER_EDGE - 1), min(int(b), CELLS_PER_EDGE - 1)
    s = sums[(face * CELLS_PER_EDGE + ia) * CELLS_PER_EDGE + ib]
    a -= ia + 0.5
    b -= ib + 0.5
    s[0] += w
    s[1] += w * a
    s[2] += w * b
    s[3] += w * a * a
    s[4] += w * a * b
    s[5] += w * b * b
    s[6] += w * r
    s[7] += w * a * r
    s[8] += w * b * r
    s[9] += w * r * r


@njit(cache=True, nogil=True)
def _accumulate(points, normals, order, gaps, heights, plane_offset, side, cx, cy, cz, sums):
    """Add the members of one side of a plane that a centre sees to the sums of their cells of directions.

    Returns what the members cost that it does not see.
    """
    sums[:] = 0.0
    hidden = 0.0
    for at in range(order.shape[0]):
        i = order[at]
        if side != 0 and (heights[at] - plane_offset) * side < 0.0:
            continue
        if gaps[at] > 0.0:
            hidden += gaps[at]
        else:
            add_member(points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz, normals, i, sums)
    return hidden


@njit(cache=True, nogil=True)
def misfit_of_cells(sums, power):
    """Return Σ over cells W (SSE / W)^(power/2): what a plane per cell leaves of the radii, in mm^power · samples."""
    total = 0.0
    for cell in range(CELLS):
        s = sums[cell]
        w = s[0]
        if w <= 0.0:
            continue
        ma, mb, mr = s[1] / w, s[2] / w, s[6] / w
        # the slope's ridge: a cell with few points must not fit them all
        aa = s[3] - w * ma * ma + 0.15
        bb = s[5] - w * mb * mb + 0.15
        ab = s[4] - w * ma * mb
        ar = s[7] - w * ma * mr
        br = s[8] - w * mb * mr
        det = aa * bb - ab * ab
        sse = s[9] - w * mr * mr - (ar * (ar * bb - br * ab) + br * (br * aa - ar * ab)) / det
        if sse > 0.0:
            total += w * (sse / w) ** (0.5 * power)
    return total


@njit(cache=True, nogil=True, parallel=True)
def best_centres(points, normals, order, gaps, heights, offsets, candidates, candidate_heights, power):
    """Look at each cut of one part: the least misfit of either side over the candidate centres that lie in it.

    points, normals: (n, 3). order: (m,) the part's members. gaps: (c, m) what a member costs that a centre
    does not see, 0 where it sees it. heights: (d, m) of the members along each direction.
    offsets: (d, k) planes along each direction. candidates: (c, 3) centres inside the solid and the part;
    candidate_heights: (d, c). Returns (d, k, 2) misfits, left (below) and right, inf where a side holds no centre,
    and (d, k, 2) which centre.
    """
    directions, planes = offsets.shape
    misfit = np.full((directions, planes, 2), np.inf)
    which = np.full((directions, planes, 2), -1, np.int64)
    for job in prange(directions * planes):
        d, k = job // planes, job % planes
        sums = np.zeros((CELLS, SUMS))
        for s in range(2):
            side = 2 * s - 1
            for c in range(candidates.shape[0]):
                if (candidate_heights[d, c] - offsets[d, k]) * side <= 0.0:
                    continue
                hidden = _accumulate(
                    points,
                    normals,
                    order,
                    gaps[c],
                    heights[d],
                    offsets[d, k],
                    side,
                    candidates[c, 0],
                    candidates[c, 1],
                    candidates[c, 2],
                    sums,
                )
                value = hidden + misfit_of_cells(sums, power)
                if value < misfit[d, k, s]:
                    misfit[d, k, s] = value
                    which[d, k, s] = c
    return misfit, which


@njit(cache=True, nogil=True, parallel=True)
def misfits(points, normals, order, gaps, candidates, power):
    """Return (c,) the misfit of one part, whole, seen from each candidate centre."""
    out = np.empty(candidates.shape[0])
    heights = np.zeros(order.shape[0])
    for c in prange(candidates.shape[0]):
        sums = np.zeros((CELLS, SUMS))
        x, y, z = candidates[c, 0], candidates[c, 1], candidates[c, 2]
        hidden = _accumulate(points, normals, order, gaps[c], heights, 0.0, 0, x, y, z, sums)
        out[c] = hidden + misfit_of_cells(sums, power)
    return out
