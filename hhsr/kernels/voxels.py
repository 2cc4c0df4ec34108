"""A grid of cubes about the solid, proven inside or outside, or given the surface's plane, or left to the formulas.

Voxels come in bricks of 4³. A brick that is proven whole has a leap for each octant of directions: the greatest cube of
bricks, from it on that way, in which nothing changes. The others have a plane (`hhsr.kernels.surfel`) that decides most
of the brick, and each of their voxels a byte: the number of its own surfel in the brick; or that it is proven. Proven
voxels have, for each octant of directions, a leap too: a cube of voxels, from it on that way, in which nothing changes.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.box_state import IN, MIXED, OUT, box_state
from hhsr.kernels.layout import NODE_FLOAT_SIZE, NODE_FLOATS, VOXEL_FRAME, VOXELS, integers, tables
from hhsr.kernels.surfel import (
    DETAIL,
    DETAIL_SIZE,
    EXTRA,
    OFFSET,
    PLANE_SIZE,
    SURE,
    SURFEL_OWNER,
    SURFEL_SIZE,
    prove_voxel,
)
from hhsr.kernels.tree import contains_point
from hhsr.kernels.triangle_build import STACK
from hhsr.kernels.unmanaged import inlined, unmanaged

BRICK = 4  # voxels a side
COARSE = 8  # bricks a side of the first cubes that are tried
NODES = 256
# The grid's record, integer slots: bricks along x, y, z; then where its tables begin: octants' leaps (bytes), bricks
# (32 bits: the number of a brick with voxels; −1 inside, −2 outside), of bricks with voxels the first surfel (32 bits),
# the 64 bytes, the brick's own plane (float32 slot); of surfels the planes and the details (float32 slots); of bricks
# with voxels the leaps of these (STEP_WORDS of 32 bits; those of the next octant OCTANT_WORDS on).
LEAPS, BRICKS, BASES, BYTES, BRICK_PLANES, PLANES, DETAILS, STEPS, OCTANT_WORDS = 3, 4, 5, 6, 7, 8, 9, 10, 11
VOXEL_INTS = 12
INSIDE_BRICK, OUTSIDE_BRICK = -1, -2
NO_SURFEL, IN_BYTE, OUT_BYTE = 64, 65, 66  # a byte: 0 … 63 a surfel of the brick; none; proven inside; outside
STEP_WORDS, STEP_BITS, FARTHEST_STEP = 4, 2, 3  # a voxel's leap: 2^bits voxels
LONGEST = 127  # bricks


@njit(cache=True, nogil=True, error_model="numpy")
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
    if state != MIXED or out[DETAIL + SURFEL_OWNER] < 0:
        out[:] = 0.0
    if state == IN or state == OUT:
        out[OFFSET] = -SURE if state == IN else SURE


@njit(cache=True, nogil=True, error_model="numpy")
def fill_voxels(blob, low, side, bricks, octets, bases, planes, surfels, extras):
    """Prove the voxels, of side `side`, of bricks (n, 3) one by one; return how many surfels and extras there are.

    octets: (n, 64) bytes. bases: (n,) the first surfel of each brick. planes: (n, SURFEL_SIZE) float32 the brick's own.
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
                byte = NO_SURFEL
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
                        byte = used - bases[n]
                        used += 1
                    elif state < 0:
                        state = box_state(blob, ints, tab, x, y, z, 0.5 * side, nodes, stack, q, e)
                if state != MIXED:
                    byte = IN_BYTE if state == IN else OUT_BYTE  # a leap of 1
                octets[n, 16 * (i + i1) + 4 * (j + j1) + k + k1] = byte
    return used, extra


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def state_voxels(bricks, octets, out):
    """Fill out (4·nx, 4·ny, 4·nz) int8 of bricks (nx, ny, nz) int8: 1 inside, −1 outside, 0 neither.

    octets: (n, 64) bytes of the bricks that are 0, in their order.
    """
    slot = -1
    for bi in range(bricks.shape[0]):
        for bj in range(bricks.shape[1]):
            for bk in range(bricks.shape[2]):
                state = bricks[bi, bj, bk]
                slot += 1 if state == 0 else 0
                for v in range(64):
                    if bricks[bi, bj, bk] == 0:
                        byte = octets[slot, v]
                        state = 1 if byte == IN_BYTE else (-1 if byte == OUT_BYTE else 0)
                    out[BRICK * bi + (v >> 4), BRICK * bj + ((v >> 2) & 3), BRICK * bk + (v & 3)] = state


@njit(cache=True, nogil=True, error_model="numpy")
def fill_steps(bricks, leaps, out):
    """Fill out (n, STEP_WORDS) uint32 with the leaps (4·nx, 4·ny, 4·nz) int8 of one octant; bricks: `state_voxels`."""
    slot = 0
    for bi in range(bricks.shape[0]):
        for bj in range(bricks.shape[1]):
            for bk in range(bricks.shape[2]):
                if bricks[bi, bj, bk] != 0:
                    continue
                for w in range(STEP_WORDS):
                    word = np.uint32(0)
                    for k in range(16):
                        v = 16 * w + k
                        leap = abs(
                            np.int64(leaps[BRICK * bi + (v >> 4), BRICK * bj + ((v >> 2) & 3), BRICK * bk + (v & 3)])
                        )
                        step = 0
                        while step < FARTHEST_STEP and leap >= 2 << step:
                            step += 1
                        word |= np.uint32(step) << np.uint32(STEP_BITS * k)
                    out[slot, w] = word
                slot += 1


@inlined
def voxel_state(blob, ints, tab, octets, words, x, y, z):
    """Return 1 inside, −1 outside, 0 not proven, of a point of the tree's frame, by its voxel and its surfel.

    octets, words: the blob as bytes and as 32-bit integers. There must be a grid.
    """
    c, f = ints[VOXELS], ints[VOXEL_FRAME]
    scale = blob[f + 4]
    u, v, w = (x - blob[f]) * scale, (y - blob[f + 1]) * scale, (z - blob[f + 2]) * scale
    if not (0.0 <= u < BRICK * ints[c] and 0.0 <= v < BRICK * ints[c + 1] and 0.0 <= w < BRICK * ints[c + 2]):
        return -1
    i, j, k = int(u), int(v), int(w)
    slot = words[ints[c + BRICKS] + ((i >> 2) * ints[c + 1] + (j >> 2)) * ints[c + 2] + (k >> 2)]
    if slot < 0:
        return 1 if slot == INSIDE_BRICK else -1
    o = ints[c + BRICK_PLANES] + PLANE_SIZE * slot
    level = tab[o] * (u - ((i | 3) - 1)) + tab[o + 1] * (v - ((j | 3) - 1)) + tab[o + 2] * (w - ((k | 3) - 1))
    level += tab[o + OFFSET]
    if abs(level) > 1.0:
        return -1 if level > 0.0 else 1
    byte = octets[ints[c + BYTES] + 64 * slot + (((i & 3) << 4) | ((j & 3) << 2) | (k & 3))]
    if byte > NO_SURFEL:
        return 1 if byte < OUT_BYTE else -1
    if byte == NO_SURFEL:
        return 0
    number = words[ints[c + BASES] + slot] + byte
    o = ints[c + PLANES] + PLANE_SIZE * number
    if math.isnan(tab[o + OFFSET]):
        d = ints[c + DETAILS] + DETAIL_SIZE * number
        n = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * (-1 - int(tab[d + SURFEL_OWNER]))
        right = blob[n] * x + blob[n + 1] * y + blob[n + 2] * z - blob[n + 3] >= 0.0
        o = ints[c + PLANES] + PLANE_SIZE * (int(tab[d + EXTRA]) + (1 if right else 0))
    level = tab[o] * (u - (i + 0.5)) + tab[o + 1] * (v - (j + 0.5)) + tab[o + 2] * (w - (k + 0.5)) + tab[o + OFFSET]
    if level > 1.0:
        return -1
    return 1 if level < -1.0 else 0


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
    slot = np.int64(
        blob.view(np.int32)[ints[c + BRICKS] + ((i >> 2) * ints[c + 1] + (j >> 2)) * ints[c + 2] + (k >> 2)]
    )
    if slot < 0:
        return True
    return blob.view(np.uint8)[ints[c + BYTES] + 64 * slot + (((i & 3) << 4) | ((j & 3) << 2) | (k & 3))] > NO_SURFEL


@unmanaged
def solid_contains(blob, ints, tab, root, x, y, z):
    """Return whether the solid of node `root` holds a point of the tree's frame: by its voxel, else by the formulas."""
    if root == 0 and ints[VOXELS] != 0:
        state = voxel_state(blob, ints, tab, blob.view(np.uint8), blob.view(np.int32), x, y, z)
        if state != 0:
            return state > 0
    return contains_point(blob, ints, tab, root, x, y, z)
