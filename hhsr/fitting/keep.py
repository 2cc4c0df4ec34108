"""Pieces kept as triangles where that costs less than telling them as radii: coarse, angular ones (DESIGN §2, §3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hhsr.fitting.cuts import Plane
from hhsr.fitting.lookahead import Piece
from hhsr.fitting.retain import OVERHANG_MM, retained_part
from hhsr.fitting.solid import Region, Solid
from hhsr.model import RetainedPart


def affordable(solid: Solid, pieces: Sequence[Piece], most: int, size_mm: float) -> dict[int, RetainedPart]:
    """Return the pieces, by number, whose own triangles take at most `most` numbers, in the solid's units.

    size_mm: of the solid's unit. A part that is found too large by its vertices alone is never cut out.
    """
    found = {}
    for k, piece in enumerate(pieces):
        if least_numbers(solid, piece.region) <= most:
            planes = [(Plane(n, float(d)), 1) for n, d in zip(piece.region.normals, piece.region.offsets, strict=True)]
            part = retained_part(solid.vertices, solid.faces, planes, OVERHANG_MM / size_mm)
            if 0 < part.parameters <= most:
                found[k] = part
    return found


def least_numbers(solid: Solid, region: Region) -> int:
    """Return how many numbers the vertices and whole triangles within a region take."""
    held = region.holds(solid.vertices)
    whole = held[solid.faces].all(axis=1)
    return 3 * int(np.unique(solid.faces[whole]).size) + 3 * int(whole.sum())
