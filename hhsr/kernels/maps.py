"""The certified cube map of a leaf: linear models of its cells, and a pyramid of ranges and of enclosing spheres.

Tables are float32, rounded outward. The finest level has `cells`² cells a face; the pyramid holds the levels
cells/2, …, 2, 1 one after another, finest first, each as (face, i, j).
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.cell import cell_model, direction_of
from hhsr.kernels.layout import (
    BLOCKS_PER_SIDE,
    ERROR,
    RADIUS,
    SLOPE_A,
    SLOPE_B,
    SPREAD_A,
    SPREAD_B,
    VALUE,
    integers,
)

UP = 1.0 + 3e-7  # more than one float32 rounding


@njit(cache=True, error_model="numpy")
def level_start(cells, side):
    """Return the index of the first pyramid node of the level with `side` cells a face side."""
    start = 0
    k = cells // 2
    while k > side:
        start += 6 * k * k
        k //= 2
    return start


@njit(cache=True, error_model="numpy")
def pyramid_size(cells):
    """Return how many nodes the pyramid above `cells`² cells a face has."""
    return level_start(cells, 1) + 6


@njit(cache=True, error_model="numpy")
def quad_radius_ok(value, slope_a, slope_b, error, half_a, half_b):
    """Return whether the tangent plane of a cell faces the centre safely, so that its corners are points in space."""
    return value - abs(slope_a) * half_a - abs(slope_b) * half_b - error > 0.25 * value


@njit(cache=True, error_model="numpy")
def model_thickness(face, a, b, half_a, half_b, value, slope_a, slope_b, error):
    """Return how far (mm) surface and tangent plane of a cell can lie apart along a ray: |dir|·e / (T·(T − e))."""
    reach_a, reach_b = abs(a) + half_a, abs(b) + half_b
    low = value - abs(slope_a) * half_a - abs(slope_b) * half_b
    return math.sqrt(1.0 + reach_a * reach_a + reach_b * reach_b) * error / (low * (low - error)) * (1.0 + 1e-9)


@njit(cache=True, error_model="numpy")
def cell_sphere(face, a, b, half_a, half_b, value, slope_a, slope_b, error, lo, hi):
    """Return (x, y, z, radius) of a sphere about dir(a, b)/value, leaf frame, that encloses the surface of a cell."""
    if quad_radius_ok(value, slope_a, slope_b, error, half_a, half_b):
        grow = model_thickness(face, a, b, half_a, half_b, value, slope_a, slope_b, error)
        flat = True
    else:
        grow, flat = 0.0, False
    cx, cy, cz = direction_of(face, a, b)
    cx, cy, cz = cx / value, cy / value, cz / value
    radius = 0.0
    for corner in range(4):
        da = half_a if corner & 1 else -half_a
        db = half_b if corner & 2 else -half_b
        x, y, z = direction_of(face, a + da, b + db)
        for end in range(1 if flat else 2):
            w = value + slope_a * da + slope_b * db if flat else (lo if end == 0 else hi)
            d = (x / w - cx) ** 2 + (y / w - cy) ** 2 + (z / w - cz) ** 2
            radius = max(radius, math.sqrt(d))
    return cx, cy, cz, (radius + grow) * (1.0 + 1e-9)


@njit(cache=True, nogil=True, error_model="numpy")
def build_map(blob, leaf, cells, models, ranges, spheres, box):
    """Fill the tables of one leaf and its box: (8,) lowest 3, highest 3, least and greatest |p|∞ of its surface.

    models: (6, cells, cells, CELL_SIZE) float32. ranges: (nodes, 2) float32. spheres: (nodes, 4) float32.
    """
    ints = integers(blob)
    half = 1.0 / cells
    fine = np.empty((cells, cells, 4))
    span = np.empty((cells, cells, 2))
    box[:3], box[3:6], box[6], box[7] = 0.0, 0.0, 1e300, 0.0
    for face in range(6):
        for i in range(cells):
            for j in range(cells):
                a, b = (2 * i + 1) * half - 1.0, (2 * j + 1) * half - 1.0
                value, ga, gb, error, da, db, lo, hi = cell_model(blob, ints, leaf, face, a, b, half, half)
                out = models[face, i, j]
                out[VALUE], out[SLOPE_A], out[SLOPE_B] = value, ga, gb
                out[SPREAD_A], out[SPREAD_B] = (da + 1e-7 * abs(ga)) * UP, (db + 1e-7 * abs(gb)) * UP
                out[ERROR] = (error + 1e-7 * (value + (abs(ga) + abs(gb)) * half)) * UP
                span[i, j, 0], span[i, j, 1] = lo, hi
                cx, cy, cz, radius = cell_sphere(face, a, b, half, half, value, ga, gb, error, lo, hi)
                out[RADIUS] = (radius + 1e-7 * (abs(cx) + abs(cy) + abs(cz))) * UP
                fine[i, j, 0], fine[i, j, 1], fine[i, j, 2], fine[i, j, 3] = cx, cy, cz, radius
                box[6], box[7] = min(box[6], 1.0 / hi), max(box[7], 1.0 / lo)
                for corner in range(4):
                    x, y, z = direction_of(
                        face, a + (half if corner & 1 else -half), b + (half if corner & 2 else -half)
                    )
                    box[0], box[3] = min(box[0], x / lo), max(box[3], x / lo)
                    box[1], box[4] = min(box[1], y / lo), max(box[4], y / lo)
                    box[2], box[5] = min(box[2], z / lo), max(box[5], z / lo)
        side = cells // 2
        while side >= 1:
            step = cells // side
            start = level_start(cells, side) + face * side * side
            for i in range(side):
                for j in range(side):
                    lo, hi = 1e300, 0.0
                    cx = cy = cz = 0.0
                    for k in range(i * step, (i + 1) * step):
                        for m in range(j * step, (j + 1) * step):
                            lo, hi = min(lo, span[k, m, 0]), max(hi, span[k, m, 1])
                            cx, cy, cz = cx + fine[k, m, 0], cy + fine[k, m, 1], cz + fine[k, m, 2]
                    count = step * step
                    cx, cy, cz = np.float32(cx / count), np.float32(cy / count), np.float32(cz / count)
                    radius = 0.0
                    for k in range(i * step, (i + 1) * step):
                        for m in range(j * step, (j + 1) * step):
                            d = (fine[k, m, 0] - cx) ** 2 + (fine[k, m, 1] - cy) ** 2 + (fine[k, m, 2] - cz) ** 2
                            radius = max(radius, math.sqrt(d) + fine[k, m, 3])
                    node = start + i * side + j
                    ranges[node, 0], ranges[node, 1] = lo * (1.0 - 3e-7), hi * UP
                    spheres[node, 0], spheres[node, 1], spheres[node, 2] = cx, cy, cz
                    spheres[node, 3] = radius * UP
            side //= 2


def blocks_of(centres, inverse_extents):
    """Return (offsets (385,), index) of the centres that are not 0 everywhere in each block of directions."""
    step = 2.0 / BLOCKS_PER_SIDE
    edges = -1.0 + step * np.arange(BLOCKS_PER_SIDE + 1)
    grid = np.array([[[direction_of(f, a, b) for b in edges] for a in edges] for f in range(6)])
    grid /= np.linalg.norm(grid, axis=-1, keepdims=True)
    middle = grid[:, :-1, :-1] + grid[:, 1:, :-1] + grid[:, :-1, 1:] + grid[:, 1:, 1:]
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    nearest = np.min(
        [(grid[:, i : i + BLOCKS_PER_SIDE, j : j + BLOCKS_PER_SIDE] * middle).sum(-1) for i in (0, 1) for j in (0, 1)],
        axis=0,
    )
    reach = np.arccos(np.clip(nearest, -1.0, 1.0)).ravel() + 1e-6
    angle = np.arccos(np.clip(middle.reshape(-1, 3) @ centres.T, -1.0, 1.0))
    support = np.arccos(np.clip(1.0 - 1.0 / inverse_extents, -1.0, 1.0)) + 1e-6
    near = angle <= reach[:, None] + support
    offsets = np.concatenate([[0], np.cumsum(near.sum(axis=1))])
    return offsets.astype(np.int64), np.nonzero(near)[1].astype(np.int64)
