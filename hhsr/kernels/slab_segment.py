"""Where a segment crosses the strips of a slab: bisection on proven ranges of each lobe's radius (DESIGN §2, §4)."""

import math

import numpy as np

from hhsr.kernels.segment import PIECES, emit
from hhsr.kernels.slab import (
    ENCLOSURE,
    LOBE_COUNT,
    LOBE_INT_SIZE,
    LOBE_SPHERES,
    LOBE_TABLES,
    LOBES,
    SLAB_FRAME,
    TABLE,
    lobe_radius,
)
from hhsr.kernels.slab_bounds import STEP, lobe_range
from hhsr.kernels.unmanaged import unmanaged

WIDEST = 4.0 * STEP


@unmanaged
def _lobe_verdict(blob, ints, lobe, u, v, du, dv, s0, s1, h0, h1):
    """Return 1 where the piece [s0, s1] of (u, v) + s·(du, dv) lies in the lobe, 0 outside, 2 where not proven."""
    o = ints[lobe + LOBE_TABLES]
    u, v = u - blob[o], v - blob[o + 1]
    u0, v0, u1, v1 = u + s0 * du, v + s0 * dv, u + s1 * du, v + s1 * dv
    far = math.sqrt(max(u0 * u0 + v0 * v0, u1 * u1 + v1 * v1))
    dd = du * du + dv * dv
    s = min(max(-(u * du + v * dv) / dd, s0), s1) if dd > 0.0 else s0
    near = math.sqrt((u + s * du) ** 2 + (v + s * dv) ** 2)
    a0, a1 = math.atan2(v0, u0), math.atan2(v1, u1)
    turn = abs(a1 - a0)
    if turn > math.pi:
        turn = 2.0 * math.pi - turn
    if turn > WIDEST or near <= 1e-9 * far:
        # Too wide for a close bound: the lobe's own limits.
        low, high = np.inf, 0.0
        q = ints[lobe + LOBE_SPHERES]
        for segment in range(TABLE):
            low, high = min(low, blob[q + ENCLOSURE * segment + 4]), max(high, blob[q + ENCLOSURE * segment + 5])
        if near > high:
            return 0
        return 1 if far < low else 2
    t0, t1 = (h0, h1) if h0 < h1 else (h1, h0)
    if abs(a1 - a0) > math.pi:  # across ±π
        low, high = lobe_range(blob, ints, lobe, max(a0, a1), math.pi, t0, t1)
        other = lobe_range(blob, ints, lobe, -math.pi, min(a0, a1), t0, t1)
        low, high = min(low, other[0]), max(high, other[1])
    else:
        low, high = lobe_range(blob, ints, lobe, min(a0, a1), max(a0, a1), t0, t1)
    grow = 1e-12 * (far + high)
    if near > max(high, 0.0) + grow:
        return 0
    return 1 if far < low - grow else 2


@unmanaged
def _inside(blob, ints, slab, u, v, t):
    for k in range(ints[slab + LOBE_COUNT]):
        lobe = ints[slab + LOBES] + LOBE_INT_SIZE * k
        o = ints[lobe + LOBE_TABLES]
        x, y = u - blob[o], v - blob[o + 1]
        r = lobe_radius(blob, ints, lobe, x, y, t)
        if r > 0.0 and x * x + y * y <= r * r:
            return True
    return False


@unmanaged
def slab_crossings(blob, ints, slab, px, py, pz, dx, dy, dz, t0, t1, resolution, tolerance, state, out, count, work):
    """Follow p + t·d (tree's frame) for t in [t0, t1]; return (state, count), having recorded each change of state."""
    f = ints[slab + SLAB_FRAME]
    frame = blob[f : f + 11]
    u, v = frame[0] * px + frame[1] * py + frame[2] * pz, frame[3] * px + frame[4] * py + frame[5] * pz
    du, dv = frame[0] * dx + frame[1] * dy + frame[2] * dz, frame[3] * dx + frame[4] * dy + frame[5] * dz
    h = frame[6] * px + frame[7] * py + frame[8] * pz - frame[9]
    dh = frame[6] * dx + frame[7] * dy + frame[8] * dz
    speed = math.sqrt(dx * dx + dy * dy + dz * dz)
    work[0, 0], work[0, 1] = t0, t1
    depth = 1
    while depth > 0:
        depth -= 1
        a, b = work[depth, 0], work[depth, 1]
        h0 = min(max(0.5 * ((h + a * dh) / frame[10] + 1.0), 0.0), 1.0)
        h1 = min(max(0.5 * ((h + b * dh) / frame[10] + 1.0), 0.0), 1.0)
        verdict = 0
        for k in range(ints[slab + LOBE_COUNT]):
            lobe = ints[slab + LOBES] + LOBE_INT_SIZE * k
            one = _lobe_verdict(blob, ints, lobe, u, v, du, dv, a, b, h0, h1)
            if one == 1:
                verdict = 1
                break
            verdict = max(verdict, one)
        if verdict < 2:
            state, count = emit(state, verdict == 1, a, out, count)
            continue
        if (b - a) * speed > resolution and depth + 2 < PIECES:
            t = 0.5 * (a + b)
            work[depth, 0], work[depth, 1] = t, b
            work[depth + 1, 0], work[depth + 1, 1] = a, t
            depth += 2
            continue
        first = _inside(blob, ints, slab, u + a * du, v + a * dv, h0)
        last = _inside(blob, ints, slab, u + b * du, v + b * dv, h1)
        state, count = emit(state, first, a, out, count)
        if first != last:
            while (b - a) * speed > 0.5 * tolerance:
                t = 0.5 * (a + b)
                height = min(max(0.5 * ((h + t * dh) / frame[10] + 1.0), 0.0), 1.0)
                if _inside(blob, ints, slab, u + t * du, v + t * dv, height) == first:
                    a = t
                else:
                    b = t
            state, count = emit(state, last, 0.5 * (a + b), out, count)
    return state, count
