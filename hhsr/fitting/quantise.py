"""Numbers rounded as they are stored: whole multiples of power-of-two steps, packed without loss (DESIGN §3)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from hhsr.model import (
    Contour,
    Cut,
    FloatArray,
    ModelLeaf,
    Node,
    RetainedPart,
    ScaleField,
    frozen,
    leaves,
    normal_angles_of,
)

LENGTH_BITS = 15
VERTEX_BITS = 18
WEIGHT_BITS = 10
ANGLE_STEP = 2.0**-14
LOGIT_STEP = 2.0**-8


def quantised(root: Node, weight_bits: int = WEIGHT_BITS) -> Node:
    """Return the tree with every stored number a multiple of a power of two.

    Lengths keep 15 bits of the longest one, retained vertices 18, angles 2⁻¹⁴ rad, exponents' logits 2⁻⁸, weights
    of all scale fields and contours `weight_bits` of the largest.
    """
    lengths = _lengths(root)
    longest = max(lengths) if lengths else 1.0
    weights = [np.asarray(w) for w in _weights(root)]
    step = weight_step(np.concatenate(weights) if weights else np.zeros(0), weight_bits)
    return _rounded(root, _power_below(longest), step)


def rounded_plane(normal: FloatArray, offset: float, size: float) -> tuple[FloatArray, float]:
    """Return a plane's angles (2,) and offset (mm) as the file will keep them, for a shape of a longest side (mm).

    Cuts are rounded before anything is fitted to their sides, so that rounding opens no step between them.
    """
    angles = _multiples(normal_angles_of(normal), ANGLE_STEP)
    return angles, float(_multiples(offset, _power_below(size) * 2.0 ** (3 - LENGTH_BITS)))


def weight_step(weights: FloatArray, bits: int = WEIGHT_BITS) -> float:
    """Return the power of two to whose multiples weights are rounded: 2^−bits of the one below their largest."""
    largest = float(np.abs(weights).max()) if weights.size else 0.0
    return _power_below(largest) * 2.0**-bits if largest > 0.0 else 1.0


def _power_below(value: float) -> float:
    """Return the largest power of two ≤ value."""
    return math.ldexp(1.0, math.frexp(value)[1] - 1) if value > 0.0 else 1.0


def _multiples(values: ArrayLike, step: float) -> FloatArray:
    """Return values rounded to whole multiples of a step, never −0."""
    return frozen(np.round(np.asarray(values, dtype=np.float64) / step) * step + 0.0)


def _at_least_one(values: ArrayLike, step: float) -> FloatArray:
    """Return lengths rounded, but not to 0."""
    return frozen(np.maximum(_multiples(values, step), step))


def _lengths(node: Node) -> list[float]:
    """Return the half axes and centres, as their absolute values."""
    found: list[float] = []
    for leaf in leaves(node):
        if isinstance(leaf, ModelLeaf):
            found += [float(np.abs(leaf.centre).max()), float(np.asarray(leaf.superquadric.half_axes).max())]
        elif leaf.vertices.size:
            found.append(float(np.abs(leaf.vertices).max()))
    return found


def _weights(node: Node) -> list[FloatArray]:
    """Return the weights of all scale fields and contours."""
    if isinstance(node, Cut):
        own = [c.weights for c in node.contours]
        return own + _weights(node.left) + _weights(node.right)
    return [node.scale_field.weights] if isinstance(node, ModelLeaf) else []


def _rounded(node: Node, longest: float, weight: float) -> Node:
    """Return a node with its numbers rounded, steps by the longest length (a power of two) and of the weights."""
    step = longest * 2.0**-LENGTH_BITS
    if isinstance(node, Cut):
        return replace(
            node,
            normal_angles=_multiples(node.normal_angles, ANGLE_STEP),
            offset=float(_multiples(node.offset, step)),
            half_width=float(_multiples(node.half_width, step)),
            contours=tuple(_contour(c, step, weight) for c in node.contours),
            left=_rounded(node.left, longest, weight),
            right=_rounded(node.right, longest, weight),
        )
    if isinstance(node, RetainedPart):
        return replace(node, vertices=_multiples(node.vertices, longest * 2.0**-VERTEX_BITS))
    base, field = node.superquadric, node.scale_field
    return ModelLeaf(
        _multiples(node.centre, step),
        _multiples(node.rotation, ANGLE_STEP),
        replace(
            base,
            half_axes=_at_least_one(base.half_axes, step),
            azimuth_logits=_multiples(base.azimuth_logits, LOGIT_STEP),
            elevation_logits=_multiples(base.elevation_logits, LOGIT_STEP),
        ),
        ScaleField(field.grid, frozen(field.index, np.int64), _multiples(field.weights, weight)),
    )


def _contour(contour: Contour, step: float, weight: float) -> Contour:
    """Return a contour with its numbers rounded."""
    return Contour(
        _multiples(contour.centre, step),
        _at_least_one(contour.half_axes, step),
        _multiples(contour.logits, LOGIT_STEP),
        _multiples(contour.weights, weight),
    )
