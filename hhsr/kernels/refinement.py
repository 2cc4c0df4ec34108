"""Gauss-Newton on a leaf: its radii and their slopes for the chosen centres, and the normal equations (DESIGN §3)."""

import numpy as np
from numba import njit

from hhsr.kernels.sphere_rbf import wendland_gaussian


@njit(cache=True, nogil=True)
def chosen_rows(directions, centres, extents):
    """Return compressed rows of λ over k chosen centres: (n + 1,) starts, (nnz,) centre, (nnz,) λ."""
    n, k = directions.shape[0], centres.shape[0]
    pointer = np.zeros(n + 1, np.int64)
    for write in range(2):
        if write == 1:
            index = np.empty(pointer[n], np.int32)
            value = np.empty(pointer[n])
        at = 0
        for i in range(n):
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            for j in range(k):
                h = 1.0 - (x * centres[j, 0] + y * centres[j, 1] + z * centres[j, 2])
                if h < extents[j]:
                    if write == 1:
                        index[at] = j
                        value[at] = wendland_gaussian(h / extents[j])
                    at += 1
            pointer[i + 1] = at
    return pointer, index, value


@njit(cache=True, nogil=True)
def field_values(pointer, index, value, weights):
    """Return (n,) s = Σ_j w_j λ_ij of compressed rows."""
    n = pointer.shape[0] - 1
    out = np.zeros(n)
    for i in range(n):
        for m in range(pointer[i], pointer[i + 1]):
            out[i] += weights[index[m]] * value[m]
    return out


@njit(cache=True, nogil=True)
def normal_equations(pointer, index, value, slope, dense, miss, weight, count):
    """Return JᵀWJ and −JᵀW·miss for rows J = [slope_i · λ_i (sparse, `count` columns) | dense_i].

    slope, miss, weight: (n,). dense: (n, m). Rows of weight 0 are passed over.
    """
    extra = dense.shape[1]
    size = count + extra
    matrix = np.zeros((size, size))
    right = np.zeros(size)
    for i in range(miss.shape[0]):
        w = weight[i]
        if w == 0.0:
            continue
        first, last = pointer[i], pointer[i + 1]
        ws = w * slope[i]
        for m in range(first, last):
            a = ws * value[m]
            row = index[m]
            right[row] -= a * miss[i]
            a *= slope[i]
            for o in range(first, m + 1):
                matrix[row, index[o]] += a * value[o]
        for d in range(extra):
            wd = w * dense[i, d]
            right[count + d] -= wd * miss[i]
            wds = wd * slope[i]
            for m in range(first, last):
                matrix[count + d, index[m]] += wds * value[m]
            for o in range(d + 1):
                matrix[count + d, count + o] += wd * dense[i, o]
    for a in range(size):
        for b in range(a):
            matrix[b, a] = matrix[a, b]
    return matrix, right
