"""A leaf's radius over directions, and its implicit value: the exact formulas that every bound encloses (DESIGN §1)."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.sphere_rbf import scale_on_circle, scale_on_sphere
from hhsr.kernels.superquadric import superellipse_norm, superquadric_norm

MAX_SCALE = 0.95


@njit(cache=True)
def leaf_value(x, y, z, half_axes, azimuth, elevation, centres, inverse_extents, weights):
    """Return G = |p|/q(p/|p|) + s(p/|p|) − 1 (PAPER Eq. 3): < 0 inside, 0 on the surface; s is capped at 0.95."""
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return MAX_SCALE - 1.0
    norm = superquadric_norm(x, y, z, half_axes, azimuth, elevation)
    s = scale_on_sphere(x / length, y / length, z / length, centres, inverse_extents, weights)
    return norm + min(s, MAX_SCALE) - 1.0


@njit(cache=True)
def leaf_radius(x, y, z, half_axes, azimuth, elevation, centres, inverse_extents, weights):
    """Return ρ = (1 − s)·q in the direction of (x, y, z) ≠ 0, of any length; mm."""
    length = math.sqrt(x * x + y * y + z * z)
    norm = superquadric_norm(x, y, z, half_axes, azimuth, elevation)
    s = scale_on_sphere(x / length, y / length, z / length, centres, inverse_extents, weights)
    return (1.0 - min(s, MAX_SCALE)) * length / norm


@njit(cache=True)
def leaf_radii(directions, half_axes, azimuth, elevation, centres, inverse_extents, weights):
    """Return (n,) radii for (n, 3) directions in the leaf's frame."""
    out = np.empty(directions.shape[0])
    for i in range(directions.shape[0]):
        out[i] = leaf_radius(
            directions[i, 0],
            directions[i, 1],
            directions[i, 2],
            half_axes,
            azimuth,
            elevation,
            centres,
            inverse_extents,
            weights,
        )
    return out


@njit(cache=True)
def contour_radius(cosine, sine, half_axes, angle, centres, inverse_extent, weights):
    """Return the contour's radius in direction (cos α, sin α); mm."""
    s = scale_on_circle(cosine, sine, centres, inverse_extent, weights)
    return (1.0 - min(s, MAX_SCALE)) / superellipse_norm(cosine, sine, half_axes, angle)


@njit(cache=True)
def contour_radii(angles, half_axes, angle, centres, inverse_extent, weights):
    """Return (n,) radii for (n,) angles α (rad)."""
    out = np.empty(angles.shape[0])
    for i in range(angles.shape[0]):
        out[i] = contour_radius(
            math.cos(angles[i]), math.sin(angles[i]), half_axes, angle, centres, inverse_extent, weights
        )
    return out
