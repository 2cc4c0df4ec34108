"""Slow twins of the queries: plain numpy and the formulas of DESIGN §1 and §2, nothing compiled in advance.

They share no code with the engine beyond the records of `hhsr.model`: splines are scipy's, parity by solid angles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from hhsr.model import (
    Contour,
    Cut,
    FloatArray,
    ModelLeaf,
    Node,
    RetainedPart,
    Superquadric,
    Tree,
    exponent_of_logit,
    rotation_matrix,
)

TABLE = 256


def exponents(base: Superquadric, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (ε1, ε2) at the elevation and azimuth of points (n, 3)."""
    ring = np.hypot(points[:, 0], points[:, 1])
    azimuth = np.where(ring > 0, np.arctan2(points[:, 1], points[:, 0]), 0.0)
    elevation = np.arctan2(points[:, 2], ring)
    return (
        exponent_of_logit(_clamped(base.elevation_logits, elevation / np.pi + 0.5)),
        exponent_of_logit(_periodic(base.azimuth_logits, azimuth / (2 * np.pi) + 0.5)),
    )


def _periodic(knots: FloatArray, share: FloatArray) -> FloatArray:
    if knots.size < 2:
        return np.full_like(share, knots[0] if knots.size else 0.0)
    at = np.linspace(0.0, 1.0, knots.size + 1)
    return CubicSpline(at, np.append(knots, knots[0]), bc_type="periodic")(share)


def _clamped(knots: FloatArray, share: FloatArray) -> FloatArray:
    if knots.size < 2:
        return np.full_like(share, knots[0] if knots.size else 0.0)
    return CubicSpline(np.linspace(0.0, 1.0, knots.size), knots, bc_type="clamped")(share)


def gaussian(distance: FloatArray, extent: FloatArray) -> FloatArray:
    """Return λ(d) = exp(−4h)(1 − h)², h = d/extent < 1, else 0."""
    h = distance / extent
    return np.where(h < 1.0, np.exp(-4.0 * h) * (1.0 - h) ** 2, 0.0)


def power_mean(x: FloatArray, y: FloatArray, exponent: FloatArray) -> FloatArray:
    """Return (x^(2/ε) + y^(2/ε))^(ε/2) for x, y ≥ 0."""
    large, small = np.maximum(x, y), np.minimum(x, y)
    with np.errstate(divide="ignore", invalid="ignore", under="ignore"):
        ratio = np.where(large > 0, small / large, 0.0)
        return large * (1.0 + ratio ** (2.0 / exponent)) ** (exponent / 2.0)


def leaf_implicit(leaf: ModelLeaf, points: FloatArray) -> FloatArray:
    """Return G at points (n, 3) of the tree's frame: Eq. 3, with the scale field capped at 0.95."""
    p = (points - leaf.centre) @ rotation_matrix(leaf.rotation)
    axes = leaf.superquadric.half_axes
    e1, e2 = exponents(leaf.superquadric, p)
    x, y, z = (np.abs(p[:, k]) / np.where(p[:, k] >= 0, axes[2 * k], axes[2 * k + 1]) for k in range(3))
    norm = power_mean(power_mean(x, y, e2), z, e1)
    length = np.sqrt((p * p).sum(axis=1))
    u = p / np.where(length > 0, length, 1.0)[:, None]
    field = leaf.scale_field
    s = np.zeros(len(p))
    if field.index.size:
        centres, extents = field.grid.centres[field.index], field.grid.extents[field.index]
        s = gaussian(1.0 - u @ centres.T, extents) @ field.weights
    return np.where(length > 0, norm + np.minimum(s, 0.95) - 1.0, -0.05)


def winding_inside(part: RetainedPart, points: FloatArray) -> NDArray[np.bool_]:
    """Return whether closed triangles hold points (n, 3): the sum of their solid angles (Van Oosterom 1983)."""
    inside = np.zeros(len(points), dtype=bool)
    for i, point in enumerate(points):
        a, b, c = (part.vertices[part.faces[:, k]] - point for k in range(3))
        la, lb, lc = (np.sqrt((v * v).sum(axis=1)) for v in (a, b, c))
        top = (a * np.cross(b, c)).sum(axis=1)
        bottom = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
        inside[i] = abs(np.arctan2(top, bottom).sum()) > np.pi  # half the solid angle: 2π inside
    return inside


def contour_radius(contour: Contour, angles: FloatArray) -> FloatArray:
    """Return the radius of a lobe's fitted contour at angles (n,)."""
    axes = contour.half_axes
    e = exponent_of_logit(_periodic(contour.logits, angles / (2 * np.pi) + 0.5))
    x = np.abs(np.cos(angles)) / np.where(np.cos(angles) >= 0, axes[0], axes[1])
    y = np.abs(np.sin(angles)) / np.where(np.sin(angles) >= 0, axes[2], axes[3])
    k = contour.weights.size
    s = np.zeros(len(angles))
    if k:
        centres = -np.pi + 2 * np.pi * np.arange(k) / k
        extent = 1.0 - np.cos(min(2.5 * 2 * np.pi / k, np.pi))
        s = gaussian(1.0 - np.cos(angles[:, None] - centres), np.full(k, extent)) @ contour.weights
    return (1.0 - np.minimum(s, 0.95)) / power_mean(x, y, e)


def contains(node: Node, points: FloatArray) -> NDArray[np.bool_]:
    """Return in(node, p) of DESIGN §2 for points (n, 3) of the tree's frame."""
    if isinstance(node, ModelLeaf):
        return leaf_implicit(node, points) <= 0.0
    if isinstance(node, RetainedPart):
        return winding_inside(node, points) if len(node.faces) else np.zeros(len(points), dtype=bool)
    height = points @ node.normal - node.offset
    slab, right = np.abs(height) < node.half_width, height >= 0
    inside = np.zeros(len(points), dtype=bool)
    if slab.any():
        inside[slab] = in_slab(node, points[slab])
    left = ~slab & ~right
    right = ~slab & right
    inside[left] = contains(node.left, points[left])
    inside[right] = contains(node.right, points[right])
    return inside


def in_slab(cut: Cut, points: FloatArray) -> NDArray[np.bool_]:
    """Return whether some lobe holds points (n, 3) of the slab."""
    e1, e2, n = cut.frame
    t = (points @ n - cut.offset) / (2 * cut.half_width) + 0.5
    inside = np.zeros(len(points), dtype=bool)
    for contour in cut.contours:
        u, v = points @ e1 - contour.centre[0], points @ e2 - contour.centre[1]
        angle = np.arctan2(v, u)
        ends = [section_radii(cut, contour, child, side) for child, side in ((cut.left, -1.0), (cut.right, 1.0))]
        share = (angle / (2 * np.pi) + 0.5) * TABLE
        low, high = (np.interp(share, np.arange(TABLE + 1), np.append(r, r[0])) for r in ends)
        middle = 2 * contour_radius(contour, angle) - (low + high) / 2
        r = (1 - t) ** 2 * low + 2 * t * (1 - t) * middle + t**2 * high
        inside |= (r > 0) & (np.hypot(u, v) <= r)
    return inside


def section_radii(cut: Cut, contour: Contour, child: Node, side: float, step: float = 1.0) -> FloatArray:
    """Return (256,) first exits of rays in the plane h = ±d from the lobe's centre, by steps and then bisection."""
    e1, e2, n = cut.frame
    centre = contour.centre[0] * e1 + contour.centre[1] * e2 + (cut.offset + side * cut.half_width) * n
    angles = -np.pi + 2 * np.pi * np.arange(TABLE) / TABLE
    rays = np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2
    if not contains(child, centre[None])[0]:
        return np.zeros(TABLE)
    reach = np.arange(step, 200.0, step)
    states = contains(child, (centre + reach[:, None, None] * rays).reshape(-1, 3)).reshape(len(reach), TABLE)
    low = reach[np.argmin(states, axis=0)] - step
    high = low + step
    for _ in range(40):
        middle = (low + high) / 2
        inside = contains(child, centre + middle[:, None] * rays)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return (low + high) / 2


def into_tree(tree: Tree, points: FloatArray) -> FloatArray:
    """Return LPS points (n, 3) in the tree's frame."""
    return (points - tree.pose[3:]) @ rotation_matrix(tree.pose[:3])


def shape_contains(tree: Tree, points: FloatArray) -> NDArray[np.bool_]:
    """Return whether the solid holds LPS points (n, 3)."""
    return contains(tree.root, into_tree(tree, points))
