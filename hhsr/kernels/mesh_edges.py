"""Numbering the edges of triangles in linear time (sorting keys took half of a tessellation's time)."""

import numpy as np
from numba import njit


@njit(cache=True)
def number_edges(faces, vertex_count):
    """Return (edges (e, 2) ascending pairs, of_face (m, 3) the numbers of a face's edges 01, 12, 20)."""
    m = faces.shape[0]
    start = np.zeros(vertex_count + 1, dtype=np.int64)
    for f in range(m):
        for k in range(3):
            start[min(faces[f, k], faces[f, (k + 1) % 3]) + 1] += 1
    for v in range(vertex_count):
        start[v + 1] += start[v]
    filled = np.zeros(vertex_count, dtype=np.int64)
    high, number = np.empty(3 * m, dtype=np.int64), np.empty(3 * m, dtype=np.int64)
    edges, of_face = np.empty((3 * m, 2), dtype=np.int64), np.empty((m, 3), dtype=np.int64)
    count = 0
    for f in range(m):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            if a > b:
                a, b = b, a
            found = -1
            for i in range(start[a], start[a] + filled[a]):
                if high[i] == b:
                    found = number[i]
                    break
            if found < 0:
                found = count
                i = start[a] + filled[a]
                high[i], number[i] = b, found
                edges[found, 0], edges[found, 1] = a, b
                filled[a] += 1
                count += 1
            of_face[f, k] = found
    return edges[:count].copy(), of_face
