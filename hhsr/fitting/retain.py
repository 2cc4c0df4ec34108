"""Retained parts: what cannot be modelled well is kept as closed triangles (PAPER §4, DESIGN §2)."""

from __future__ import annotations

import numpy as np

from hhsr.errors import FitError
from hhsr.fitting.cuts import Plane
from hhsr.fitting.split import trim
from hhsr.model import FloatArray, IntArray, RetainedPart, frozen

OVERHANG_MM = 1.0


def retained_part(
    vertices: FloatArray,
    faces: IntArray,
    planes: tuple[tuple[Plane, int], ...] | list[tuple[Plane, int]] = (),
    overhang: float = OVERHANG_MM,
) -> RetainedPart:
    """Return the triangles of a region, running 1 mm past each of its planes and capped there, outside the region.

    Parameters
    ----------
    vertices, faces : (n, 3) mm, (m, 3) closed triangles of the whole source.
    planes : pairs of a plane and the side of it (+1 right, −1 left) that the region is on; none: the whole, as it is.
    overhang : how far the triangles run past the planes, where the unit is not the millimetre.

    A region that the source does not reach gives an empty part.
    """
    if planes:
        vertices, faces = trim(vertices, faces, list(planes), overhang)
    used, compact = np.unique(faces, return_inverse=True)
    return RetainedPart(frozen(vertices[used].reshape(-1, 3)), frozen(compact.reshape(-1, 3), np.int64))


def require_room(parameters: int, budget: int | None, what: str) -> None:
    """Raise FitError if `parameters` numbers that must be stored do not go into the budget."""
    if budget is not None and parameters > budget:
        raise FitError(
            f"{what} takes {parameters} numbers, max_parameters is {budget}; "
            f"allow at least {parameters}, fit without a budget, or keep the mesh whole with retain=True"
        )
