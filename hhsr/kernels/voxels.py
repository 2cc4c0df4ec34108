"""A grid of cubes about the solid, proven inside or outside, or given the surface's plane, or left to the formulas.

Voxels come in bricks of 4³. A brick that is proven whole has a leap for each octant of directions: the greatest cube of
bricks, from it on that way, in which nothing changes. The others have a plane (`hhsr.kernels.surfel`) that decides most
of the brick, and each of their voxels a number: that of its own surfel; or that it is proven, and for each octant of
directions a leap too: a cube of voxels, from it on that way, in which nothing changes. So what a walk asks of a brick,
and what it asks of a voxel, lies in one place each.
"""

import math

import numpy as np

from hhsr.kernels.box_state import IN, MIXED, OUT, box_state
from hhsr.kernels.layout import NODE_FLOAT_SIZE, NODE_FLOATS, VOXEL_FRAME, VOXELS, integers, tables
from hhsr.kernels.surfel import (
    DETAIL,
    DETAIL_SIZE,
    EXTRA,
    FINE,
    OFFSET,
    PLANE_SIZE,
    SURE,
    SURFEL_OWNER,
    SURFEL_SIZE,
    prove_voxel,
)
from hhsr.kernels.tree import contains_point
from hhsr.kernels.triangle_build import STACK
from hhsr.kernels.unmanaged import entry, inlined, unmanaged

BRICK = 4  # voxels a side
COARSE = 8  # bricks a side of the first cubes that are tried
NODES = 256
# The grid's record, integer slots: bricks along x, y, z; then where its tables begin: bricks (32-bit words), voxels (16
# bits each), planes of surfels (16 bits), their details (float32 slots).
BRICKS, VOXELS_AT, PLANES, DETAILS = 3, 4, 5, 6
VOXEL_INTS = 7
# A brick, 32-bit words: two of its own plane (four 16-bit numbers), or, where it is proven, of eight bytes, the leap of
# each octant, < 0 outside; where its voxels begin, counted from the table's begin on, −1 where it is proven; the number
# of its first surfel.
BRICK_SIZE, BRICK_VOXELS, BRICK_SURFEL = 4, 2, 3
# A voxel: 0 … 63 the number of its surfel in the brick; NO_SURFEL; or negative: proven, inside where IN_BIT is set. Its
# leap is then one of two, by the octant's bit: the number of STEP_BITS from bit SHORT_BITS on, or the next, + 1.
NO_SURFEL, PROVEN, IN_BIT = 64, -(2**15), 1 << 14
SHORT_BITS, STEP_BITS, FARTHEST_STEP = 8, 3, 7
LONGEST = 127  # bricks


@entry
def fill_bricks(blob, low, side, first, last, out):
    """Fill (nx, ny, nz) int8 of the bricks (cubes of `side`) of x in first … last: 1 inside, −1 outside, 0 neither."""
    ints, tab = integers(blob), tables(blob)
    nodes, stack = np.empty(NODES, dtype=np.int64), np.empty(STACK, dtype=np.int64)
    q, e = np.empty(3), np.empty(3)
    todo = np.empty((64, 4), dtype=np.int64)
    for bi in range(first, last, COARSE):
        for bj in range(0, out.shape[1], COARSE):
            for bk in range(0, out.shape[2], COARSE):
                todo[0, 0], todo[0, 1], todo[0, 2], todo[0, 3] = bi, bj, bk, COARSE
                depth = 1
                while depth > 0:
                    depth -= 1
                    i, j, k, size = todo[depth, 0], todo[depth, 1], todo[depth, 2], todo[depth, 3]
                    if i >= last or j >= out.shape[1] or k >= out.shape[2]:
                        continue
                    half = 0.5 * side * size
                    x, y, z = low[0] + side * i + half, low[1] + side * j + half, low[2] + side * k + half
                    state = box_state(blob, ints, tab, x, y, z, half, nodes, stack, q, e)
                    if state == MIXED and size > 1:
                        size //= 2
                        for c in range(8):
                            todo[depth, 0], todo[depth, 1] = i + size * (c & 1), j + size * ((c >> 1) & 1)
                            todo[depth, 2], todo[depth, 3] = k + size * (c >> 2), size
                            depth += 1
                        continue
                    value = 0 if state == MIXED else (1 if state == IN else -1)
                    for a in range(i, min(i + size, last)):
                        for b in range(j, min(j + size, out.shape[1])):
                            for c in range(k, min(k + size, out.shape[2])):
                                out[a, b, c] = value


@unmanaged
def _prove_brick(blob, ints, tab, low, side, brick, q, e, acc, plane, out, left, right):
    """Fill out (SURFEL_SIZE,) with a brick's own surfel, in voxel units from its centre; a plane of zeros: none."""
    x = low[0] + side * BRICK * (brick[0] + 0.5)
    y = low[1] + side * BRICK * (brick[1] + 0.5)
    z = low[2] + side * BRICK * (brick[2] + 0.5)
    state = prove_voxel(blob, ints, tab, x, y, z, 0.5 * BRICK * side, side, q, e, acc, plane, out, left, right)
    if state != MIXED or math.isnan(out[OFFSET]):
        out[:] = 0.0
    if state == IN or state == OUT:
        out[OFFSET] = -SURE if state == IN else SURE


@entry
def fill_voxels(blob, low, side, bricks, voxels, bases, planes, surfels, extras):
    """Prove the voxels, of side `side`, of bricks (n, 3) one by one; return how many surfels and extras there are.

    voxels: (n, 64) int16, leaps of 1. bases: (n,) the first surfel of each brick. planes: (n, SURFEL_SIZE) float32 the
    brick's own.
    surfels: (64 n + 1, SURFEL_SIZE) float32, extras: twice that, room for all that there may be.
    """
    ints, tab = integers(blob), tables(blob)
    nodes, stack = np.empty(NODES, dtype=np.int64), np.empty(STACK, dtype=np.int64)
    q, e, acc, plane = np.empty(3), np.empty(3), np.empty(6), np.empty(SURFEL_SIZE)
    left, right = np.empty(SURFEL_SIZE, dtype=np.float32), np.empty(SURFEL_SIZE, dtype=np.float32)
    used = extra = 0
    for n in range(bricks.shape[0]):
        bases[n] = used
        _prove_brick(blob, ints, tab, low, side, bricks[n], q, e, acc, plane, planes[n], left, right)
        for c in range(8):
            i, j, k = 2 * (c >> 2), 2 * ((c >> 1) & 1), 2 * (c & 1)
            bi, bj, bk = BRICK * bricks[n, 0] + i, BRICK * bricks[n, 1] + j, BRICK * bricks[n, 2] + k
            x, y, z = low[0] + side * (bi + 1), low[1] + side * (bj + 1), low[2] + side * (bk + 1)
            block = box_state(blob, ints, tab, x, y, z, side, nodes, stack, q, e)
            for d in range(8):
                i1, j1, k1 = d >> 2, (d >> 1) & 1, d & 1
                state = block
                voxel = NO_SURFEL
                if state == MIXED:
                    x = low[0] + side * (bi + i1 + 0.5)
                    y = low[1] + side * (bj + j1 + 0.5)
                    z = low[2] + side * (bk + k1 + 0.5)
                    state = prove_voxel(
                        blob, ints, tab, x, y, z, 0.5 * side, side, q, e, acc, plane, surfels[used], left, right
                    )
                    if state == MIXED:
                        if surfels[used, DETAIL + SURFEL_OWNER] < 0:
                            surfels[used, DETAIL + EXTRA] = extra
                            extras[extra], extras[extra + 1] = left, right
                            extra += 2
                        voxel = used - bases[n]
                        used += 1
                    elif state < 0:
                        state = box_state(blob, ints, tab, x, y, z, 0.5 * side, nodes, stack, q, e)
                if state != MIXED:
                    voxel = PROVEN + (IN_BIT if state == IN else 0)
                voxels[n, 16 * (i + i1) + 4 * (j + j1) + k + k1] = voxel
    return used, extra


@entry
def fill_octant(states, octant, out):
    """Fill (nx, ny, nz) int8 leaps of one octant: ± the side, in bricks, of the greatest cube of one state.

    The cube starts with the brick and extends towards +x where the octant's bit 0 is set, else −x; bits 1
    and 2: y, z. 0 where the state is not proven. Beyond the grid all is outside.
    """
    nx, ny, nz = states.shape
    sx, sy, sz = (1 if octant & 1 else -1), (1 if octant & 2 else -1), (1 if octant & 4 else -1)
    for s in range(nx):
        i = nx - 1 - s if sx > 0 else s
        for t in range(ny):
            j = ny - 1 - t if sy > 0 else t
            in_x, in_y = 0 <= i + sx < nx, 0 <= j + sy < ny
            for u in range(nz):
                k = nz - 1 - u if sz > 0 else u
                state = np.int64(states[i, j, k])
                if state == 0:
                    out[i, j, k] = 0
                    continue
                best = LONGEST - 1
                # Beyond the grid an outside cube may grow on; an inside one cannot be there.
                in_z = 0 <= k + sz < nz
                if state > 0 and not (in_x and in_y and in_z):
                    best = 0
                if in_x:
                    best = min(best, state * np.int64(out[i + sx, j, k]))
                    if in_y:
                        best = min(best, state * np.int64(out[i + sx, j + sy, k]))
                    if in_z:
                        best = min(best, state * np.int64(out[i + sx, j, k + sz]))
                    if in_y and in_z:
                        best = min(best, state * np.int64(out[i + sx, j + sy, k + sz]))
                if in_y:
                    best = min(best, state * np.int64(out[i, j + sy, k]))
                    if in_z:
                        best = min(best, state * np.int64(out[i, j + sy, k + sz]))
                if in_z:
                    best = min(best, state * np.int64(out[i, j, k + sz]))
                out[i, j, k] = state * (max(best, 0) + 1)


@inlined
def state_of(voxel):
    """Return 1 inside, −1 outside, 0 not proven."""
    if voxel >= 0:
        return 0
    return 1 if voxel & IN_BIT else -1


@inlined
def step_of(voxel, octant):
    """Return the leap of a proven voxel, in voxels, less 1."""
    return (voxel >> (SHORT_BITS + STEP_BITS * ((voxel >> octant) & 1))) & FARTHEST_STEP


@inlined
def leap_of(words, brick, octant):
    """Return the leap of a proven brick, in bricks: < 0 outside."""
    leap = (np.int64(words[brick + (octant >> 2)]) >> (8 * (octant & 3))) & 255
    return leap if leap < 128 else leap - 256


@entry
def state_voxels(bricks, voxels, out):
    """Fill out (4·nx, 4·ny, 4·nz) int8 of bricks (nx, ny, nz) int8: 1 inside, −1 outside, 0 neither.

    voxels: (n, 64) int16, those of the bricks that are 0, in their order.
    """
    slot = -1
    for bi in range(bricks.shape[0]):
        for bj in range(bricks.shape[1]):
            for bk in range(bricks.shape[2]):
                state = bricks[bi, bj, bk]
                slot += 1 if state == 0 else 0
                for v in range(64):
                    if bricks[bi, bj, bk] == 0:
                        state = state_of(np.int64(voxels[slot, v]))
                    out[BRICK * bi + (v >> 4), BRICK * bj + ((v >> 2) & 3), BRICK * bk + (v & 3)] = state


@entry
def fill_steps(bricks, leaps, out):
    """Fill out (n, 64) int8 with the leaps (4·nx, 4·ny, 4·nz) int8 of one octant, less 1, by voxel."""
    slot = 0
    for bi in range(bricks.shape[0]):
        for bj in range(bricks.shape[1]):
            for bk in range(bricks.shape[2]):
                if bricks[bi, bj, bk] != 0:
                    continue
                for v in range(64):
                    leap = leaps[BRICK * bi + (v >> 4), BRICK * bj + ((v >> 2) & 3), BRICK * bk + (v & 3)]
                    out[slot, v] = min(max(abs(np.int64(leap)) - 1, 0), FARTHEST_STEP)
                slot += 1


@inlined
def level_of(shorts, plane, x, y, z):
    """Return the value of a plane at a place from its middle, in voxels."""
    rise = np.float64(shorts[plane]) * x + np.float64(shorts[plane + 1]) * y + np.float64(shorts[plane + 2]) * z
    return (rise + np.float64(shorts[plane + OFFSET])) * (1.0 / FINE)


@inlined
def rise_of(shorts, plane, x, y, z):
    """Return what the value of a plane changes by along a way, in voxels."""
    rise = np.float64(shorts[plane]) * x + np.float64(shorts[plane + 1]) * y + np.float64(shorts[plane + 2]) * z
    return rise * (1.0 / FINE)


@inlined
def voxel_state(blob, ints, tab, shorts, words, x, y, z):
    """Return 1 inside, −1 outside, 0 not proven, of a point of the tree's frame, by its voxel and its surfel.

    shorts, words: the blob as integers of 16 and of 32 bits. There must be a grid.
    """
    c, f = ints[VOXELS], ints[VOXEL_FRAME]
    scale = blob[f + 4]
    u, v, w = (x - blob[f]) * scale, (y - blob[f + 1]) * scale, (z - blob[f + 2]) * scale
    if not (0.0 <= u < BRICK * ints[c] and 0.0 <= v < BRICK * ints[c + 1] and 0.0 <= w < BRICK * ints[c + 2]):
        return -1
    i, j, k = int(u), int(v), int(w)
    brick = ints[c + BRICKS] + BRICK_SIZE * (((i >> 2) * ints[c + 1] + (j >> 2)) * ints[c + 2] + (k >> 2))
    first = np.int64(words[brick + BRICK_VOXELS])
    if first < 0:
        return 1 if leap_of(words, brick, np.int64(0)) > 0 else -1
    level = level_of(shorts, 2 * brick, u - ((i | 3) - 1), v - ((j | 3) - 1), w - ((k | 3) - 1))
    if abs(level) > 1.0:
        return -1 if level > 0.0 else 1
    voxel = np.int64(shorts[ints[c + VOXELS_AT] + first + (((i & 3) << 4) | ((j & 3) << 2) | (k & 3))])
    if voxel < 0:
        return state_of(voxel)
    if voxel == NO_SURFEL:
        return 0
    number = np.int64(words[brick + BRICK_SURFEL]) + voxel
    level = level_of(shorts, ints[c + PLANES] + PLANE_SIZE * number, u - (i + 0.5), v - (j + 0.5), w - (k + 0.5))
    if not abs(level) > 1.0:
        d = ints[c + DETAILS] + DETAIL_SIZE * number
        owner = int(tab[d + SURFEL_OWNER])
        if owner >= 0:
            return 0
        n = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * (-1 - owner)
        right = blob[n] * x + blob[n + 1] * y + blob[n + 2] * z - blob[n + 3] >= 0.0
        number = int(tab[d + EXTRA]) + (1 if right else 0)
        level = level_of(shorts, ints[c + PLANES] + PLANE_SIZE * number, u - (i + 0.5), v - (j + 0.5), w - (k + 0.5))
        if not abs(level) > 1.0:
            return 0
    return -1 if level > 0.0 else 1


@unmanaged
def settled_about(blob, ints, x, y, z):
    """Return whether a point of the tree's frame, and all within 1e-6 mm of it, lies in a voxel of one proven state."""
    c, f = ints[VOXELS], ints[VOXEL_FRAME]
    if c == 0:
        return False
    scale = blob[f + 4]
    u, v, w = (x - blob[f]) * scale, (y - blob[f + 1]) * scale, (z - blob[f + 2]) * scale
    if not (0.0 <= u < BRICK * ints[c] and 0.0 <= v < BRICK * ints[c + 1] and 0.0 <= w < BRICK * ints[c + 2]):
        return True  # half a voxel and more beyond the solid
    i, j, k = int(u), int(v), int(w)
    brick = ints[c + BRICKS] + BRICK_SIZE * (((i >> 2) * ints[c + 1] + (j >> 2)) * ints[c + 2] + (k >> 2))
    first = np.int64(blob.view(np.int32)[brick + BRICK_VOXELS])
    inner = ((i & 3) << 4) | ((j & 3) << 2) | (k & 3)
    return first < 0 or blob.view(np.int16)[ints[c + VOXELS_AT] + first + inner] < 0


@unmanaged
def solid_contains(blob, ints, tab, root, x, y, z):
    """Return whether the solid of node `root` holds a point of the tree's frame: by its voxel, else by the formulas."""
    if root == 0 and ints[VOXELS] != 0:
        state = voxel_state(blob, ints, tab, blob.view(np.int16), blob.view(np.int32), x, y, z)
        if state != 0:
            return state > 0
    return contains_point(blob, ints, tab, root, x, y, z)
