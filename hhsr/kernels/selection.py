"""Greedy choice of scale-field centres: sparse rows of the dictionary, orthogonal least squares (DESIGN §3)."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.sphere_rbf import wendland_gaussian


@njit(cache=True, nogil=True)
def _row_of_dictionary(ux, uy, uz, centres, starts, extents, index, value, at):
    """Write the atoms that see a unit direction, ascending, from position `at` on; return the position after them.

    centres: (M, 3) Fibonacci grids, z falling within a level. starts: (levels + 1,) first atom of each level.
    extents: (levels,) 1 − cos σ. Writes nothing where the arrays are too short, but counts on.
    """
    room = index.shape[0]
    polar = math.acos(min(max(uz, -1.0), 1.0))
    for level in range(extents.shape[0]):
        first, count = starts[level], starts[level + 1] - starts[level]
        extent = extents[level]
        support = math.acos(max(1.0 - extent, -1.0))
        top = 1.0 if polar <= support else math.cos(polar - support)
        bottom = -1.0 if polar + support >= math.pi else math.cos(polar + support)
        low = max(math.floor(0.5 * (1.0 - top) * count - 0.5), 0)
        high = min(math.ceil(0.5 * (1.0 - bottom) * count - 0.5), count - 1)
        for j in range(first + low, first + high + 1):
            h = (1.0 - (ux * centres[j, 0] + uy * centres[j, 1] + uz * centres[j, 2])) / extent
            if h < 1.0:
                if at < room:
                    index[at] = j
                    value[at] = wendland_gaussian(h)
                at += 1
    return at


@njit(cache=True, nogil=True)
def dictionary_rows(directions, centres, starts, extents):
    """Return (n + 1,) row starts, (nnz,) atoms, (nnz,) λ: which atoms of the dictionary see which unit direction."""
    n = directions.shape[0]
    pointer = np.zeros(n + 1, np.int64)
    room = 64 * n * max(extents.shape[0], 1)
    index = np.empty(room, np.int32)
    value = np.empty(room)
    at = 0
    for i in range(n):
        at = _row_of_dictionary(
            directions[i, 0], directions[i, 1], directions[i, 2], centres, starts, extents, index, value, at
        )
        if at > room:
            bigger_index = np.empty(2 * at, np.int32)
            bigger_value = np.empty(2 * at)
            bigger_index[: pointer[i]] = index[: pointer[i]]
            bigger_value[: pointer[i]] = value[: pointer[i]]
            index, value, room = bigger_index, bigger_value, 2 * at
            at = _row_of_dictionary(
                directions[i, 0], directions[i, 1], directions[i, 2], centres, starts, extents, index, value, pointer[i]
            )
        pointer[i + 1] = at
    return pointer, index[:at].copy(), value[:at].copy()


@njit(cache=True, nogil=True)
def transposed(pointer, index, value, columns):
    """Return the compressed columns of compressed rows: (columns + 1,) starts, (nnz,) rows ascending, (nnz,) values."""
    starts = np.zeros(columns + 1, np.int64)
    for j in index:
        starts[j + 1] += 1
    for j in range(columns):
        starts[j + 1] += starts[j]
    fill = starts[:-1].copy()
    rows = np.empty(index.shape[0], np.int32)
    values = np.empty(index.shape[0])
    for i in range(pointer.shape[0] - 1):
        for k in range(pointer[i], pointer[i + 1]):
            j = index[k]
            rows[fill[j]] = i
            values[fill[j]] = value[k]
            fill[j] += 1
    return starts, rows, values


@njit(cache=True, nogil=True)
def orthogonal_selection(pointer, index, value, scale, target, columns, count, ridge, held):
    """Choose atoms one by one, each the one that lowers Σ (scale_i · (A w)_i − target_i)² + ridge·|w|² the most.

    Pivoted Cholesky of the normal equations, whose columns are formed only for the atoms chosen. It is held in single
    precision, which chooses the same atoms in a third of the time; the weights are solved again in double.

    pointer, index, value: rows of A, compressed. scale, target: (n,). count: atoms at most.
    ridge: in units of the normal matrix's mean diagonal. held: atoms that are chosen before any other, in this order.
    Returns (k,) atoms in order, (k,) falls of the sum of squares, (k, k) lower triangle L of the chosen atoms' normal
    matrix and (k,) y with L y = right side, so that the weights of the first m solve L[:m, :m]ᵀ w = y[:m].
    """
    starts, rows, values = transposed(pointer, index, value, columns)
    diagonal = np.zeros(columns)
    pull = np.zeros(columns)
    for j in range(columns):
        for k in range(starts[j], starts[j + 1]):
            i = rows[k]
            a = values[k] * scale[i]
            diagonal[j] += a * a
            pull[j] += a * target[i]
    seen = 0
    total = 0.0
    for j in range(columns):
        if diagonal[j] > 0.0:
            seen += 1
            total += diagonal[j]
    count = min(count, seen)
    floor = ridge * total / max(seen, 1)
    full = diagonal + floor
    rest = full.copy()
    basis = np.zeros((count, columns), np.float32)
    chosen = np.empty(count, np.int64)
    gains = np.empty(count)
    right = np.empty(count)
    column = np.empty(columns)
    for step in range(count):
        best, best_gain = -1, 0.0
        if step < held.shape[0]:
            best = held[step]
            rest[best] = max(rest[best], 1e-6 * full[best])
            best_gain = pull[best] * pull[best] / rest[best]
        for j in range(columns if best < 0 else 0):
            if rest[j] > 1e-3 * full[j] and diagonal[j] > 1e-6 * floor:
                gain = pull[j] * pull[j] / rest[j]
                if gain > best_gain:
                    best, best_gain = j, gain
        if best < 0:
            return _finish(chosen, gains, basis, right, step)
        column[:] = 0.0
        for k in range(starts[best], starts[best + 1]):
            i = rows[k]
            a = values[k] * scale[i] * scale[i]
            for m in range(pointer[i], pointer[i + 1]):
                column[index[m]] += a * value[m]
        column[best] += floor
        for t in range(step):
            factor = basis[t, best]
            line = basis[t]
            for j in range(columns):
                column[j] -= factor * line[j]
        pivot = math.sqrt(rest[best])
        y = pull[best] / pivot
        for j in range(columns):
            entry = column[j] / pivot
            basis[step, j] = entry
            rest[j] -= entry * entry
            pull[j] -= entry * y
        rest[best] = 0.0
        pull[best] = 0.0
        basis[step, best] = pivot
        chosen[step], gains[step], right[step] = best, best_gain, y
    return _finish(chosen, gains, basis, right, count)


@njit(cache=True, nogil=True)
def _finish(chosen, gains, basis, right, count):
    """Return the outcome of a selection of `count` atoms, with its triangle gathered."""
    triangle = np.zeros((count, count))
    for a in range(count):
        for b in range(a + 1):
            triangle[a, b] = basis[b, chosen[a]]
    return chosen[:count].copy(), gains[:count].copy(), triangle, right[:count].copy()


@njit(cache=True, nogil=True)
def back_substituted(triangle, right, count):
    """Return (count,) w of L[:count, :count]ᵀ w = right[:count]."""
    w = right[:count].copy()
    for a in range(count - 1, -1, -1):
        for b in range(a + 1, count):
            w[a] -= triangle[b, a] * w[b]
        w[a] /= triangle[a, a]
    return w


@njit(cache=True, nogil=True)
def drop_costs(triangle, right):
    """Return (k,) by how much the sum of squares rises when one chosen atom is dropped and the others are fitted again.

    w_j² / (G⁻¹)_jj for the normal matrix G = L Lᵀ.
    """
    k = right.shape[0]
    weights = back_substituted(triangle, right, k)
    inverse = np.zeros((k, k))
    for a in range(k):
        inverse[a, a] = 1.0 / triangle[a, a]
        for b in range(a):
            total = 0.0
            for c in range(b, a):
                total += triangle[a, c] * inverse[c, b]
            inverse[a, b] = -total / triangle[a, a]
    costs = np.empty(k)
    for b in range(k):
        total = 0.0
        for a in range(b, k):
            total += inverse[a, b] * inverse[a, b]
        costs[b] = weights[b] * weights[b] / total
    return costs


@njit(cache=True, nogil=True)
def solve_normal(matrix, right):
    """Return the solution of a symmetric positive definite system by Cholesky, always in the same order of sums."""
    n = right.shape[0]
    lower = matrix.copy()
    x = right.copy()
    for a in range(n):
        for b in range(a + 1):
            total = lower[a, b]
            for k in range(b):
                total -= lower[a, k] * lower[b, k]
            if a == b:
                lower[a, a] = math.sqrt(max(total, 1e-300))
            else:
                lower[a, b] = total / lower[b, b]
        for k in range(a):
            x[a] -= lower[a, k] * x[k]
        x[a] /= lower[a, a]
    for a in range(n - 1, -1, -1):
        for k in range(a + 1, n):
            x[a] -= lower[k, a] * x[k]
        x[a] /= lower[a, a]
    return x
