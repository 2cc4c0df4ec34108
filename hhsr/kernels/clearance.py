"""Clearance of segments: their distance to the solid, or how deep they run in it (DESIGN §2, §4).

Any surface point bounds the depth at every place by its distance: a depth is proven from above by points found, and
from below by one true distance or two.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.crossing import follow_segment, scratch
from hhsr.kernels.descent import descend_from, onto_surface
from hhsr.kernels.distance import near_scratch, search_surface, set_search
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.nearest import seed_point
from hhsr.kernels.patch import BEST, BEST_T, ENOUGH, FAR, FOOT, TOLERANCE, distance_to, offer
from hhsr.kernels.seam import slide_from
from hhsr.kernels.spans import SPAN_SIZE, VAIN, close_spans, put_span, summit_of, tell_spans
from hhsr.kernels.tree import into_tree, out_of_tree
from hhsr.kernels.unmanaged import entry, managed, unmanaged

DEPTH = 0.88  # tolerances: a tenth is what the walk to the ends of a stretch may err
ROUGHLY = 6.0  # tolerances: as nearly as a foot is sought that is to lower a bound of the depth
NEAR = 0.5  # tolerances: a bound is lowered only by a point that is nearer by this
CLOSE = 0.85  # tolerances: as nearly as the distance is asked where a bound is highest; the rest closes spans beside
NEARER = 0.3  # tolerances: a point nearer by this than what was known leaves too little to close them: a search may end
AWAY = 4.0  # tolerances: so does one that is nearer by this where it was likely deepest
SAME = 1.0  # tolerances: where a search found so little, ways on from known points find nothing
WALKED = 0.12  # tolerances: deeper than what may lie outside between a walked end and the surface
FIRST_SUMMIT = 12  # parts: then it is asked where it is likely deepest, and at each twice as many
ROOM = 0.65  # tolerances: as nearly as the distance is asked there; what is left, and the slack, go to a moved segment
WORTH = 8  # open spans: fewer are parted in less time than it takes to follow a moved segment
SLACK = 0.1  # tolerances: as much as the walk of a moved segment may err
SPANS = 256  # parts of one segment's stretch inside


@unmanaged
def _offer_known(search, x, y, z):
    """Offer a surface point to a search about a point."""
    distance, t = distance_to(search, x, y, z)
    offer(search, distance, t, x, y, z)


@unmanaged
def _go_on(blob, ints, tab, ax, ay, az, bx, by, bz, below, search):
    """Offer two surface points, and go on from them, down and along seams, until one is nearer than `below`."""
    _offer_known(search, ax, ay, az)
    _offer_known(search, bx, by, bz)
    for way in range(2):
        x, y, z = (ax, ay, az) if way == 0 else (bx, by, bz)
        # A way down from a seam comes back to it, if the seam is a valley; it was gone along then.
        slid = slide_from(blob, ints, x, y, z, search)
        if search[BEST] < below:
            return
        descend_from(blob, ints, tab, x, y, z, not slid, search)
        if search[BEST] < below:
            return


@unmanaged
def lift(
    blob, ints, tab, spans, used, px, py, pz, dx, dy, dz, t, x, y, z, high, slack, ts, work, slots, pending
):  # fmt: skip
    """Take out of the spans what is no deeper than `high`, as far as one moved segment shows; return how many are left.

    The segment is moved the way from p(t) to a surface point, by `high` less the slack: where it then is outside, the
    surface is no farther than it was moved. Slack: as much as the walk may err. Not asked where few spans are
    open.
    """
    vx, vy, vz = x - (px + t * dx), y - (py + t * dy), z - (pz + t * dz)
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    low, top, open_spans = np.inf, -np.inf, 0
    for s in range(used):
        if spans[s, 8] > high:
            low, top, open_spans = min(low, spans[s, 0]), max(top, spans[s, 4]), open_spans + 1
    if open_spans < WORTH or not (low < top and length > slack and high > slack):
        return used
    share = (high - slack) / length
    vx, vy, vz = px + share * vx, py + share * vy, pz + share * vz
    inside, count = follow_segment(
        blob, ints, tab, np.int64(0), vx + low * dx, vy + low * dy, vz + low * dz, vx + top * dx, vy + top * dy,
        vz + top * dz, 0.5 * slack, 0.5 * slack, np.bool_(False), ts, work, slots, pending,
    )  # fmt: skip
    if count > ts.shape[0]:
        return used
    begin = low
    for k in range(count + 1):
        end = low + ts[k] * (top - low) if k < count else top
        if not inside:
            used = close_spans(spans, used, high, px, py, pz, dx, dy, dz, begin, end)
        inside, begin = not inside, end
    return used


@unmanaged
def deepest(
    blob, ints, tab, px, py, pz, dx, dy, dz, t0, t1, on0, on1, tolerance, floor, out,
    search, local, nodes, keys, corners, spare, rects, spans, lifted, work, slots, pending,
):  # fmt: skip
    """Return an upper bound of the depth on [t0, t1] where p + t·d is inside, at most `tolerance` above the truth.

    Or above `floor`, a depth already known: no more than that need be proven below it. Any surface point bounds the
    depth at every t by its distance. So intervals between two t are bounded by the surface points found at both, and
    parted where that bound is highest, by points found on the way down that nothing proves; only where these lower it
    no more is the true distance asked, as nearly as the bound leaves room for. on0, on1: the ends lie on the surface.
    out: best t and foot (4,).
    """
    near = NEAR * tolerance
    sure = 0.0  # a depth that is reached
    for k in range(2):
        t = t0 if k == 0 else t1
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        if not (on0 if k == 0 else on1):
            # Some surface point will do: if the bound is highest here, the true distance is asked below.
            set_search(search, x, y, z, 0.0, 0.0, 0.0, ROUGHLY * tolerance)
            seed_point(blob, ints, tab, search)
            if search[BEST] == FAR:
                search_surface(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, np.bool_(True))
            onto_surface(blob, ints, search)
            x, y, z = search[FOOT], search[FOOT + 1], search[FOOT + 2]
        o = 4 * k
        spans[0, o], spans[0, o + 1], spans[0, o + 2], spans[0, o + 3] = t, x, y, z
    put_span(
        spans, 0, px, py, pz, dx, dy, dz, t0, spans[0, 1], spans[0, 2], spans[0, 3], t1, spans[0, 5], spans[0, 6],
        spans[0, 7],
    )  # fmt: skip
    spans[0, VAIN] = 0.0
    used, tight, value, closed, summit = 1, False, 0.0, 0.0, np.int64(FIRST_SUMMIT)
    for turn in range(2 * SPANS):
        s, value = 0, 0.0
        for k in range(used):
            if spans[k, 8] > value:
                s, value = k, spans[k, 8]
        t = spans[s, 9]
        if value <= max(sure + tolerance, floor) or used == spans.shape[0] or turn == 2 * SPANS - 1:
            break
        climbs, proven = turn == summit, False
        if climbs:
            summit *= 2
            s, t = summit_of(spans, used, px, py, pz, dx, dy, dz, s, t)
        a, ax, ay, az = spans[s, 0], spans[s, 1], spans[s, 2], spans[s, 3]
        b, bx, by, bz = spans[s, 4], spans[s, 5], spans[s, 6], spans[s, 7]
        set_search(search, px + t * dx, py + t * dy, pz + t * dz, 0.0, 0.0, 0.0, ROUGHLY * tolerance)
        vain = spans[s, VAIN] != 0.0  # a seed was, where this span was parted: the ends' points come first
        if a < t < b and not vain:
            seed_point(blob, ints, tab, search)
            vain = search[BEST] >= value
        known = search[BEST] < value - near and not climbs
        if climbs or (not known and tight):
            _offer_known(search, ax, ay, az)
            _offer_known(search, bx, by, bz)
        elif not known:
            _go_on(blob, ints, tab, ax, ay, az, bx, by, bz, value - near, search)
            known = search[BEST] < value - near
            if not known and a < t < b and spans[s, VAIN] != 0.0:
                seed_point(blob, ints, tab, search)
                known = search[BEST] < value - near
                vain = not known
        if not known:
            # Nothing nearer is known: what is the true distance there?
            before = search[BEST]
            room = ROOM * tolerance if climbs else CLOSE * tolerance - max(value - before, 0.0)
            # A place where it is less deep than the bound says is not the deepest: what is nearer there will do.
            search[TOLERANCE], search[ENOUGH] = room, before - (AWAY if climbs else NEARER) * tolerance
            proven = search_surface(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, np.bool_(True))
            tight = before - search[BEST] < SAME * tolerance
            if proven and search[BEST] - room > max(sure, WALKED * tolerance):
                sure = search[BEST] - room
                if search[BEST] > floor:
                    out[0], out[1], out[2], out[3] = t, search[FOOT], search[FOOT + 1], search[FOOT + 2]
        onto_surface(blob, ints, search)
        x, y, z = search[FOOT], search[FOOT + 1], search[FOOT + 2]
        spans[s, VAIN] = 1.0 if vain else 0.0
        if a < t < b:
            spans[used, VAIN] = spans[s, VAIN]
            put_span(spans, s, px, py, pz, dx, dy, dz, a, ax, ay, az, t, x, y, z)
            put_span(spans, used, px, py, pz, dx, dy, dz, t, x, y, z, b, bx, by, bz)
            used += 1
        elif t <= a:
            put_span(spans, s, px, py, pz, dx, dy, dz, a, x, y, z, b, bx, by, bz)
        else:
            put_span(spans, s, px, py, pz, dx, dy, dz, a, ax, ay, az, b, x, y, z)
        tell_spans(spans, used, px, py, pz, dx, dy, dz, x, y, z)
        if climbs and proven:
            # `sure` only rises, so that what is closed now is near enough at the end.
            closed = max(sure + tolerance, floor)
            used = lift(
                blob, ints, tab, spans, used, px, py, pz, dx, dy, dz, t, x, y, z, closed, SLACK * tolerance, lifted,
                work, slots, pending,
            )  # fmt: skip
    return max(floor, value, closed)


@unmanaged
def _longest_stretch(ts, count, inside):
    """Return which of the stretches that `count` crossings part a segment into is the longest inside."""
    longest, length, begin = 0, -1.0, 0.0
    for k in range(min(count, ts.shape[0]) + 1):
        end = ts[k] if k < count else 1.0
        if inside and end - begin > length:
            longest, length = k, end - begin
        inside, begin = not inside, end
    return longest


@unmanaged
def _clearance(
    blob, ints, tab, px, py, pz, ex, ey, ez, tolerance, ts, out, search, local, nodes, keys, corners, spare, rects,
    spans, lifted, work, slots, pending,
):  # fmt: skip
    """Return the clearance of a segment of the tree's frame. out: (4,) where along it, and the surface point."""
    dx, dy, dz = ex - px, ey - py, ez - pz
    inside, count = follow_segment(
        blob, ints, tab, np.int64(0), px, py, pz, ex, ey, ez, 0.1 * tolerance, 0.1 * tolerance, np.bool_(False), ts,
        work, slots, pending,
    )  # fmt: skip
    if not inside and count == 0:
        set_search(search, px, py, pz, dx, dy, dz, tolerance)
        search_surface(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, np.bool_(False))
        out[0], out[1], out[2], out[3] = search[BEST_T], search[FOOT], search[FOOT + 1], search[FOOT + 2]
        return search[BEST] - search[TOLERANCE]
    out[0], out[1], out[2], out[3] = 0.0, np.nan, np.nan, np.nan
    # The longest stretch inside first: most others are no deeper by their ends alone.
    deep, longest = 0.0, _longest_stretch(ts, count, inside)
    for others in range(2):
        begin, within = 0.0, inside
        for k in range(min(count, ts.shape[0]) + 1):
            end = ts[k] if k < count else 1.0
            if within and end >= begin and (k != longest) == (others == 1):
                deep = max(
                    deep,
                    deepest(
                        blob, ints, tab, px, py, pz, dx, dy, dz, begin, end, k > 0, k < count, DEPTH * tolerance, deep,
                        out, search, local, nodes, keys, corners, spare, rects, spans, lifted, work, slots, pending,
                    ),
                )  # fmt: skip
            within, begin = not within, end
    return -deep - 0.1 * tolerance


@managed
def _clearance_scratch():
    """Return (ts, out, spans, lifted)."""
    return np.empty(512), np.empty(4), np.empty((SPANS, SPAN_SIZE)), np.empty(64)


@njit(cache=True, error_model="numpy")
def clearance_one(blob, ax, ay, az, bx, by, bz, tolerance):
    """Return the clearance of the axis of one LPS segment (no radius): NaN where not finite."""
    if not math.isfinite(ax + ay + az + bx + by + bz):
        return np.nan
    ints, tab = integers(blob), tables(blob)
    search, local, nodes, keys, corners, spare, rects = near_scratch()
    work, slots, pending = scratch()
    ts, out, spans, lifted = _clearance_scratch()
    px, py, pz = into_tree(blob, ints, ax, ay, az)
    ex, ey, ez = into_tree(blob, ints, bx, by, bz)
    return _clearance(
        blob, ints, tab, px, py, pz, ex, ey, ez, tolerance, ts, out, search, local, nodes, keys, corners, spare, rects,
        spans, lifted, work, slots, pending,
    )  # fmt: skip


@entry
def clearance_many(blob, starts, ends, order, tolerance, value, t, foot):
    """Fill (n,) clearance of the axes of LPS segments (m, 3) (no radius), (n,) where along it, (n, 3) surface points.

    order: (m,) the row of the answers that each is for. truth − tolerance ≤ value ≤ truth; NaN where not finite.
    Returns how many are not finite.
    """
    ints, tab = integers(blob), tables(blob)
    search, local, nodes, keys, corners, spare, rects = near_scratch()
    work, slots, pending = scratch()
    ts, out, spans, lifted = _clearance_scratch()
    bad = 0
    for row in range(starts.shape[0]):
        i = order[row]
        ok = True
        for k in range(3):
            ok = ok and math.isfinite(starts[row, k]) and math.isfinite(ends[row, k])
        if not ok:
            value[i], t[i] = np.nan, np.nan
            foot[i, 0], foot[i, 1], foot[i, 2] = np.nan, np.nan, np.nan
            bad += 1
            continue
        px, py, pz = into_tree(blob, ints, starts[row, 0], starts[row, 1], starts[row, 2])
        ex, ey, ez = into_tree(blob, ints, ends[row, 0], ends[row, 1], ends[row, 2])
        value[i] = _clearance(
            blob, ints, tab, px, py, pz, ex, ey, ez, tolerance, ts, out, search, local, nodes, keys, corners, spare,
            rects, spans, lifted, work, slots, pending,
        )  # fmt: skip
        t[i] = out[0]
        foot[i, 0], foot[i, 1], foot[i, 2] = out_of_tree(blob, ints, out[1], out[2], out[3])
    return bad
