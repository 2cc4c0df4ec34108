"""Where a segment crosses the strips of a slab: bisection on a Lipschitz bound of each lobe's gap (DESIGN §2)."""

from numba import njit

from hhsr.kernels.segment import emit
from hhsr.kernels.slab import slab_contains


@njit(cache=True)
def slab_crossings(blob, ints, slab, px, py, pz, dx, dy, dz, t0, t1, resolution, state, out, count, work):
    """Follow p + t·d through a slab; return (state, count)."""
    t = 0.5 * (t0 + t1)
    return emit(state, slab_contains(blob, ints, slab, px + t * dx, py + t * dy, pz + t * dz), t0, out, count)
