"""Gauss-Newton on a leaf: its radii and their slopes for the chosen centres, and the normal equations (DESIGN §3)."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.sphere_rbf import wendland_gaussian
from hhsr.kernels.triangle_build import STACK
from hhsr.kernels.triangles import nearest_triangle


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
def ellipsoid_radii(half_axes, directions):
    """Return (n,) radii q of the ellipsoid of six half axes, a₊ a₋ b₊ b₋ c₊ c₋, in (n, 3) unit directions."""
    out = np.empty(directions.shape[0])
    for i in range(directions.shape[0]):
        total = 0.0
        for k in range(3):
            u = directions[i, k]
            x = u / half_axes[2 * k + (0 if u >= 0.0 else 1)]
            total += x * x
        out[i] = 1.0 / math.sqrt(total)
    return out


@njit(cache=True, nogil=True)
def axis_slopes(half_axes, directions, radii):
    """Return (n, 6) dq / d log a of an ellipsoid's radii q in (n, 3) unit directions."""
    out = np.zeros((directions.shape[0], 6))
    for i in range(directions.shape[0]):
        cubed = radii[i] * radii[i] * radii[i]
        for k in range(3):
            u = directions[i, k]
            at = 2 * k + (0 if u >= 0.0 else 1)
            x = u / half_axes[at]
            out[i, at] = cubed * x * x
    return out


@njit(cache=True, nogil=True)
def own_misses(
    boxes,
    links,
    corners,
    normals,
    offsets,
    centre,
    directions,
    radius,
    grazing,
    least,
    area,
    miss,
    slope,
    share,
    nearest,
):
    """Fill in the signed distances of a leaf's own points, within its region, to closed triangles.

    boxes, links, corners: see `hhsr.kernels.triangles`. normals, offsets: (k, 3), (k,) the region's planes.
    directions, radius: (n, 3), (n,) of the points, about the centre.
    grazing: least |slope|. least: nearer than this, the triangle's normal says where outwards is. area: what a point
    stands for at radius 1, in samples. miss, slope, share: (n,) see `hhsr.fitting.refine.Misses`; points outside the
    region are left as they are. nearest: (n,) a triangle that is probably near to each point (−1: the one found for the
    point before it: neighbours in order save half of the time); changed to the nearest one.
    """
    stack, keys = np.empty(STACK, np.int64), np.empty(STACK)
    hint = -1
    p, near, normal = np.empty(3), np.empty(3), np.empty(3)
    for i in range(radius.shape[0]):
        for k in range(3):
            p[k] = centre[k] + radius[i] * directions[i, k]
        held = True
        for j in range(offsets.shape[0]):
            if normals[j, 0] * p[0] + normals[j, 1] * p[1] + normals[j, 2] * p[2] < offsets[j]:
                held = False
        if not held:
            continue
        if nearest[i] >= 0:
            hint = nearest[i]
        hint, d2, v, w = nearest_triangle(boxes, links, corners, p[0], p[1], p[2], np.inf, hint, stack, keys)
        nearest[i] = hint
        a, b, c = corners[hint, 0], corners[hint, 1], corners[hint, 2]
        for k in range(3):
            i1, i2 = (k + 1) % 3, (k + 2) % 3
            near[k] = a[k] + v * (b[k] - a[k]) + w * (c[k] - a[k])
            normal[k] = (b[i1] - a[i1]) * (c[i2] - a[i2]) - (b[i2] - a[i2]) * (c[i1] - a[i1])
        long = max(math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2), 1e-300)
        height = 0.0
        for k in range(3):
            height += (p[k] - near[k]) * normal[k]
        side = -1.0 if height < 0.0 else 1.0
        distance = math.sqrt(d2)
        steep = 0.0
        for k in range(3):
            outward = side * (p[k] - near[k]) / distance if distance > least else normal[k] / long
            steep += outward * directions[i, k]
        if abs(steep) < grazing:
            steep = math.copysign(grazing, steep)
        miss[i] = side * distance
        slope[i] = steep
        share[i] = area * radius[i] ** 2 / abs(steep)


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
