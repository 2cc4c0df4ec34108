"""A retained part inside the blob: closed triangles under a hierarchy, asked by the rules of a leaf (DESIGN §2)."""

import math

import numpy as np

from hhsr.kernels.triangle_build import STACK
from hhsr.kernels.triangles import inside_parity, nearest_triangle
from hhsr.kernels.unmanaged import managed

# Record, integers: float slots of the boxes (k, 6), integer slots of the links (k, 2), float slots of the corners
# (n, 3, 3), their numbers, and the float slot of the longest side of the part's box.
BOXES, NODES, LINKS, CORNERS, TRIANGLES, EXTENT = 0, 1, 2, 3, 4, 5
PART_INT_SIZE = 6


@managed
def part_arrays(blob, ints, part):
    """Return the views (boxes, links, corners) that the triangle kernels take."""
    k, n = ints[part + NODES], ints[part + TRIANGLES]
    o, i, c = ints[part + BOXES], ints[part + LINKS], ints[part + CORNERS]
    return (
        blob[o : o + 6 * k].reshape(k, 6),
        ints[i : i + 2 * k].reshape(k, 2),
        blob[c : c + 9 * n].reshape(n, 3, 3),
    )


@managed
def part_contains(blob, ints, part, x, y, z):
    """Return whether the closed triangles hold the point."""
    if ints[part + TRIANGLES] == 0:
        return False
    o = ints[part + BOXES]
    if x < blob[o] or y < blob[o + 1] or z < blob[o + 2] or x > blob[o + 3] or y > blob[o + 4] or z > blob[o + 5]:
        return False
    boxes, links, corners = part_arrays(blob, ints, part)
    point = np.empty(3)
    point[0], point[1], point[2] = x, y, z
    return inside_parity(boxes, links, corners, point, np.empty(STACK, dtype=np.int64))


@managed
def part_field(blob, ints, part, x, y, z):
    """Return the signed distance to the part's triangles over the part's extent; 1 for an empty part."""
    if ints[part + TRIANGLES] == 0:
        return 1.0
    boxes, links, corners = part_arrays(blob, ints, part)
    stack, keys = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    _, d2, _, _ = nearest_triangle(boxes, links, corners, x, y, z, np.inf, -1, stack, keys)
    distance = math.sqrt(d2) / blob[ints[part + EXTENT]]
    return -distance if part_contains(blob, ints, part, x, y, z) else distance
