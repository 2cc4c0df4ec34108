"""From a point on a seam to a nearer one along it. A seam is where a leaf's surface ends at a cut.

Nothing is proven by it: where it ends the surface point is an upper bound.
"""

import math

from hhsr.kernels.cell import direction_of, face_of
from hhsr.kernels.jet import inverse_radius_jet
from hhsr.kernels.layout import (
    FRAME,
    MODEL,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_PLANE_FLOATS,
    OWNER_PLANES,
    OWNER_RECORD,
)
from hhsr.kernels.maps import outside_region, plane_of
from hhsr.kernels.patch import BEST, FAR, START, TOLERANCE, offer
from hhsr.kernels.tree import into_leaf, owner_of, turn_out_of_leaf
from hhsr.kernels.unmanaged import unmanaged

NEAR = 0.01  # mm: a surface point this near to a cut is on its seam
STEPS = 8
ASIDE = 0.02  # tolerances: how far before the cut a point of the seam is sought
LEFT = 0.02  # tolerances: a step that would bring no more is not taken
# A step that leaves more than this of the way goes astray: of those slides nine in ten found nothing. Where no surface
# point is known yet it may: from off the seam the first steps only find back to it.
SHRINKS = 0.7
LEAST_BEND, MOST_BEND = 0.1, 10.0  # of the way that is left on a seam, to its straight one


@unmanaged
def slide(blob, ints, owner, cut, face, a, b, search):
    """Offer the points of a seam that are nearer and nearer to a search's point, from (a, b) of an owner near it on.

    cut: the float slot of the owner's plane that the seam lies on.
    """
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    leaf, planes, count = ints[o + OWNER_RECORD], ints[o + OWNER_PLANE_FLOATS], ints[o + OWNER_PLANES]
    frame = ints[leaf + FRAME]
    px, py, pz = into_leaf(blob, ints, leaf, search[START], search[START + 1], search[START + 2])
    nx, ny, nz, place = blob[cut], blob[cut + 1], blob[cut + 2], blob[cut + 3]
    last, step, bend = 0.0, 0.0, 1.0
    aside = ASIDE * search[TOLERANCE]
    for _ in range(STEPS):
        w, wa, wb = inverse_radius_jet(blob, ints, leaf, face, a, b)
        if w == 0.0:
            return
        x, y, z = direction_of(face, a, b)
        x, y, z = x / w, y / w, z / w
        rx, ry, rz = px - x, py - y, pz - z
        excess = nx * x + ny * y + nz * z - place
        gx, gy, gz = plane_of(face, a, b, w, wa, wb)
        gg = gx * gx + gy * gy + gz * gz
        ux, uy, uz = gy * nz - gz * ny, gz * nx - gx * nz, gx * ny - gy * nx
        uu = ux * ux + uy * uy + uz * uz  # gg times the squared sine between the surface and the cut
        if not uu > 1e-6 * gg:
            return
        along = (rx * ux + ry * uy + rz * uz) / uu
        # The seam bends: what is left after a step says by how much it was too short or too long.
        astray = step != 0.0 and search[BEST] < FAR and abs(along) > SHRINKS * abs(last)
        if step != 0.0:
            bend = min(max((last - along) / step, LEAST_BEND), MOST_BEND)
        last, step = along, along / bend
        if excess > -4.0 * aside and not outside_region(blob, planes, count, x, y, z, 1e-9):
            distance = math.sqrt(rx * rx + ry * ry + rz * rz)
            ox, oy, oz = turn_out_of_leaf(blob, frame, x, y, z)
            offer(search, distance, 0.0, ox + blob[frame], oy + blob[frame + 1], oz + blob[frame + 2])
            if 0.5 * step * along * uu < LEFT * search[TOLERANCE] * distance:
                return
        if astray:
            return
        # Back to the cut within the tangent plane, across the seam.
        back = (excess + aside) / uu
        lean = nx * gx + ny * gy + nz * gz
        x += step * ux - back * (gg * nx - lean * gx)
        y += step * uy - back * (gg * ny - lean * gy)
        z += step * uz - back * (gg * nz - lean * gz)
        face, a, b, _ = face_of(x, y, z)


@unmanaged
def slide_from(blob, ints, x, y, z, search):
    """Do as `slide` from a surface point of the tree's frame; return whether it is on a seam."""
    owner = owner_of(blob, ints, 0, x, y, z)
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    leaf = ints[o + OWNER_RECORD]
    if ints[o + OWNER_KIND] != MODEL:
        return False
    planes = ints[o + OWNER_PLANE_FLOATS]
    x, y, z = into_leaf(blob, ints, leaf, x, y, z)
    least, cut = NEAR, -1
    for k in range(planes, planes + 4 * ints[o + OWNER_PLANES], 4):
        gap = abs(blob[k] * x + blob[k + 1] * y + blob[k + 2] * z - blob[k + 3])
        if gap < least:
            least, cut = gap, k
    if cut >= 0:
        face, a, b, _ = face_of(x, y, z)
        slide(blob, ints, owner, cut, face, a, b, search)
    return cut >= 0
