"""The nearest point of a slab's strips to a segment or a point."""

from numba import njit


@njit(cache=True)
def nearest_on_slab(blob, ints, slab, planes, count, search, nodes, keys, corners, spare, rects):
    """Improve the search by the strips of a slab within its region."""
    return
