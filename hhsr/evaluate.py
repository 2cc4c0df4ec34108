"""From records to the plain arrays that kernels take, and the exact radii of a leaf and of a contour."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hhsr.kernels.leaf import contour_radii, leaf_radii
from hhsr.kernels.spline import clamped_coefficients, periodic_coefficients
from hhsr.model import Contour, FloatArray, ModelLeaf

CONTOUR_SUPPORT = 2.5


class LeafArrays(NamedTuple):
    """What the leaf kernels take, in the order in which they take it."""

    half_axes: FloatArray
    azimuth: FloatArray
    elevation: FloatArray
    centres: FloatArray
    inverse_extents: FloatArray
    weights: FloatArray


class ContourArrays(NamedTuple):
    """What the contour kernels take, in the order in which they take it."""

    half_axes: FloatArray
    angle: FloatArray
    centres: FloatArray
    inverse_extent: float
    weights: FloatArray


def leaf_arrays(leaf: ModelLeaf) -> LeafArrays:
    """Return the kernel arrays of a leaf: spline coefficients instead of knots, unit centres instead of indices."""
    base, scale = leaf.superquadric, leaf.scale_field
    index = scale.index
    return LeafArrays(
        np.array(base.half_axes),
        periodic_coefficients(base.azimuth_logits),
        clamped_coefficients(base.elevation_logits),
        np.ascontiguousarray(scale.grid.centres[index]) if index.size else np.zeros((0, 3)),
        1.0 / scale.grid.extents[index] if index.size else np.zeros(0),
        np.array(scale.weights),
    )


def contour_arrays(contour: Contour) -> ContourArrays:
    """Return the kernel arrays of a contour; its k centres are uniform, support 2.5 spacings, at most π."""
    count = contour.weights.size
    alpha = -math.pi + 2.0 * math.pi * np.arange(count) / max(count, 1)
    support = min(CONTOUR_SUPPORT * 2.0 * math.pi / max(count, 1), math.pi)
    return ContourArrays(
        np.array(contour.half_axes),
        periodic_coefficients(contour.logits),
        np.ascontiguousarray(np.stack([np.cos(alpha), np.sin(alpha)], axis=1)),
        1.0 / (1.0 - math.cos(support)),
        np.array(contour.weights),
    )


def leaf_radius(leaf: ModelLeaf, directions: ArrayLike) -> FloatArray:
    """Return the radius ρ (mm) of a leaf for (n, 3) directions in the leaf's frame, of any length > 0."""
    radii: FloatArray = leaf_radii(np.ascontiguousarray(directions, dtype=np.float64), *leaf_arrays(leaf))
    return radii


def contour_radius(contour: Contour, angles: ArrayLike) -> FloatArray:
    """Return the radius (mm) of a contour for (n,) in-plane angles (rad) about its centre."""
    radii: FloatArray = contour_radii(np.ascontiguousarray(angles, dtype=np.float64), *contour_arrays(contour))
    return radii
