"""From a point on a seam to a nearer one along it. A seam is where a leaf's surface ends at a cut.

Nothing is proven by it: where it ends the surface point is an upper bound.
"""

from hhsr.kernels.cell import chart_of, direction_of, face_of, inverse_radius, minor_parts
from hhsr.kernels.jet import has_jets, inverse_radius_jet
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
from hhsr.kernels.maps import plane_of
from hhsr.kernels.patch import BEST, FOOT, START, TOLERANCE, into_own_frame, offer
from hhsr.kernels.settle import improves
from hhsr.kernels.tree import into_leaf, owner_of, turn_out_of_leaf
from hhsr.kernels.unmanaged import unmanaged

NEAR = 0.01  # mm: a surface point this near to a cut is on its seam
STEPS = 6


@unmanaged
def slide_from(blob, ints, tab, x, y, z, search, local):
    """Offer the points of a seam that are nearer and nearer to a search's point, from a surface point on.

    All in the tree's frame. Does nothing where the surface point is on no seam. local: (SEARCH_SIZE,) scratch.
    """
    owner = owner_of(blob, ints, 0, x, y, z)
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    leaf = ints[o + OWNER_RECORD]
    if ints[o + OWNER_KIND] != MODEL or not has_jets(ints, leaf):
        return
    planes, count = ints[o + OWNER_PLANE_FLOATS], ints[o + OWNER_PLANES]
    x, y, z = into_leaf(blob, ints, leaf, x, y, z)
    least, cut = NEAR, -1
    for k in range(planes, planes + 4 * count, 4):
        gap = abs(blob[k] * x + blob[k + 1] * y + blob[k + 2] * z - blob[k + 3])
        if gap < least:
            least, cut = gap, k
    if cut < 0:
        return
    into_own_frame(blob, ints, leaf, search, local)
    local[BEST], local[TOLERANCE] = search[BEST], search[TOLERANCE]
    nx, ny, nz, place = blob[cut], blob[cut + 1], blob[cut + 2], blob[cut + 3]
    face, a, b, _ = face_of(x, y, z)
    last = 0.0
    for _ in range(STEPS):
        w, wa, wb = inverse_radius_jet(blob, ints, leaf, face, a, b)
        if w == 0.0:
            break
        x, y, z = direction_of(face, a, b)
        x, y, z = x / w, y / w, z / w
        gx, gy, gz = plane_of(face, a, b, w, wa, wb)
        ux, uy, uz = gy * nz - gz * ny, gz * nx - gx * nz, gx * ny - gy * nx
        uu = ux * ux + uy * uy + uz * uz
        if uu == 0.0:
            break
        along = ((local[START] - x) * ux + (local[START + 1] - y) * uy + (local[START + 2] - z) * uz) / uu
        # The seam bends: what is left after a step says by how much it was too short or too long.
        left = along / last if last != 0.0 else 0.0
        last = along
        step = along / (1.0 - left) if abs(left) < 0.9 else along
        was = face
        face, a, b, _ = face_of(x + step * ux, y + step * uy, z + step * uz)
        if face != was:
            w, wa, wb = inverse_radius_jet(blob, ints, leaf, face, a, b)
        # Back on to the cut, for the leaf's surface turns away from it or beyond.
        na, nb = minor_parts(face, nx, ny, nz)
        na, nb = na - place * wa, nb - place * wb
        x, y, z = direction_of(face, a, b)
        excess = nx * x + ny * y + nz * z - place * inverse_radius(blob, ints, leaf, face, a, b)
        a, b = a - excess * na / (na * na + nb * nb), b - excess * nb / (na * na + nb * nb)
        if not max(abs(a), abs(b)) <= 1.0:
            break
        best = local[BEST]
        if not improves(blob, ints, leaf, planes, count, local, face, a, b, wa, wb):
            break
        if best - local[BEST] < 0.02 * search[TOLERANCE]:
            break
        a, b, _ = chart_of(face, local[FOOT], local[FOOT + 1], local[FOOT + 2])
    if local[BEST] < search[BEST]:
        frame = ints[leaf + FRAME]
        x, y, z = turn_out_of_leaf(blob, frame, local[FOOT], local[FOOT + 1], local[FOOT + 2])
        offer(search, local[BEST], 0.0, x + blob[frame], y + blob[frame + 1], z + blob[frame + 2])
