"""A leaf's F − 1 at a point, and its change along a line."""

import math

from hhsr.kernels.cell import axis_scale
from hhsr.kernels.unmanaged import inlined


@inlined
def ray_along(x, y, z, dx, dy, dz):
    """Return the unit direction (3,) of a point and what it changes by along d (3,)."""
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x * inverse, y * inverse, z * inverse
    radial = dx * ux + dy * uy + dz * uz
    return (ux, uy, uz), ((dx - radial * ux) * inverse, (dy - radial * uy) * inverse, (dz - radial * uz) * inverse)


@inlined
def excess_of(blob, half_axes, x, y, z, dx, dy, dz, s, ds):
    """Return (F − 1, ∂F/∂d) at a point where the scale field is s, and changes by ds along d."""
    cx, cy, cz = axis_scale(blob, half_axes, 0, x), axis_scale(blob, half_axes, 2, y), axis_scale(blob, half_axes, 4, z)
    norm = math.sqrt(cx * x * x + cy * y * y + cz * z * z)
    d = 1.0 / (1.0 - s)
    f = norm * d
    return f - 1.0, ((cx * x * dx + cy * y * dy + cz * z * dz) / norm + f * ds) * d
