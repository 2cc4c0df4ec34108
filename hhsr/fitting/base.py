"""What a leaf's scale field multiplies: six half axes, where they pay exponents, knots, a turn (DESIGN §1, §3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hhsr.evaluate import leaf_radius
from hhsr.fitting.superquadric import Start, fit_superquadric, norm_gradients
from hhsr.kernels.refinement import axis_slopes, ellipsoid_radii
from hhsr.model import FloatArray, ModelLeaf, ScaleField, Superquadric, frozen, rotation_matrix

HELD_FAST = 1e3
# Coarser than what the order of sums in a linear algebra library may change, as fine as what is stored.
STEP = 2.0**-16
LEAST_TURN = 0.01  # rad: less is not worth three numbers
MOST_POINTS = 1000
# What the superquadric may take: half axes, turned; constant exponents; up to twelve knots; these two turned.
TURNED = ((True, 6),)
ANY = (*TURNED, (False, 8), (False, 18), (True, 8), (True, 18))


def local(leaf: ModelLeaf, directions: FloatArray) -> FloatArray:
    """Return (n, 3) directions of the tree's frame in the leaf's."""
    if leaf.rotation.size == 0:
        return directions
    turned: FloatArray = np.einsum("ni,ij->nj", directions, rotation_matrix(leaf.rotation))
    return turned


def base_radii(leaf: ModelLeaf, directions: FloatArray) -> FloatArray:
    """Return (n,) radii q of a leaf's superquadric in (n, 3) unit directions of the tree's frame."""
    base, u = leaf.superquadric, local(leaf, directions)
    if base.parameters == 6:
        radii: FloatArray = ellipsoid_radii(np.asarray(base.half_axes), u)
        return radii
    return leaf_radius(replace(leaf, scale_field=ScaleField.none()), u)


def base_slopes(leaf: ModelLeaf, directions: FloatArray, radii: FloatArray) -> FloatArray:
    """Return (n, 6 + k) slopes of the radii q by the half axes' logarithms and by the k logits, azimuth first."""
    base, u = leaf.superquadric, local(leaf, directions)
    axes = np.asarray(base.half_axes)
    if base.parameters == 6:
        slopes: FloatArray = axis_slopes(axes, u, radii)
        return slopes
    by = norm_gradients(u, axes, np.asarray(base.azimuth_logits), np.asarray(base.elevation_logits))
    return np.asarray(-(radii[:, None] ** 2) * np.concatenate(by[2:], axis=1))


def richer_bases(
    leaf: ModelLeaf, along: FloatArray, radii: FloatArray, kinds: tuple[tuple[bool, int], ...]
) -> list[ModelLeaf]:
    """Return leaves about the same centre, without a field, whose bases spend more numbers on the same rays.

    along, radii: (n, 3), (n,) what the base should meet, about the centre. kinds: whether the axes may turn, and how
    many numbers the superquadric may take.
    """
    few = slice(None, None, -(-radii.size // MOST_POINTS))
    points = leaf.centre + radii[few, None] * along[few]
    found = []
    for rotate, most in kinds:
        start = Start(leaf.centre, np.zeros(3))
        fit = fit_superquadric(points, start, knots=most > 6, rotate=rotate, most_numbers=most, leash=HELD_FAST)
        base = fit.superquadric
        rounded = [np.round(a / STEP) * STEP for a in (base.half_axes, base.azimuth_logits, base.elevation_logits)]
        angle = float(np.sqrt((fit.rotation**2).sum()))
        turn = frozen(np.round(fit.rotation / STEP) * STEP) if angle > LEAST_TURN else frozen([])
        found.append(ModelLeaf(leaf.centre, turn, Superquadric(*rounded), ScaleField.none()))
    return found
