"""From a point near the surface to the foot of a point, on one smooth leaf after another: Newton's steps on exact jets.

Nothing is proven by it: where it ends the surface point is an upper bound.
"""

import math

import numpy as np

from hhsr.kernels.cell import direction_of, face_of, inverse_radius
from hhsr.kernels.jet import inverse_radius_bend
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
from hhsr.kernels.maps import jet_near, outside_region, plane_of
from hhsr.kernels.patch import BEST, FOOT, SPOT, START, TOLERANCE, distance_to, offer, set_spot
from hhsr.kernels.seam import slide
from hhsr.kernels.tree import into_leaf, owner_of, turn_out_of_leaf
from hhsr.kernels.unmanaged import unmanaged

STEPS = 10
LONGEST = 0.25  # step, of a face's coordinates
ROUGH = 4  # of them by the table, at most
LEFT = 0.02  # tolerances: a point that the next step would bring no nearer is a foot
SLACK = 0.1  # tolerances: a foot by the table is one where it is proven to lie this near to the surface; where it lies
# nearer than the tolerance, the surface point on its ray is


@unmanaged
def descend(blob, ints, tab, owner, face, a, b, slides, search):
    """Offer the surface points on a way of steepest nearing from (a, b) of an owner; return whether it came to a foot.

    search: of a point, tree's frame. slides: where the way goes to and fro over a seam, go on along that. The first
    steps are the table's. A foot of theirs is offered as far as the surface may be: `onto_surface` makes it exact.
    """
    last = np.inf
    rough, left = ROUGH, np.int64(-1)
    nearest, from_a, from_b, from_face, from_owner = np.inf, a, b, face, owner
    for _ in range(STEPS):
        o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
        leaf = ints[o + OWNER_RECORD]
        if ints[o + OWNER_KIND] != MODEL:
            return False
        planes, count = ints[o + OWNER_PLANE_FLOATS], ints[o + OWNER_PLANES]
        frame = ints[leaf + FRAME]
        px, py, pz = into_leaf(blob, ints, leaf, search[START], search[START + 1], search[START + 2])
        rough -= 1
        w = error = 0.0
        if rough >= 0:
            w, wa, wb, waa, wab, wbb, error = jet_near(tab, ints, leaf, face, a, b)
        if not w > 0.0:
            rough = -1
            w, wa, wb, waa, wab, wbb = inverse_radius_bend(blob, ints, leaf, face, a, b)
            if w == 0.0:
                return False
        m = 1.0 / w
        x, y, z = direction_of(face, a, b)
        x, y, z = x * m, y * m, z * m
        rx, ry, rz = px - x, py - y, pz - z
        distance = math.sqrt(rx * rx + ry * ry + rz * rz)
        if face != from_face or owner != from_owner or distance <= nearest + LEFT * search[TOLERANCE]:
            nearest, from_a, from_b, from_face, from_owner = distance, a, b, face, owner
        else:  # a step too far: half of it
            a, b = 0.5 * (a + from_a), 0.5 * (b + from_b)
            continue
        within = rough < 0 and not outside_region(blob, planes, count, x, y, z, 1e-9)
        if within and distance < search[BEST]:
            ox, oy, oz = turn_out_of_leaf(blob, frame, x, y, z)
            offer(search, distance, 0.0, ox + blob[frame], oy + blob[frame + 1], oz + blob[frame + 2])
        gx, gy, gz = plane_of(face, a, b, w, wa, wb)
        gg = gx * gx + gy * gy + gz * gz
        h = (gx * rx + gy * ry + gz * rz) / gg
        if distance - abs(h) * math.sqrt(gg) < LEFT * search[TOLERANCE]:
            if within:
                return True
            if rough >= 0:
                # Along the ray the surface is no farther off than this; W is hundreds of times its error.
                slack = 1.01 * error * m * math.sqrt(x * x + y * y + z * z)
                if slack < search[TOLERANCE] and error < 1e-3 * w:
                    sx, sy, sz = x, y, z
                    if slack > SLACK * search[TOLERANCE]:
                        exact, slack = inverse_radius(blob, ints, leaf, face, a, b), 0.0
                        sx, sy, sz = x * w / exact, y * w / exact, z * w / exact
                        distance = math.sqrt((px - sx) ** 2 + (py - sy) ** 2 + (pz - sz) ** 2)
                    if not outside_region(blob, planes, count, sx, sy, sz, -slack):
                        if distance + slack < search[BEST]:
                            sx, sy, sz = turn_out_of_leaf(blob, frame, sx, sy, sz)
                            sx, sy, sz = sx + blob[frame], sy + blob[frame + 1], sz + blob[frame + 2]
                            offer(search, distance + slack, 0.0, sx, sy, sz)
                            if slack > 0.0:
                                set_spot(search, owner, face, a, b)
                        return True
                rough = 0
        # Newton: with B the second derivatives of m·W in space, (1 + h B) δ = what of q − x lies in the tangent plane,
        # for δ in it. In the chart δ = x_a δa + x_b δb, and x_i·B x_j = m W_ij.
        ax, ay, az = direction_of(face, 0.0, 0.0)
        ux, uy, uz = direction_of(face, 1.0, 0.0)
        vx, vy, vz = direction_of(face, 0.0, 1.0)
        ux, uy, uz = (ux - ax) * m - x * wa * m, (uy - ay) * m - y * wa * m, (uz - az) * m - z * wa * m
        vx, vy, vz = (vx - ax) * m - x * wb * m, (vy - ay) * m - y * wb * m, (vz - az) * m - z * wb * m
        k = h * m
        aa = ux * ux + uy * uy + uz * uz + k * waa
        ab = ux * vx + uy * vy + uz * vz + k * wab
        bb = vx * vx + vy * vy + vz * vz + k * wbb
        ra, rb = ux * rx + uy * ry + uz * rz, vx * rx + vy * ry + vz * rz
        det = aa * bb - ab * ab
        if not (det > 0.0 and aa > 0.0):  # beyond the centre of curvature: along the slope, as on a plane
            aa, ab = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz
            bb = vx * vx + vy * vy + vz * vz
            det = aa * bb - ab * ab
        da, db = (bb * ra - ab * rb) / det, (aa * rb - ab * ra) / det
        move = max(abs(da), abs(db))
        if move > LONGEST:
            da, db = da * (LONGEST / move), db * (LONGEST / move)
            move = LONGEST
        if within and move > 0.9 * last:
            return False
        if rough < 0:
            last = move
        a, b = a + da, b + db
        w += wa * da + wb * db
        if not w > 0.0:
            return False
        x, y, z = direction_of(face, a, b)
        x, y, z = x / w, y / w, z / w
        if outside_region(blob, planes, count, x, y, z, 0.0):
            ox, oy, oz = turn_out_of_leaf(blob, frame, x, y, z)
            ox, oy, oz = ox + blob[frame], oy + blob[frame + 1], oz + blob[frame + 2]
            new = owner_of(blob, ints, 0, ox, oy, oz)
            if new != owner:
                if new == left:
                    # To and fro: each leaf's foot lies beyond the cut. The nearest point is one of the seam.
                    if not slides:
                        return False
                    cut = _worst_plane(blob, planes, count, x, y, z)
                    face, a, b, _ = face_of(x, y, z)
                    slide(blob, ints, owner, cut, face, a, b, search)
                    return False
                left, owner = owner, new
                leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * owner + OWNER_RECORD]
                x, y, z = into_leaf(blob, ints, leaf, ox, oy, oz)
                face, a, b, _ = face_of(x, y, z)
                last = np.inf
        elif max(abs(a), abs(b)) > 1.0:
            face, a, b, _ = face_of(x, y, z)
    return False


@unmanaged
def _worst_plane(blob, planes, count, x, y, z):
    """Return the float slot of the plane of a region that a point is farthest beyond."""
    worst, at = -np.inf, planes
    for k in range(planes, planes + 4 * count, 4):
        excess = blob[k] * x + blob[k + 1] * y + blob[k + 2] * z - blob[k + 3]
        if excess > worst:
            worst, at = excess, k
    return at


@unmanaged
def onto_surface(blob, ints, search):
    """Put the best point of a search about a point on the surface, along its ray, where it is the table's."""
    owner = int(search[SPOT])
    if owner < 0:
        return
    leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * owner + OWNER_RECORD]
    face, a, b = int(search[SPOT + 1]), search[SPOT + 2], search[SPOT + 3]
    w = inverse_radius(blob, ints, leaf, face, a, b)
    x, y, z = direction_of(face, a, b)
    frame = ints[leaf + FRAME]
    x, y, z = turn_out_of_leaf(blob, frame, x / w, y / w, z / w)
    x, y, z = x + blob[frame], y + blob[frame + 1], z + blob[frame + 2]
    distance, _ = distance_to(search, x, y, z)
    search[BEST] = min(search[BEST], distance)
    search[FOOT], search[FOOT + 1], search[FOOT + 2], search[SPOT] = x, y, z, -1.0


@unmanaged
def descend_from(blob, ints, tab, x, y, z, slides, search):
    """Do as `descend` from a surface point of the tree's frame."""
    owner = owner_of(blob, ints, 0, x, y, z)
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    if ints[o + OWNER_KIND] == MODEL:
        x, y, z = into_leaf(blob, ints, ints[o + OWNER_RECORD], x, y, z)
        face, a, b, _ = face_of(x, y, z)
        descend(blob, ints, tab, owner, face, a, b, slides, search)
