"""Plane sections of closed triangles, contour maps, and pairs of points that no convex part can hold (PAPER §3.1)."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def plane_segments(vertices, faces, heights, offset):
    """Return the segments where the plane heights = offset meets the triangles.

    vertices: (n, 3); faces: (m, 3); heights: (n,) of the vertices over some plane; a vertex on it counts as above.
    Returns points (k, 2, 3), keys (k, 2) of the mesh edges that the ends lie on, face (k,). On a closed mesh every key
    comes an even number of times, and ends of equal key are the same point to the bit.
    """
    count = 0
    for f in range(faces.shape[0]):
        up = 0
        for side in range(3):
            if heights[faces[f, side]] >= offset:
                up += 1
        if up == 1 or up == 2:
            count += 1
    points = np.empty((count, 2, 3))
    keys = np.empty((count, 2), np.int64)
    face = np.empty(count, np.int64)
    n = vertices.shape[0]
    k = 0
    for f in range(faces.shape[0]):
        up = 0
        for side in range(3):
            if heights[faces[f, side]] >= offset:
                up += 1
        if up == 0 or up == 3:
            continue
        end = 0
        for side in range(3):
            i, j = faces[f, side], faces[f, (side + 1) % 3]
            if (heights[i] >= offset) == (heights[j] >= offset):
                continue
            if i > j:
                i, j = j, i
            share = (offset - heights[i]) / (heights[j] - heights[i])
            for axis in range(3):
                points[k, end, axis] = vertices[i, axis] + share * (vertices[j, axis] - vertices[i, axis])
            keys[k, end] = i * n + j
            end += 1
        face[k] = f
        k += 1
    return points, keys, face


@njit(cache=True)
def chain_segments(keys):
    """Return the segment ends in walking order, and the offsets (chains + 1,) of each chain in it.

    keys: (k, 2). An end 2 s + side stands for the point where segment s is entered. Loops close on themselves; where
    the mesh is open a chain just ends.
    """
    count = keys.shape[0]
    flat = keys.copy().reshape(2 * count)
    order = np.argsort(flat, kind="mergesort")
    mate = np.full(2 * count, -1, np.int64)
    i = 0
    while i + 1 < 2 * count:
        if flat[order[i]] == flat[order[i + 1]]:
            mate[order[i]] = order[i + 1]
            mate[order[i + 1]] = order[i]
            i += 2
        else:
            i += 1
    walk = np.empty(count, np.int64)
    offsets = np.empty(count + 1, np.int64)
    seen = np.zeros(count, np.bool_)
    chains = 0
    filled = 0
    offsets[0] = 0
    for pass_ in range(2):
        for s in range(count):
            if seen[s]:
                continue
            # Open chains first, from their loose ends; what is left are loops.
            if pass_ == 0 and mate[2 * s] >= 0 and mate[2 * s + 1] >= 0:
                continue
            end = 2 * s if mate[2 * s] < 0 or pass_ == 1 else 2 * s + 1
            while end >= 0 and not seen[end >> 1]:
                seen[end >> 1] = True
                walk[filled] = end
                filled += 1
                end = mate[end ^ 1]
            chains += 1
            offsets[chains] = filled
    return walk, offsets[: chains + 1].copy()


@njit(cache=True)
def resample_chains(points, face, capped, walk, offsets, spacing):
    """Return points (m, 3) along the chains at most `spacing` apart, and their offsets, and which lie on a cap.

    capped: (faces,) bool. Equal steps along each chain, at least three; the step divides the chain's length.
    """
    chains = offsets.shape[0] - 1
    lengths = np.zeros(chains)
    for c in range(chains):
        for w in range(offsets[c], offsets[c + 1]):
            s = walk[w] >> 1
            lengths[c] += math.sqrt(
                (points[s, 1, 0] - points[s, 0, 0]) ** 2
                + (points[s, 1, 1] - points[s, 0, 1]) ** 2
                + (points[s, 1, 2] - points[s, 0, 2]) ** 2
            )
    starts = np.zeros(chains + 1, np.int64)
    for c in range(chains):
        starts[c + 1] = starts[c] + max(3, math.ceil(lengths[c] / spacing))
    out = np.empty((starts[chains], 3))
    on_cap = np.zeros(starts[chains], np.bool_)
    for c in range(chains):
        steps = starts[c + 1] - starts[c]
        step = lengths[c] / steps
        k = 0
        run = 0.0
        for w in range(offsets[c], offsets[c + 1]):
            s = walk[w] >> 1
            first = walk[w] & 1
            second = 1 - first
            piece = math.sqrt(
                (points[s, 1, 0] - points[s, 0, 0]) ** 2
                + (points[s, 1, 1] - points[s, 0, 1]) ** 2
                + (points[s, 1, 2] - points[s, 0, 2]) ** 2
            )
            while k < steps and (k * step <= run + piece or w == offsets[c + 1] - 1):
                share = (k * step - run) / piece if piece > 0.0 else 0.0
                share = min(max(share, 0.0), 1.0)
                for axis in range(3):
                    a = points[s, first, axis]
                    out[starts[c] + k, axis] = a + share * (points[s, second, axis] - a)
                on_cap[starts[c] + k] = capped[face[s]]
                k += 1
            run += piece
    return out, starts, on_cap


@njit(cache=True)
def contour_map(vertices, faces, capped, heights, offset, spacing):
    """Return the resampled section of one plane: points (m, 3), offsets of its chains, which points lie on a cap."""
    points, keys, face = plane_segments(vertices, faces, heights, offset)
    walk, offsets = chain_segments(keys)
    return resample_chains(points, face, capped, walk, offsets, spacing)


@njit(cache=True)
def nearest_between(points, starts):
    """Return the least squared distance (c, c) between chains, and the indices (c, c) of the nearest points.

    nearest[u, v] is the point of chain u that is nearest to chain v.
    """
    chains = starts.shape[0] - 1
    least = np.full((chains, chains), np.inf)
    nearest = np.full((chains, chains), -1, np.int64)
    for u in range(chains):
        for v in range(u + 1, chains):
            best = np.inf
            a = b = -1
            for i in range(starts[u], starts[u + 1]):
                for j in range(starts[v], starts[v + 1]):
                    d = (
                        (points[i, 0] - points[j, 0]) ** 2
                        + (points[i, 1] - points[j, 1]) ** 2
                        + (points[i, 2] - points[j, 2]) ** 2
                    )
                    if d < best:
                        best, a, b = d, i, j
            least[u, v] = least[v, u] = best
            nearest[u, v], nearest[v, u] = a, b
    return least, nearest


@njit(cache=True)
def merge_chains(least, threshold):
    """Return the connected component of each chain: chains that come within `threshold` are one. Labels from 0."""
    chains = least.shape[0]
    label = np.arange(chains)
    changed = True
    while changed:
        changed = False
        for u in range(chains):
            for v in range(chains):
                if least[u, v] <= threshold * threshold and label[v] != label[u]:
                    low = min(label[u], label[v])
                    label[u] = label[v] = low
                    changed = True
    names = np.full(chains, -1, np.int64)
    count = 0
    for u in range(chains):
        if names[label[u]] < 0:
            names[label[u]] = count
            count += 1
        label[u] = names[label[u]]
    return label, count


@njit(cache=True)
def _side(ax, ay, bx, by, cx, cy):
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


@njit(cache=True)
def passes_through(flat, starts, label, first, second, i, j):
    """Return whether the straight way from point i to point j crosses a component other than `first` and `second`.

    flat: (m, 2) in-plane coordinates. Such a component has neighbouring points on both sides of the way (PAPER §3.1).
    """
    ax, ay, bx, by = flat[i, 0], flat[i, 1], flat[j, 0], flat[j, 1]
    for c in range(starts.shape[0] - 1):
        if label[c] == first or label[c] == second:
            continue
        previous = starts[c + 1] - 1
        for k in range(starts[c], starts[c + 1]):
            px, py, qx, qy = flat[previous, 0], flat[previous, 1], flat[k, 0], flat[k, 1]
            if (_side(ax, ay, bx, by, px, py) > 0.0) != (_side(ax, ay, bx, by, qx, qy) > 0.0) and (
                _side(px, py, qx, qy, ax, ay) > 0.0
            ) != (_side(px, py, qx, qy, bx, by) > 0.0):
                return True
            previous = k
    return False


@njit(cache=True)
def section_pairs(vertices, faces, capped, heights, offset, e1, e2, threshold):
    """Return the mutex pairs (k, 2, 3) of one plane: the nearest points of each two components of its contour map.

    Points on caps are no surface of the shape: a pair that has one is left out.
    """
    points, starts, on_cap = contour_map(vertices, faces, capped, heights, offset, threshold / 3.0)
    chains = starts.shape[0] - 1
    if chains < 2:
        return np.empty((0, 2, 3))
    least, nearest = nearest_between(points, starts)
    label, count = merge_chains(least, threshold)
    flat = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        flat[i, 0] = points[i, 0] * e1[0] + points[i, 1] * e1[1] + points[i, 2] * e1[2]
        flat[i, 1] = points[i, 0] * e2[0] + points[i, 1] * e2[1] + points[i, 2] * e2[2]
    out = np.empty((count * (count - 1) // 2, 2, 3))
    found = 0
    for a in range(count):
        for b in range(a + 1, count):
            best = np.inf
            i = j = -1
            for u in range(chains):
                if label[u] != a:
                    continue
                for v in range(chains):
                    if label[v] == b and least[u, v] < best:
                        best, i, j = least[u, v], nearest[u, v], nearest[v, u]
            if on_cap[i] or on_cap[j] or passes_through(flat, starts, label, a, b, i, j):
                continue
            out[found, 0] = points[i]
            out[found, 1] = points[j]
            found += 1
    return out[:found].copy()


@njit(cache=True)
def stack_pairs(vertices, faces, capped, normals, frames1, frames2, spacing, threshold, limit):
    """Return all mutex pairs (k, 2, 3) and the direction (k,) that found each, over stacks of parallel planes.

    normals, frames1, frames2: (q, 3) directions and in-plane axes; spacing: mm between planes; limit: most pairs kept.
    """
    out = np.empty((limit, 2, 3))
    direction = np.empty(limit, np.int64)
    found = 0
    for q in range(normals.shape[0]):
        heights = np.empty(vertices.shape[0])
        for i in range(vertices.shape[0]):
            heights[i] = (
                vertices[i, 0] * normals[q, 0] + vertices[i, 1] * normals[q, 1] + vertices[i, 2] * normals[q, 2]
            )
        low, high = heights.min(), heights.max()
        planes = int((high - low) / spacing)
        first = low + 0.5 * ((high - low) - (planes - 1) * spacing)
        for p in range(planes):
            pairs = section_pairs(
                vertices, faces, capped, heights, first + p * spacing, frames1[q], frames2[q], threshold
            )
            for k in range(pairs.shape[0]):
                if found < limit:
                    out[found] = pairs[k]
                    direction[found] = q
                found += 1
    kept = min(found, limit)
    return out[:kept].copy(), direction[:kept].copy(), found


@njit(cache=True)
def loop_curvature(points, starts, on_cap, label, component, steps, length):
    """Return the largest turning (rad) per `length` (mm) over a component's chains; caps are left out.

    At each point: the angle between the chords `steps` points back and `steps` points ahead, over `length`.
    """
    largest = 0.0
    for c in range(starts.shape[0] - 1):
        if label[c] != component:
            continue
        n = starts[c + 1] - starts[c]
        if n < 2 * steps + 1:
            continue
        for k in range(n):
            near_cap = False
            for shift in range(-steps, steps + 1):
                near_cap = near_cap or on_cap[starts[c] + (k + shift) % n]
            if near_cap:
                continue
            a, b, d = starts[c] + (k - steps) % n, starts[c] + k, starts[c] + (k + steps) % n
            dot = uu = vv = 0.0
            for axis in range(3):
                u, v = points[b, axis] - points[a, axis], points[d, axis] - points[b, axis]
                dot += u * v
                uu += u * u
                vv += v * v
            if uu > 0.0 and vv > 0.0:
                turn = math.acos(min(max(dot / math.sqrt(uu * vv), -1.0), 1.0))
                largest = max(largest, turn / length)
    return largest


@njit(cache=True)
def pair_weights(vertices, faces, capped, pairs, normals, threshold):
    """Return the weight w (1/mm) of each pair (PAPER §3.1), (k,).

    p₂ goes through the pair, perpendicular to the plane that found it. Where its contour map joins the pair, w is the
    largest local curvature of the component that holds it; else 0.

    pairs: (k, 2, 3). normals: (k, 3) of the plane that found each.
    """
    weights = np.zeros(pairs.shape[0])
    heights = np.empty(vertices.shape[0])
    for k in range(pairs.shape[0]):
        dx, dy, dz = (
            pairs[k, 1, 0] - pairs[k, 0, 0],
            pairs[k, 1, 1] - pairs[k, 0, 1],
            pairs[k, 1, 2] - pairs[k, 0, 2],
        )
        nx = normals[k, 1] * dz - normals[k, 2] * dy
        ny = normals[k, 2] * dx - normals[k, 0] * dz
        nz = normals[k, 0] * dy - normals[k, 1] * dx
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        if size == 0.0:
            continue
        nx, ny, nz = nx / size, ny / size, nz / size
        for i in range(vertices.shape[0]):
            heights[i] = vertices[i, 0] * nx + vertices[i, 1] * ny + vertices[i, 2] * nz
        offset = pairs[k, 0, 0] * nx + pairs[k, 0, 1] * ny + pairs[k, 0, 2] * nz
        points, starts, on_cap = contour_map(vertices, faces, capped, heights, offset, threshold / 3.0)
        chains = starts.shape[0] - 1
        if chains == 0:
            continue
        least, _ = nearest_between(points, starts)
        label, _ = merge_chains(least, threshold)
        ends = np.full(2, -1, np.int64)
        for end in range(2):
            best = np.inf
            for c in range(chains):
                for i in range(starts[c], starts[c + 1]):
                    d = (
                        (points[i, 0] - pairs[k, end, 0]) ** 2
                        + (points[i, 1] - pairs[k, end, 1]) ** 2
                        + (points[i, 2] - pairs[k, end, 2]) ** 2
                    )
                    if d < best:
                        best = d
                        ends[end] = label[c]
        if ends[0] == ends[1]:
            weights[k] = loop_curvature(points, starts, on_cap, label, ends[0], 3, threshold)
    return weights
