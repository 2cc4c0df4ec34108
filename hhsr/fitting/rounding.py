"""Numbers of a tree rounded to steps that are powers of two, so that a file keeps them in few bits, losslessly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hhsr.model import Contour, Cut, FloatArray, ModelLeaf, Node, RetainedPart, ScaleField, Superquadric, frozen

# Bits of the largest value's share: 12-bit weights cost no accuracy (DESIGN §3); a length keeps 1/65,536 of the part.
WEIGHT_BITS = 12
LENGTH_BITS = 16
VERTEX_BITS = 20
ANGLE_STEP = 2.0**-16
LOGIT_STEP = 2.0**-10
FINEST_STEP = 2.0**-40


def power_step(largest: float, bits: int) -> float:
    """Return the power of two of which `largest` is less than 2^bits."""
    if not largest > 0.0:
        return FINEST_STEP
    return max(2.0 ** (math.floor(math.log2(largest)) + 1 - bits), FINEST_STEP)


def to_step(values: FloatArray, step: float) -> FloatArray:
    """Return values rounded to whole steps."""
    return frozen(np.round(np.asarray(values) / step) * step)


def rounded_node(node: Node, extent_mm: float) -> Node:
    """Return the tree below a node with every stored number rounded; `extent_mm` is the source's longest side."""
    length = power_step(extent_mm, LENGTH_BITS)
    if isinstance(node, Cut):
        return replace(
            node,
            normal_angles=to_step(node.normal_angles, ANGLE_STEP),
            offset=float(to_step(np.array(node.offset), length)),
            half_width=float(to_step(np.array(node.half_width), length)),
            contours=tuple(rounded_contour(c, extent_mm) for c in node.contours),
            left=rounded_node(node.left, extent_mm),
            right=rounded_node(node.right, extent_mm),
        )
    if isinstance(node, RetainedPart):
        return RetainedPart(to_step(node.vertices, power_step(extent_mm, VERTEX_BITS)), node.faces)
    base, field = node.superquadric, node.scale_field
    return ModelLeaf(
        to_step(node.centre, length),
        to_step(node.rotation, ANGLE_STEP),
        Superquadric(
            _positive(base.half_axes, length),
            to_step(base.azimuth_logits, LOGIT_STEP),
            to_step(base.elevation_logits, LOGIT_STEP),
        ),
        ScaleField(field.grid, field.index, _weights(field.weights)),
    )


def rounded_contour(contour: Contour, extent_mm: float) -> Contour:
    """Return a contour with every stored number rounded."""
    length = power_step(extent_mm, LENGTH_BITS)
    return Contour(
        to_step(contour.centre, length),
        _positive(contour.half_axes, length),
        to_step(contour.logits, LOGIT_STEP),
        _weights(contour.weights),
    )


def _positive(lengths: FloatArray, step: float) -> FloatArray:
    return frozen(np.maximum(to_step(lengths, step), step))


def _weights(weights: FloatArray) -> FloatArray:
    return to_step(weights, power_step(float(np.abs(weights).max(initial=0.0)), WEIGHT_BITS))
