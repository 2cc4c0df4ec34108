"""Building a bounding-volume hierarchy over triangles by the surface-area heuristic (see `hhsr.kernels.triangles`)."""

import numpy as np
from numba import njit

BINS = 16
LEAF_SIZE = 4
STACK = 128
MAX_SKEW = 64


@njit(cache=True)
def build(vertices, faces):
    """Return (boxes, links, corners, order) of a tree split by the surface-area heuristic on 16 bins."""
    n = faces.shape[0]
    low, high, middle = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        for k in range(3):
            a, b, c = vertices[faces[i, 0], k], vertices[faces[i, 1], k], vertices[faces[i, 2], k]
            low[i, k] = min(a, b, c)
            high[i, k] = max(a, b, c)
            middle[i, k] = 0.5 * (low[i, k] + high[i, k])
    order = np.arange(n)
    boxes = np.empty((max(2 * n, 1), 6))
    links = np.zeros((max(2 * n, 1), 2), dtype=np.int64)
    links[0, 1] = n
    used = 1
    stack, levels = np.zeros(STACK, dtype=np.int64), np.zeros(STACK, dtype=np.int64)
    depth = 1 if n > 0 else 0
    while depth > 0:
        depth -= 1
        node, level = stack[depth], levels[depth]
        first, count = links[node, 0], links[node, 1]
        _fit_box(boxes, node, order, first, count, low, high)
        if count <= LEAF_SIZE:
            continue
        # Below MAX_SKEW halves, whatever they cost: the depth, and so every search's stack, stays under STACK.
        left = _split(order, first, count, low, high, middle) if level < MAX_SKEW else 0
        if left == 0 or left == count:
            left = count // 2
        links[node, 0], links[node, 1] = used, 0
        links[used, 0], links[used, 1] = first, left
        links[used + 1, 0], links[used + 1, 1] = first + left, count - left
        # The smaller half is done first: the stack then holds at most log₂ n + 1 entries.
        small = 0 if left <= count - left else 1
        stack[depth] = used + 1 - small
        stack[depth + 1] = used + small
        levels[depth] = levels[depth + 1] = level + 1
        depth += 2
        used += 2
    corners = np.empty((n, 3, 3))
    for i in range(n):
        for j in range(3):
            for k in range(3):
                corners[i, j, k] = vertices[faces[order[i], j], k]
    return boxes[:used].copy(), links[:used].copy(), corners, order


@njit(cache=True)
def _fit_box(boxes, node, order, first, count, low, high):
    for k in range(3):
        boxes[node, k] = np.inf
        boxes[node, 3 + k] = -np.inf
    for i in range(first, first + count):
        face = order[i]
        for k in range(3):
            boxes[node, k] = min(boxes[node, k], low[face, k])
            boxes[node, 3 + k] = max(boxes[node, 3 + k], high[face, k])


@njit(cache=True)
def _split(order, first, count, low, high, middle):
    """Partition order[first : first + count] at the cheapest of 3 × 15 planes; return how many go left."""
    best_cost, best_axis, best_bin = np.inf, -1, 0
    best_low, best_step = 0.0, 1.0
    bin_count = np.zeros(BINS, dtype=np.int64)
    bin_low, bin_high = np.empty((BINS, 3)), np.empty((BINS, 3))
    area = np.empty(BINS)
    number = np.empty(BINS, dtype=np.int64)
    box_low, box_high = np.empty(3), np.empty(3)
    for axis in range(3):
        c0, c1 = np.inf, -np.inf
        for i in range(first, first + count):
            c0 = min(c0, middle[order[i], axis])
            c1 = max(c1, middle[order[i], axis])
        if not c1 > c0:
            continue
        step = (c1 - c0) / BINS
        if step == 0.0:
            continue
        bin_count[:] = 0
        bin_low[:, :] = np.inf
        bin_high[:, :] = -np.inf
        for i in range(first, first + count):
            face = order[i]
            b = min(int((middle[face, axis] - c0) / step), BINS - 1)
            bin_count[b] += 1
            for k in range(3):
                bin_low[b, k] = min(bin_low[b, k], low[face, k])
                bin_high[b, k] = max(bin_high[b, k], high[face, k])
        for side in range(2):
            box_low[:] = np.inf
            box_high[:] = -np.inf
            total = 0
            for s in range(BINS - 1):
                b = s if side == 0 else BINS - 1 - s
                total += bin_count[b]
                for k in range(3):
                    box_low[k] = min(box_low[k], bin_low[b, k])
                    box_high[k] = max(box_high[k], bin_high[b, k])
                dx, dy, dz = box_high[0] - box_low[0], box_high[1] - box_low[1], box_high[2] - box_low[2]
                half = dx * dy + dy * dz + dz * dx if total > 0 else 0.0
                if side == 0:
                    area[b], number[b] = half, total
                else:
                    cost = area[b - 1] * number[b - 1] + half * total
                    if number[b - 1] > 0 and total > 0 and cost < best_cost:
                        best_cost, best_axis, best_bin, best_low, best_step = cost, axis, b, c0, step
    if best_axis < 0:
        return 0
    i, j = first, first + count - 1
    while i <= j:
        if min(int((middle[order[i], best_axis] - best_low) / best_step), BINS - 1) < best_bin:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i - first
