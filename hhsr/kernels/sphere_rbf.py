"""Compact Gaussians on the sphere and on the circle: the scale field s (PAPER Eq. 3, DESIGN §1)."""

import math

from numba import njit


@njit(cache=True)
def wendland_gaussian(h):
    """Return λ = e^(−4h) (1 − h)² for h = d / (1 − cos σ) < 1, else 0."""
    if h >= 1.0:
        return 0.0
    rest = 1.0 - h
    return math.exp(-4.0 * h) * rest * rest


@njit(cache=True)
def scale_on_sphere(ux, uy, uz, centres, inverse_extents, weights):
    """Return s(u) of a unit direction. centres: (k, 3); inverse_extents: (k,) 1/(1 − cos σ); weights: (k,)."""
    total = 0.0
    for j in range(weights.shape[0]):
        h = (1.0 - (ux * centres[j, 0] + uy * centres[j, 1] + uz * centres[j, 2])) * inverse_extents[j]
        if h < 1.0:
            total += weights[j] * wendland_gaussian(h)
    return total


@njit(cache=True)
def scale_on_circle(cosine, sine, centres, inverse_extent, weights):
    """Return s(α) on the circle. centres: (k, 2) cos α_j, sin α_j; one support for all."""
    total = 0.0
    for j in range(weights.shape[0]):
        h = (1.0 - (cosine * centres[j, 0] + sine * centres[j, 1])) * inverse_extent
        if h < 1.0:
            total += weights[j] * wendland_gaussian(h)
    return total
