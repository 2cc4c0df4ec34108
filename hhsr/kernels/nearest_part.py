"""The nearest point of a retained part's surface, within its region, to a segment or a point."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.part import TRIANGLES, part_arrays
from hhsr.kernels.patch import BEST, LENGTH2, START, TOLERANCE, VECTOR, offer
from hhsr.kernels.polygon import clip_polygon, polygon_to_segment, segment_to_segment


@njit(cache=True, error_model="numpy")
def box_bound(box, search):
    """Return a lower bound of the segment's distance to a box (6,): exact for a point, by spheres else."""
    if search[LENGTH2] == 0.0:
        d2 = 0.0
        for k in range(3):
            d = max(box[k] - search[START + k], 0.0, search[START + k] - box[3 + k])
            d2 += d * d
        return math.sqrt(d2)
    # By slabs of the segment's own box, and by the sphere about the box.
    d2 = r2 = rr = rd = 0.0
    for k in range(3):
        p, d = search[START + k], search[VECTOR + k]
        gap = max(box[k] - max(p, p + d), 0.0, min(p, p + d) - box[3 + k])
        d2 += gap * gap
        half = 0.5 * (box[3 + k] - box[k])
        r2 += half * half
        c = 0.5 * (box[3 + k] + box[k]) - p
        rr += c * c
        rd += c * d
    t = min(max(rd / search[LENGTH2], 0.0), 1.0)
    sphere = math.sqrt(max(rr - 2.0 * t * rd + t * t * search[LENGTH2], 0.0)) - math.sqrt(r2)
    return max(math.sqrt(d2), sphere)


@njit(cache=True, error_model="numpy")
def triangle_bound(corner, blob, planes, count, search, corners, spare):
    """Offer the nearest point of one triangle within the region."""
    for i in range(3):
        for k in range(3):
            corners[i, k] = corner[i, k]
    size = np.int64(3)
    for k in range(count):
        o = planes + 4 * k
        size = clip_polygon(corners, size, spare, blob[o], blob[o + 1], blob[o + 2], blob[o + 3])
        if size == 0:
            return
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    # About the first corner, moved so that the plane is n·x = 1.
    nn = nx * nx + ny * ny + nz * nz
    if nn > 0.0:
        length = math.sqrt(nn)
        nx, ny, nz = nx / length, ny / length, nz / length
        ox, oy, oz = corner[0, 0] - nx, corner[0, 1] - ny, corner[0, 2] - nz
        for i in range(size):
            corners[i, 0] -= ox
            corners[i, 1] -= oy
            corners[i, 2] -= oz
        distance, t, x, y, z = polygon_to_segment(
            corners,
            size,
            nx,
            ny,
            nz,
            search[START] - ox,
            search[START + 1] - oy,
            search[START + 2] - oz,
            search[VECTOR],
            search[VECTOR + 1],
            search[VECTOR + 2],
        )
        offer(search, distance, t, x + ox, y + oy, z + oz)
        return
    for i in range(size):  # a triangle without area: its edges
        j = (i + 1) % size
        ux, uy, uz = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1], corners[j, 2] - corners[i, 2]
        d2, t, s = segment_to_segment(
            search[START],
            search[START + 1],
            search[START + 2],
            search[VECTOR],
            search[VECTOR + 1],
            search[VECTOR + 2],
            corners[i, 0],
            corners[i, 1],
            corners[i, 2],
            ux,
            uy,
            uz,
        )
        offer(search, math.sqrt(d2), t, corners[i, 0] + s * ux, corners[i, 1] + s * uy, corners[i, 2] + s * uz)


@njit(cache=True, error_model="numpy")
def nearest_on_part(blob, ints, part, planes, count, search, nodes, keys, corners, spare):
    """Improve the search by the triangles of a retained part, each clipped to the region."""
    if ints[part + TRIANGLES] == 0:
        return
    boxes, links, triangles = part_arrays(blob, ints, part)
    nodes[0], keys[0] = 0, box_bound(boxes[0], search)
    depth = 1
    while depth > 0:
        depth -= 1
        if keys[depth] > search[BEST] - search[TOLERANCE]:
            continue
        node = nodes[depth]
        first, number = links[node, 0], links[node, 1]
        if number > 0:
            for i in range(first, first + number):
                triangle_bound(triangles[i], blob, planes, count, search, corners, spare)
            continue
        near, far = box_bound(boxes[first], search), box_bound(boxes[first + 1], search)
        a, b = first, first + 1
        if far < near:
            near, far, a, b = far, near, b, a
        if far <= search[BEST] - search[TOLERANCE]:
            nodes[depth], keys[depth] = b, far
            depth += 1
        if near <= search[BEST] - search[TOLERANCE]:
            nodes[depth], keys[depth] = a, near
            depth += 1
