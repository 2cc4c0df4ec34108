"""A segment's walk through the voxels as a column of numbers: so that several can be under way side by side.

All in voxels from the grid's lowest corner on, the segment being u + t·v. ABREAST segments share a table of ROWS rows,
one column each; what the strides of all of them (`hhsr.kernels.stride`) read comes first.
"""

import math

import numpy as np

from hhsr.kernels.layout import VOXEL_FRAME, VOXELS
from hhsr.kernels.unmanaged import inlined
from hhsr.kernels.voxels import BRICK

# u, v; along an axis the border at x is met at t = x·inverse + shift, a still axis never; the sign of v, and 1 where it
# is negative; t, where it stops, how far past a border it goes on; the state it is in, −1 where that is not known yet;
# the octant of its direction.
U, V, INVERSE, SHIFT, SIGN, BACK = 0, 3, 6, 9, 12, 15
T, STOP, NUDGED, STATE, OCTANT = 18, 19, 20, 21, 22
# Tree's frame, mm: start, end. MERGE as a share of the segment; |v|. The start's state; whether a proven voxel's state
# stands up to t; the owner of the last voxel, where a cut passed it, else −1; the t it was left at; the number of the
# segment, −1 of an empty lane.
START, END, GAP, SPEED, BEGIN, SURE, LAST, LEFT_AT, SEGMENT = 23, 26, 29, 30, 31, 32, 33, 34, 35
# Runs (`hhsr.kernels.runs`): the segment's first and last, −1 if none; t up to which the state surely changed, infinite
# if it did not; whether there was no room for one; in lane 0, how many all lanes have.
FIRST_RUN, LAST_RUN, FOUND, SPILLED, RUNS_USED = 36, 37, 38, 39, 40
# Of the voxel that the last stride did not take, where its plane leaves the state open: number of the surfel (else −1),
# the plane's value at t and change by t, and where the segment leaves the voxel.
SURFEL, DEPTH, SLOPE, EXIT, ROWS = 41, 42, 43, 44, 45

ABREAST = 16  # segments whose strides are taken together
MERGE = 1e-9  # mm: a leaving and an entering closer than this are one touch
NUDGE = 1e-7  # mm (and voxels) past a voxel's border: less than voxels and planes are proven beyond theirs
STILL = 1e-12  # voxels: along an axis, a segment that moves less stays where it is


@inlined
def _set_axis(lanes, lane, axis, u, v, size, t0, t1):
    """Fill in one axis of a walk; return the interval of t in [t0, t1] in which u + t·v lies in [0, size]."""
    lanes[U + axis, lane], lanes[V + axis, lane] = u, v
    forward = v >= 0.0
    lanes[SIGN + axis, lane], lanes[BACK + axis, lane] = (1.0, 0.0) if forward else (-1.0, 1.0)
    if abs(v) < STILL:
        lanes[INVERSE + axis, lane], lanes[SHIFT + axis, lane] = 0.0, np.inf
        return (t0, t1) if 0.0 <= u <= size else (1.0, 0.0)
    inverse = 1.0 / v
    shift = -u * inverse
    lanes[INVERSE + axis, lane], lanes[SHIFT + axis, lane] = inverse, shift
    far = (size - u) * inverse
    return (max(t0, shift), min(t1, far)) if forward else (max(t0, far), min(t1, shift))


@inlined
def set_out(blob, ints, lanes, lane, px, py, pz, qx, qy, qz, length):
    """Begin the walk p → q (tree's frame; |q − p| > 0) in a lane; return whether it meets the grid at all."""
    dx, dy, dz = qx - px, qy - py, qz - pz
    c, f = ints[VOXELS], ints[VOXEL_FRAME]
    nx, ny, nz = ints[c], ints[c + 1], ints[c + 2]
    scale = blob[f + 4]
    ux, uy, uz = (px - blob[f]) * scale, (py - blob[f + 1]) * scale, (pz - blob[f + 2]) * scale
    vx, vy, vz = dx * scale, dy * scale, dz * scale
    start, stop = _set_axis(lanes, lane, 0, ux, vx, float(BRICK * nx), 0.0, 1.0)
    start, stop = _set_axis(lanes, lane, 1, uy, vy, float(BRICK * ny), start, stop)
    start, stop = _set_axis(lanes, lane, 2, uz, vz, float(BRICK * nz), start, stop)
    if not start < stop:
        return False
    octant = (1 if vx >= 0.0 else 0) + (2 if vy >= 0.0 else 0) + (4 if vz >= 0.0 else 0)
    once = 1.0 / length
    nudge = max(NUDGE * min(1.0, blob[f + 3]) * once, 1e-15)
    t = start + nudge if start > 0.0 else 0.0
    lanes[T, lane], lanes[STOP, lane], lanes[NUDGED, lane] = t, stop, nudge
    begun = start > 0.0  # from outside of the grid
    lanes[STATE, lane], lanes[BEGIN, lane] = 0.0 if begun else -1.0, 0.0
    lanes[OCTANT, lane] = octant
    lanes[START, lane], lanes[START + 1, lane], lanes[START + 2, lane] = px, py, pz
    lanes[END, lane], lanes[END + 1, lane], lanes[END + 2, lane] = qx, qy, qz
    lanes[GAP, lane] = MERGE * once
    lanes[SPEED, lane] = math.sqrt(vx * vx + vy * vy + vz * vz)
    lanes[SURE, lane], lanes[LAST, lane], lanes[LEFT_AT, lane] = 0.0, -1.0, t
    lanes[FIRST_RUN, lane], lanes[LAST_RUN, lane] = -1.0, -1.0
    lanes[FOUND, lane], lanes[SPILLED, lane] = np.inf, 0.0
    return True
