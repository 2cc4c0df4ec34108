"""A cell's surface against a point or a segment: bounded by its flat quad.

A search is a float array: its slots hold the segment and the best point so far.
"""

import math

import numpy as np

from hhsr.kernels.cell import chart_of, direction_of, inverse_radius
from hhsr.kernels.layout import BOX, FRAME
from hhsr.kernels.maps import (
    cell_corners,
    cell_sphere,
    model_thickness,
    outside_region,
    plane_of,
    quad_radius,
    quad_radius_ok,
    ray_thickness,
)
from hhsr.kernels.polygon import clip_polygon, polygon_to_segment
from hhsr.kernels.tree import into_leaf, turn_into_leaf
from hhsr.kernels.unmanaged import inlined, unmanaged

# Slots of a search: start 3, vector 3, squared length; best distance, t, point 3 (owner's frame); tolerance; and where
# the best point is the table's, its spot: owner (−1: it is exact), face, a, b; the exact one along that ray is no
# farther than the best distance. Where the start is proven to lie: 1 outside, −1 inside, 0 not known. Last, a distance
# below which any surface point will do: a search that has found one ends, and proves nothing.
START, VECTOR, LENGTH2, BEST, BEST_T, FOOT, TOLERANCE, SPOT, SIDE, ENOUGH = 0, 3, 6, 7, 8, 9, 12, 13, 17, 18
SEARCH_SIZE = 19
LATE = 256  # room for pending nodes
NODE_ROOM = 256  # room for facets to be settled, and for parts of one
FAR = 1e150  # mm: no surface point found yet; finite, so that "no surface here" (infinite) is beyond it
FINEST = 1e-5  # mm: a piece of surface smaller than this is taken as a point


@unmanaged
def distance_to(search, x, y, z):
    """Return (distance, t) of a point to the search's segment."""
    dx, dy, dz = search[VECTOR], search[VECTOR + 1], search[VECTOR + 2]
    rx, ry, rz = x - search[START], y - search[START + 1], z - search[START + 2]
    t = 0.0
    if search[LENGTH2] > 0.0:
        t = min(max((rx * dx + ry * dy + rz * dz) / search[LENGTH2], 0.0), 1.0)
        rx, ry, rz = rx - t * dx, ry - t * dy, rz - t * dz
    return math.sqrt(rx * rx + ry * ry + rz * rz), t


@inlined
def into_own_frame(blob, ints, leaf, search, local):
    """Write the search's segment into `local`, in a leaf's frame."""
    local[START], local[START + 1], local[START + 2] = into_leaf(
        blob, ints, leaf, search[START], search[START + 1], search[START + 2]
    )
    local[LENGTH2] = search[LENGTH2]
    if search[LENGTH2] > 0.0:
        local[VECTOR], local[VECTOR + 1], local[VECTOR + 2] = turn_into_leaf(
            blob, ints[leaf + FRAME], search[VECTOR], search[VECTOR + 1], search[VECTOR + 2]
        )


@unmanaged
def offer(search, distance, t, x, y, z):
    """Take a surface point as the best one if it is nearer."""
    if distance < search[BEST]:
        search[BEST], search[BEST_T], search[SPOT] = distance, t, -1.0
        search[FOOT], search[FOOT + 1], search[FOOT + 2] = x, y, z


@unmanaged
def set_spot(search, owner, face, a, b):
    """Note that a search's best point is the table's, of an owner at (a, b) on a face."""
    search[SPOT], search[SPOT + 1], search[SPOT + 2], search[SPOT + 3] = owner, face, a, b


@unmanaged
def offer_patch_point(blob, ints, leaf, planes, count, search, face, x, y, z, shrink):
    """Project a point near a patch along its ray to the exact surface and offer it, if it lies in the region.

    shrink: mm; where the projection leaves the region by a plane, the point is moved back by its excess and this much.
    """
    for _ in range(3):
        a, b, m = chart_of(face, x, y, z)
        if not (m > 0.0 and abs(a) <= 1.0 + 1e-9 and abs(b) <= 1.0 + 1e-9):
            return
        w = inverse_radius(blob, ints, leaf, face, a, b)
        ux, uy, uz = direction_of(face, a, b)
        sx, sy, sz = ux / w, uy / w, uz / w
        worst, at = 1e-9, -1
        for k in range(count):
            o = planes + 4 * k
            h = blob[o] * sx + blob[o + 1] * sy + blob[o + 2] * sz - blob[o + 3]
            if h > worst:
                worst, at = h, o
        if at < 0:
            distance, t = distance_to(search, sx, sy, sz)
            offer(search, distance, t, sx, sy, sz)
            return
        back = worst + shrink
        x, y, z = sx - back * blob[at], sy - back * blob[at + 1], sz - back * blob[at + 2]


@unmanaged
def quick_bound(search, face, a, b, half, value, ga, gb, error):
    """Return a lower bound of a point's distance to a cell's surface: by its plane, and within it by its middle.

    0 where the cell is too steep for its plane.
    """
    if not quad_radius_ok(value, ga, gb, error, half, half):
        return 0.0
    gx, gy, gz = plane_of(face, a, b, value, ga, gb)
    along = abs(gx * search[START] + gy * search[START + 1] + gz * search[START + 2] - 1.0) / math.sqrt(
        gx * gx + gy * gy + gz * gz
    )
    low = max(along - model_thickness(face, a, b, half, half, value, ga, gb, error), 0.0)
    if low > search[BEST] - search[TOLERANCE]:
        return low
    # No point of the quad is farther from its middle than its radius, nor the surface from the quad by more than that.
    x, y, z = direction_of(face, a, b)
    rx, ry, rz = search[START] - x / value, search[START + 1] - y / value, search[START + 2] - z / value
    aside = math.sqrt(max(rx * rx + ry * ry + rz * rz - along * along, 0.0))
    aside -= quad_radius(face, a, b, half, value, ga, gb) + ray_thickness(face, a, b, half, half, value, ga, gb, error)
    return math.sqrt(low * low + aside * aside) if aside > 0.0 else low


@unmanaged
def cell_bound(blob, ints, leaf, planes, count, search, face, a, b, half, value, ga, gb, error, corners, spare):
    """Return a lower bound of the segment's distance to the cell's surface in the region; offer a point of it.

    Infinite where no surface of the cell lies in the region. A cell too steep for its plane is bounded by a sphere.
    """
    if not quad_radius_ok(value, ga, gb, error, half, half):
        reach = abs(ga) * half + abs(gb) * half + error
        lo = max(value - reach, 1.0 / blob[ints[leaf + BOX] + 7])
        x, y, z, radius = cell_sphere(face, a, b, half, half, value, ga, gb, error, lo, value + reach)
        if outside_region(blob, planes, count, x, y, z, radius):
            return np.inf
        distance, _ = distance_to(search, x, y, z)
        x, y, z = direction_of(face, a, b)
        offer_patch_point(blob, ints, leaf, planes, count, search, face, x, y, z, radius)
        return distance - radius
    thick = model_thickness(face, a, b, half, half, value, ga, gb, error)
    gx, gy, gz = plane_of(face, a, b, value, ga, gb)
    along = 0.0
    if search[LENGTH2] == 0.0:
        low = quick_bound(search, face, a, b, half, value, ga, gb, error)
        if low > search[BEST] - search[TOLERANCE]:
            return low
        along = abs(gx * search[START] + gy * search[START + 1] + gz * search[START + 2] - 1.0) / math.sqrt(
            gx * gx + gy * gy + gz * gz
        )
    slant = ray_thickness(face, a, b, half, half, value, ga, gb, error)
    cell_corners(face, a, b, half, value, ga, gb, corners)
    size = np.int64(4)
    for k in range(count):
        o = planes + 4 * k
        size = clip_polygon(corners, size, spare, blob[o], blob[o + 1], blob[o + 2], blob[o + 3] + slant)
        if size == 0:
            return np.inf
    distance, _, x, y, z = polygon_to_segment(
        corners, size, gx, gy, gz, search[START], search[START + 1], search[START + 2], search[VECTOR],
        search[VECTOR + 1], search[VECTOR + 2],
    )  # fmt: skip
    if search[LENGTH2] == 0.0:
        # Across the plane the surface strays by `thick`, within it by no more than `slant`.
        aside = math.sqrt(max(distance * distance - along * along, 0.0)) - slant
        low = max(along - thick, 0.0)
        if aside > 0.0:
            low = math.sqrt(low * low + aside * aside)
    else:
        low = distance - slant
    if low < search[BEST] - search[TOLERANCE]:
        offer_patch_point(blob, ints, leaf, planes, count, search, face, x, y, z, 2.0 * slant)
    return low
