"""How well a part could be told as a radius over directions: a cheap bound for many cuts and centres (DESIGN §3)."""

import math

import numpy as np
from numba import njit

CELLS_PER_EDGE = 4
CELLS = 6 * CELLS_PER_EDGE * CELLS_PER_EDGE
SUMS = 10
GRAZING = 0.2


@njit(cache=True, nogil=True)
def term_of(x, y, z, normals, i, term):
    """Fill in what sample i, at (x, y, z) from a centre that sees it, adds to the sums of its cell; return the cell."""
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
    a -= ia + 0.5
    b -= ib + 0.5
    term[0] = w
    term[1] = w * a
    term[2] = w * b
    term[3] = w * a * a
    term[4] = w * a * b
    term[5] = w * b * b
    term[6] = w * r
    term[7] = w * a * r
    term[8] = w * b * r
    term[9] = w * r * r
    return (face * CELLS_PER_EDGE + ia) * CELLS_PER_EDGE + ib


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
            total += w * (math.sqrt(sse / w) if power == 1.0 else (sse / w) ** (0.5 * power))
    return total


@njit(cache=True, nogil=True)
def best_centres(points, normals, order, gaps, heights, offsets, candidates, candidate_heights, power):
    """Look at each cut of one part: the least misfit of either side over the candidate centres that lie in it.

    points, normals: (n, 3). order: (m,) the part's members. gaps: (c, m) what a member costs that a centre
    does not see, 0 where it sees it. heights: (d, m) of the members along each direction.
    offsets: (d, k) planes along each direction, ascending. candidates: (c, 3) centres inside the solid and the part;
    candidate_heights: (d, c). Returns (d, k, 2) misfits, left (below) and right, inf where a side holds no centre,
    and (d, k, 2) which centre.

    Members are summed once for each centre and direction, in the slabs between the planes; a side is a sum of slabs.
    """
    directions, planes = offsets.shape
    misfit = np.full((directions, planes, 2), np.inf)
    which = np.full((directions, planes, 2), -1, np.int64)
    terms = np.empty((order.shape[0], SUMS))
    cells = np.empty(order.shape[0], np.int64)
    slabs, hidden = np.empty((planes + 1, CELLS, SUMS)), np.empty(planes + 1)
    side = np.empty((CELLS, SUMS))
    for c in range(candidates.shape[0]):
        _fill_terms(points, normals, order, gaps[c], candidates[c], terms, cells)
        for d in range(directions):
            _fill_slabs(terms, cells, gaps[c], heights[d], offsets[d], slabs, hidden)
            for s in range(2):
                side[:] = 0.0
                lost = 0.0
                for step in range(planes):
                    k = step if s == 0 else planes - 1 - step
                    slab = k + s
                    lost += hidden[slab]
                    for cell in range(CELLS):
                        for t in range(SUMS):
                            side[cell, t] += slabs[slab, cell, t]
                    if (candidate_heights[d, c] - offsets[d, k]) * (2 * s - 1) <= 0.0:
                        continue
                    value = lost + misfit_of_cells(side, power)
                    if value < misfit[d, k, s]:
                        misfit[d, k, s] = value
                        which[d, k, s] = c
    return misfit, which


@njit(cache=True, nogil=True)
def _fill_terms(points, normals, order, gaps, centre, terms, cells):
    """Fill in what each member that a centre sees adds to which cell."""
    for at in range(order.shape[0]):
        if gaps[at] > 0.0:
            continue
        i = order[at]
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        cells[at] = term_of(x, y, z, normals, i, terms[at])


@njit(cache=True, nogil=True)
def _fill_slabs(terms, cells, gaps, heights, offsets, slabs, hidden):
    """Sum the members in the slabs below, between and above planes, cell by cell, and what is hidden there."""
    slabs[:] = 0.0
    hidden[:] = 0.0
    for at in range(heights.shape[0]):
        slab = np.searchsorted(offsets, heights[at], "right")
        if gaps[at] > 0.0:
            hidden[slab] += gaps[at]
        else:
            sums = slabs[slab, cells[at]]
            for t in range(SUMS):
                sums[t] += terms[at, t]


@njit(cache=True, nogil=True)
def misfits(points, normals, order, gaps, candidates, power):
    """Return (c,) the misfit of one part, whole, seen from each candidate centre."""
    out = np.empty(candidates.shape[0])
    sums, term = np.empty((CELLS, SUMS)), np.empty(SUMS)
    for c in range(candidates.shape[0]):
        sums[:] = 0.0
        hidden = 0.0
        for at in range(order.shape[0]):
            if gaps[c, at] > 0.0:
                hidden += gaps[c, at]
                continue
            i = order[at]
            x, y, z = points[i, 0] - candidates[c, 0], points[i, 1] - candidates[c, 1], points[i, 2] - candidates[c, 2]
            cell = term_of(x, y, z, normals, i, term)
            for t in range(SUMS):
                sums[cell, t] += term[t]
        out[c] = hidden + misfit_of_cells(sums, power)
    return out
