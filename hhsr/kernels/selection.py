"""Sparse rows of the dictionary of scale-field centres, and small triangular systems (DESIGN §3)."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.sphere_rbf import wendland_gaussian


@njit(cache=True, nogil=True)
def _cell_of(x, y, z, edge):
    """Return the cell of a cube map, `edge` cells along each edge, that a direction lies in."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, a, b = (0 if x >= 0.0 else 1), y / ax, z / ax
    elif ay >= az:
        face, a, b = (2 if y >= 0.0 else 3), x / ay, z / ay
    else:
        face, a, b = (4 if z >= 0.0 else 5), x / az, y / az
    i = min(int(0.5 * edge * (1.0 + a)), edge - 1)
    j = min(int(0.5 * edge * (1.0 + b)), edge - 1)
    return (face * edge + i) * edge + j


@njit(cache=True, nogil=True)
def atoms_of_cells(centres, starts, extents, edge):
    """Return the compressed rows of which atoms may see some direction of each of 6 · edge² cells of a cube map.

    centres: (M, 3) Fibonacci grids, z falling within a level. starts: (levels + 1,) first atom of each level.
    extents: (levels,) 1 − cos σ. Atoms ascend within a cell.
    """
    cells = 6 * edge * edge
    pointer = np.zeros(cells + 1, np.int64)
    index = np.empty(0, np.int32)
    corner = np.empty(3)
    for write in range(2):
        if write == 1:
            index = np.empty(pointer[cells], np.int32)
        at = 0
        for cell in range(cells):
            face, i, j = cell // (edge * edge), cell // edge % edge, cell % edge
            major = 1.0 if face % 2 == 0 else -1.0
            axis = face // 2
            a, b = (i + 0.5) * 2.0 / edge - 1.0, (j + 0.5) * 2.0 / edge - 1.0
            length = math.sqrt(1.0 + a * a + b * b)
            corner[axis], corner[1 if axis == 0 else 0], corner[1 if axis == 2 else 2] = major, a, b
            x, y, z = corner[0] / length, corner[1] / length, corner[2] / length
            # no direction of the cell lies farther from its middle than this
            half = math.sqrt(2.0) / edge
            around = half / max(length - half, 0.2)
            polar = math.acos(min(max(z, -1.0), 1.0))
            for level in range(extents.shape[0]):
                first, count = starts[level], starts[level + 1] - starts[level]
                support = math.acos(max(1.0 - extents[level], -1.0)) + around
                least = -2.0 if support >= math.pi else math.cos(support)
                top = 1.0 if polar <= support else math.cos(polar - support)
                bottom = -1.0 if polar + support >= math.pi else math.cos(polar + support)
                low = max(math.floor(0.5 * (1.0 - top) * count - 0.5), 0)
                high = min(math.ceil(0.5 * (1.0 - bottom) * count - 0.5), count - 1)
                for k in range(first + low, first + high + 1):
                    if x * centres[k, 0] + y * centres[k, 1] + z * centres[k, 2] >= least:
                        if write == 1:
                            index[at] = k
                        at += 1
            pointer[cell + 1] = at
    return pointer, index


@njit(cache=True, nogil=True)
def dictionary_rows(directions, centres, inverse_extents, edge, cell_pointer, cell_atoms):
    """Return (n + 1,) row starts, (nnz,) atoms, (nnz,) λ in single precision: which atoms see which unit direction.

    inverse_extents: (M,) 1 / (1 − cos σ). edge, cell_pointer, cell_atoms: see `atoms_of_cells`.
    """
    n = directions.shape[0]
    room = 0
    cells = np.empty(n, np.int64)
    for i in range(n):
        cells[i] = _cell_of(directions[i, 0], directions[i, 1], directions[i, 2], edge)
        room += cell_pointer[cells[i] + 1] - cell_pointer[cells[i]]
    pointer = np.zeros(n + 1, np.int64)
    index, value = np.empty(room, np.int32), np.empty(room, np.float32)
    at = 0
    for i in range(n):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        for k in range(cell_pointer[cells[i]], cell_pointer[cells[i] + 1]):
            j = cell_atoms[k]
            h = (1.0 - (x * centres[j, 0] + y * centres[j, 1] + z * centres[j, 2])) * inverse_extents[j]
            if h < 1.0:
                index[at] = j
                value[at] = wendland_gaussian(h)
                at += 1
        pointer[i + 1] = at
    return pointer, index[:at], value[:at]


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
    values = np.empty(index.shape[0], value.dtype)
    for i in range(pointer.shape[0] - 1):
        for k in range(pointer[i], pointer[i + 1]):
            j = index[k]
            rows[fill[j]] = i
            values[fill[j]] = value[k]
            fill[j] += 1
    return starts, rows, values


@njit(cache=True, nogil=True)
def back_substituted(triangle, right, count):
    """Return (count,) w of L[:count, :count]ᵀ w = right[:count]."""
    w = right[:count].copy()
    for a in range(count - 1, -1, -1):
        w[a] /= triangle[a, a]
        for b in range(a):
            w[b] -= triangle[a, b] * w[a]
    return w


@njit(cache=True, nogil=True, fastmath={"contract"})
def upper_factor(matrix):
    """Return U, zero below its diagonal, with UᵀU = a symmetric positive definite matrix (n, n).

    By rows of U, four earlier rows at a time: no sum runs along a row, so the processor takes several columns at once,
    always in the same order of sums.
    """
    n = matrix.shape[0]
    upper = np.zeros((n, n))
    for a in range(n):
        row = upper[a]
        row[a:] = matrix[a, a:]
        for k in range(0, a - 3, 4):
            first, second, third, fourth = upper[k], upper[k + 1], upper[k + 2], upper[k + 3]
            p, q, r, s = first[a], second[a], third[a], fourth[a]
            for b in range(a, n):
                row[b] -= p * first[b] + q * second[b] + r * third[b] + s * fourth[b]
        for k in range(a - a % 4, a):
            line = upper[k]
            factor = line[a]
            for b in range(a, n):
                row[b] -= factor * line[b]
        pivot = math.sqrt(max(row[a], 1e-300))
        row[a] = pivot
        for b in range(a + 1, n):
            row[b] /= pivot
    return upper


@njit(cache=True, nogil=True)
def solve_upper(upper, right):
    """Return x of UᵀU x = right."""
    n = right.shape[0]
    x = right.copy()
    for a in range(n):
        x[a] /= upper[a, a]
        for b in range(a + 1, n):
            x[b] -= upper[a, b] * x[a]
    for a in range(n - 1, -1, -1):
        total = x[a]
        for k in range(a + 1, n):
            total -= upper[a, k] * x[k]
        x[a] = total / upper[a, a]
    return x


@njit(cache=True, nogil=True)
def solve_normal(matrix, right):
    """Return the solution of a symmetric positive definite system by Cholesky, always in the same order of sums."""
    return solve_upper(upper_factor(matrix), right)


@njit(cache=True, nogil=True, fastmath={"contract"})
def drop_costs(matrix, right):
    """Return (k,) by how much a least sum of squares rises when one unknown is dropped and the others are fitted again.

    matrix (k, k), right (k,): its normal equations. The rise is w_j² / (G⁻¹)_jj.
    """
    k = right.shape[0]
    upper = upper_factor(matrix)
    weights = solve_upper(upper, right)
    inverse = np.zeros((k, k))  # of Uᵀ, row by row
    for a in range(k):
        row = inverse[a]
        for c in range(a):
            factor = upper[c, a]
            line = inverse[c]
            for b in range(c + 1):
                row[b] -= factor * line[b]
        for b in range(a):
            row[b] /= upper[a, a]
        row[a] = 1.0 / upper[a, a]
    total = np.zeros(k)
    for a in range(k):
        for b in range(a + 1):
            total[b] += inverse[a, b] * inverse[a, b]
    return weights * weights / total
