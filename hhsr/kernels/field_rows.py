"""Rows of a scale field's least squares: each direction meets some twenty centres, whatever their number."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def sparse_rows(directions, centres, inverse_extents):
    """Return the kernel values λ(1 − u·c) > 0 row by row: offsets (n + 1,), centre indices (z,), values (z,)."""
    n, k = directions.shape[0], centres.shape[0]
    offsets = np.zeros(n + 1, np.int64)
    room = 32 * n + 1
    index, value = np.empty(room, np.int64), np.empty(room)
    filled = 0
    for i in range(n):
        for j in range(k):
            dot = directions[i, 0] * centres[j, 0] + directions[i, 1] * centres[j, 1] + directions[i, 2] * centres[j, 2]
            h = (1.0 - dot) * inverse_extents[j]
            if h < 1.0:
                if filled == room:
                    room *= 2
                    wider_index, wider_value = np.empty(room, np.int64), np.empty(room)
                    wider_index[:filled], wider_value[:filled] = index[:filled], value[:filled]
                    index, value = wider_index, wider_value
                index[filled] = j
                value[filled] = math.exp(-4.0 * h) * (1.0 - h) * (1.0 - h)
                filled += 1
        offsets[i + 1] = filled
    return offsets, index[:filled].copy(), value[:filled].copy()


@njit(cache=True)
def row_products(offsets, index, value, weights):
    """Return Λ w, (n,), of sparse rows and weights (k,)."""
    out = np.zeros(offsets.shape[0] - 1)
    for i in range(out.shape[0]):
        for a in range(offsets[i], offsets[i + 1]):
            out[i] += value[a] * weights[index[a]]
    return out


@njit(cache=True)
def add_normal_equations(offsets, index, value, row, target, gram, right):
    """Add Λᵀ diag(row) Λ to gram (k, k) and Λᵀ diag(row) target to right (k,); rows of weight 0 cost nothing."""
    for i in range(row.shape[0]):
        if row[i] == 0.0:
            continue
        for a in range(offsets[i], offsets[i + 1]):
            scaled = row[i] * value[a]
            right[index[a]] += scaled * target[i]
            for b in range(offsets[i], a + 1):
                gram[index[a], index[b]] += scaled * value[b]
    for i in range(gram.shape[0]):
        for j in range(i):
            gram[j, i] = gram[i, j]


@njit(cache=True)
def column_squares(offsets, index, value, count):
    """Return Σ λ² of each centre's column, (count,)."""
    out = np.zeros(count)
    for a in range(index.shape[0]):
        out[index[a]] += value[a] * value[a]
    return out
