"""A segment's walk through the voxels: leaps over what is proven, planes at the surface, runs of what is left.

A run is a stretch that no plane decides. Where the planes prove F monotone along it, it holds one crossing if the
states at its ends differ and none else; where they do not, the cells of the leaf's chart settle it; where a cut, a band
or a retained part is near, the stretch is clipped down the tree.
"""

import numpy as np

from hhsr.kernels.cell import leaf_implicit
from hhsr.kernels.lane import (
    BACK,
    BEGIN,
    DEPTH,
    END,
    EXIT,
    FOUND,
    GAP,
    INVERSE,
    LAST,
    LEFT_AT,
    NUDGED,
    OCTANT,
    RUNS_USED,
    SHIFT,
    SIGN,
    SLOPE,
    SPEED,
    START,
    STATE,
    STOP,
    SURE,
    SURFEL,
    T,
    U,
    V,
)
from hhsr.kernels.layout import NODE_FLOAT_SIZE, NODE_FLOATS, OWNER_INT_SIZE, OWNER_INTS, OWNER_RECORD, VOXELS
from hhsr.kernels.runs import MONOTONE, NONE, OWN, OWNER, RUN_BEGIN, close, enter, note
from hhsr.kernels.surfel import BEND, DETAIL_SIZE, EXTRA, PLANE_SIZE, SURFEL_OWNER, THICK, TURN
from hhsr.kernels.tree import into_leaf
from hhsr.kernels.unmanaged import inlined
from hhsr.kernels.voxels import (
    BRICK,
    BRICK_SIZE,
    BRICK_SURFEL,
    BRICK_VOXELS,
    BRICKS,
    DETAILS,
    NO_SURFEL,
    PLANES,
    VOXELS_AT,
    leap_of,
    level_of,
    rise_of,
    solid_contains,
    state_of,
    step_of,
)

SPARE = 8  # records that are left when a walk alone waits for its runs to be settled
UNKNOWN = 2


@inlined
def _holds(blob, ints, owner, x, y, z):
    """Return whether a model leaf holds a point of the tree's frame, by the exact formula."""
    leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * owner + OWNER_RECORD]
    x, y, z = into_leaf(blob, ints, leaf, x, y, z)
    return leaf_implicit(blob, ints, leaf, x, y, z) <= 0.0


@inlined
def _along_plane(shorts, plane, x, y, z, vx, vy, vz, length):
    """Return (slope, value at a place, value `length` of t on, whether the plane decides all between the two)."""
    slope, l0 = rise_of(shorts, plane, vx, vy, vz), level_of(shorts, plane, x, y, z)
    l1 = l0 + slope * length
    return slope, l0, l1, (l0 > 1.0 and l1 > 1.0) or (l0 < -1.0 and l1 < -1.0)


@inlined
def go_on(blob, ints, tab, lanes, lane, first, alone, runs):
    """Go on with the walk in a lane, keeping its runs (n, RUN_SIZE); return whether it is at its end.

    alone: to the end, or until there is little room for runs. Else to a voxel that may be left by strides of all lanes
    (`hhsr.kernels.stride`). No run is pending then. first: to the first place that the state has surely changed at.
    """
    shorts, words = blob.view(np.int16), blob.view(np.int32)
    c = ints[VOXELS]
    nx, ny, nz = ints[c], ints[c + 1], ints[c + 2]
    top_x, top_y, top_z = BRICK * nx - 1, BRICK * ny - 1, BRICK * nz - 1
    bricks, voxels, octant = ints[c + BRICKS], ints[c + VOXELS_AT], int(lanes[OCTANT, lane])
    planes, details = ints[c + PLANES], ints[c + DETAILS]
    px, py, pz = lanes[START, lane], lanes[START + 1, lane], lanes[START + 2, lane]
    qx, qy, qz = lanes[END, lane], lanes[END + 1, lane], lanes[END + 2, lane]
    dx, dy, dz = qx - px, qy - py, qz - pz
    ux, uy, uz = lanes[U, lane], lanes[U + 1, lane], lanes[U + 2, lane]
    vx, vy, vz = lanes[V, lane], lanes[V + 1, lane], lanes[V + 2, lane]
    ix, iy, iz = lanes[INVERSE, lane], lanes[INVERSE + 1, lane], lanes[INVERSE + 2, lane]
    kx, ky, kz = lanes[SHIFT, lane], lanes[SHIFT + 1, lane], lanes[SHIFT + 2, lane]
    sx, sy, sz = int(lanes[SIGN, lane]), int(lanes[SIGN + 1, lane]), int(lanes[SIGN + 2, lane])
    ox, oy, oz = int(lanes[BACK, lane]), int(lanes[BACK + 1, lane]), int(lanes[BACK + 2, lane])
    t, stop, nudge = lanes[T, lane], lanes[STOP, lane], lanes[NUDGED, lane]
    gap, speed = lanes[GAP, lane], lanes[SPEED, lane]
    begun, begin, state = lanes[STATE, lane] >= 0.0, lanes[BEGIN, lane] > 0.0, lanes[STATE, lane] > 0.0
    strode = t != lanes[LEFT_AT, lane]
    sure, last = strode or lanes[SURE, lane] > 0.0, -1 if strode else int(lanes[LAST, lane])
    last_surfel = np.int64(-1)
    kind, done, full = np.int64(NONE), True, runs.shape[0] - SPARE
    while True:
        if kind == NONE and lanes[RUNS_USED, 0] > full:
            done = False
            break
        if first and (t if kind == NONE else runs[int(lanes[RUNS_USED, 0]), RUN_BEGIN]) > lanes[FOUND, lane] + gap:
            break
        if t >= stop:
            # The end has its own state: along a cutting plane it may not be the one that the walk came with.
            holds = stop >= 1.0 and (state if sure else solid_contains(blob, ints, tab, np.int64(0), qx, qy, qz))
            if kind == NONE:
                note(blob, ints, runs, lanes, lane, state, holds, stop)
            else:
                close(blob, ints, kind, runs, lanes, lane, state, holds, stop, last_surfel)
            state = holds
            break
        x, y, z = ux + t * vx, uy + t * vy, uz + t * vz
        i, j, k = min(max(int(x), 0), top_x), min(max(int(y), 0), top_y), min(max(int(z), 0), top_z)
        bi, bj, bk = i >> 2, j >> 2, k >> 2
        brick = bricks + BRICK_SIZE * ((bi * ny + bj) * nz + bk)
        held = np.int64(words[brick + BRICK_VOXELS])
        known, surfel, plain, proven, far, r = UNKNOWN, np.int64(-1), False, False, np.inf, np.int64(1)
        if held < 0:
            r = leap_of(words, brick, octant)
            known, r = (1 if r > 0 else 0), abs(r)
            ex = ((bi + sx * r + ox) << 2) * ix + kx
            ey = ((bj + sy * r + oy) << 2) * iy + ky
            ez = ((bk + sz * r + oz) << 2) * iz + kz
        else:
            l0 = level_of(shorts, 2 * brick, x - ((i | 3) - 1), y - ((j | 3) - 1), z - ((k | 3) - 1))
            voxel = np.int64(shorts[voxels + held + (((i & 3) << 4) | ((j & 3) << 2) | (k & 3))])
            proven = voxel < 0
            if proven:
                known = 1 if state_of(voxel) > 0 else 0
                r += step_of(voxel, octant)
            plain = abs(l0) > 1.0
            if plain:
                # The brick's own plane decides, up to where the segment comes near it; or the voxel goes on farther.
                known = 1 if l0 < 0.0 else 0
                slope = rise_of(shorts, 2 * brick, vx, vy, vz)
                if (l0 > 0.0) != (slope > 0.0) and slope != 0.0:
                    far = t + (abs(l0) - 1.0) / abs(slope)
                ex = ((bi + sx + ox) << 2) * ix + kx
                ey = ((bj + sy + oy) << 2) * iy + ky
                ez = ((bk + sz + oz) << 2) * iz + kz
                far = min(min(ex, ey), min(ez, far))
            elif 0 <= voxel < NO_SURFEL:
                surfel = np.int64(words[brick + BRICK_SURFEL]) + voxel
            ex = (i + sx * r + ox) * ix + kx
            ey = (j + sy * r + oy) * iy + ky
            ez = (k + sz * r + oz) * iz + kz
        if not begun:
            begun = True
            begin = known == 1 if known != UNKNOWN else solid_contains(blob, ints, tab, np.int64(0), px, py, pz)
            state = begin
        sure = known != UNKNOWN and kind == NONE
        end = min(min(ex, ey), ez)
        if plain:
            end = max(end, far) if proven else far
        end = min(end, stop)
        a, b, after, owner, cut = t, end, UNKNOWN, -1, False
        slope = stray = bend = guess = 0.0
        if surfel >= 0:
            slope, l0, l1, decided = _along_plane(
                shorts, planes + PLANE_SIZE * surfel, x - i - 0.5, y - j - 0.5, z - k - 0.5, vx, vy, vz, end - t
            )
            o = details + DETAIL_SIZE * surfel
            if not decided:
                owner = int(tab[o + SURFEL_OWNER])
                cut = owner < 0
            if cut:
                # A cut passes, and the plane of both sides does not decide: the side that t is on, and no farther.
                n = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * (-1 - owner)
                h = blob[n] * px + blob[n + 1] * py + blob[n + 2] * pz - blob[n + 3]
                g = blob[n] * dx + blob[n + 1] * dy + blob[n + 2] * dz
                right = h >= 0.0
                if g != 0.0:
                    meet = -h / g
                    right = (t >= meet) == (g > 0.0)
                    if t < meet:
                        end = min(end, meet)
                surfel = np.int64(tab[o + EXTRA]) + (1 if right else 0)
                slope, l0, l1, decided = _along_plane(
                    shorts, planes + PLANE_SIZE * surfel, x - i - 0.5, y - j - 0.5, z - k - 0.5, vx, vy, vz, end - t
                )
                o = details + DETAIL_SIZE * surfel
                owner = int(tab[o + SURFEL_OWNER])
            b = end
            if abs(l0) > 1.0:
                known = 1 if l0 < 0.0 else 0
            if abs(l1) > 1.0:
                after = 1 if l1 < 0.0 else 0
            if decided:
                surfel = np.int64(-1)
            else:
                if known != UNKNOWN:
                    a = t + (abs(l0) - 1.0) / abs(slope)
                if after != UNKNOWN:
                    b = end - (abs(l1) - 1.0) / abs(slope)
                guess = t - l0 / slope if slope != 0.0 else t
                slope *= np.float64(tab[o + THICK])
                stray, bend = speed * np.float64(tab[o + TURN]), speed * speed * np.float64(tab[o + BEND])
            # Beyond a cut the run, or the state before it, is another owner's: exact states part the two.
            foreign = cut and (kind == MONOTONE or kind == OWN) and runs[int(lanes[RUNS_USED, 0]), OWNER] != owner
            if foreign or (cut and kind == NONE and known == UNKNOWN and last >= 0 and last != owner):
                asked = int(runs[int(lanes[RUNS_USED, 0]), OWNER]) if foreign else owner
                holds = _holds(blob, ints, asked, px + t * dx, py + t * dy, pz + t * dz)
                if foreign:
                    close(blob, ints, kind, runs, lanes, lane, state, holds, t, last_surfel)
                    state, kind = holds, np.int64(NONE)
                    continue  # look at this voxel again, without a run
                note(blob, ints, runs, lanes, lane, state, holds, t)
                state = holds
        last = owner if cut else -1
        if known != UNKNOWN:
            if kind == NONE:
                note(blob, ints, runs, lanes, lane, state, known == 1, t)
            else:
                close(blob, ints, kind, runs, lanes, lane, state, known == 1, t, last_surfel)
            state, kind = known == 1, np.int64(NONE)
        if surfel >= 0 or known == UNKNOWN:
            kind = enter(kind, runs, lanes, a, max(a, b), owner, slope, stray, bend, guess)
            last_surfel = surfel
            if after != UNKNOWN:
                close(blob, ints, kind, runs, lanes, lane, state, after == 1, max(a, b), surfel)
                state, kind = after == 1, np.int64(NONE)
        t = max(end, t) + nudge
        if not alone and kind == NONE and t < stop and not (first and lanes[FOUND, lane] < np.inf):
            done = False
            break
    lanes[T, lane] = lanes[LEFT_AT, lane] = t
    lanes[STATE, lane], lanes[BEGIN, lane] = 1.0 if state else 0.0, 1.0 if begin else 0.0
    lanes[SURE, lane], lanes[LAST, lane] = 1.0 if sure else 0.0, last
    return done


@inlined
def cross_voxel(blob, ints, tab, lanes, lane, runs):
    """Take a lane through the voxel where its stride ended if its surfel settles that; return whether it did.

    What `go_on` does most often: no run is pending, and the plane proves the state behind the voxel.
    """
    surfel, state = int(lanes[SURFEL, lane]), lanes[STATE, lane] > 0.0
    if surfel < 0 or lanes[STATE, lane] < 0.0:
        return False
    t, end, l0, slope = lanes[T, lane], lanes[EXIT, lane], lanes[DEPTH, lane], lanes[SLOPE, lane]
    l1 = l0 + slope * (end - t)
    sure = abs(l0) > 1.0
    if abs(l1) <= 1.0 or (sure and (l0 < 0.0) != state):
        return False
    o = ints[ints[VOXELS] + DETAILS] + DETAIL_SIZE * surfel
    owner = int(tab[o + SURFEL_OWNER])
    if owner < 0:
        return False
    speed, thick = lanes[SPEED, lane], np.float64(tab[o + THICK])
    stray, after = speed * np.float64(tab[o + TURN]), l1 < 0.0
    if after != state or abs(slope * thick) <= stray:
        a = t + (abs(l0) - 1.0) / abs(slope) if sure else t
        b = max(a, end - (abs(l1) - 1.0) / abs(slope))
        guess, bend = t - l0 / slope if slope != 0.0 else t, speed * speed * np.float64(tab[o + BEND])
        kind = enter(np.int64(NONE), runs, lanes, a, b, owner, slope * thick, stray, bend, guess)
        close(blob, ints, kind, runs, lanes, lane, state, after, b, np.int64(surfel))
        lanes[STATE, lane] = 1.0 if after else 0.0
    t = max(end, t) + lanes[NUDGED, lane]
    lanes[T, lane] = lanes[LEFT_AT, lane] = t
    lanes[SURE, lane], lanes[LAST, lane] = 1.0 if sure else 0.0, -1.0
    return True
