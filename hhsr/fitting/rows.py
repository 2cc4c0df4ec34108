"""What a leaf is asked to be: rows of direction, wanted radius and weight (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hhsr.model import FloatArray

BoolArray = NDArray[np.bool_]

GRAZING = 0.2


class Rows(NamedTuple):
    """n rows of a leaf: weight · (ρ(direction) − radius) is a miss in mm of true distance.

    directions: (n, 3) unit. radii: (n,) mm wanted. weights: (n,) ≥ 0. bound: (n,) bool, where only ρ ≥ radius is asked.
    """

    directions: FloatArray
    radii: FloatArray
    weights: FloatArray
    bound: BoolArray

    def joined(self, others: Rows) -> Rows:
        """Return these rows and others."""
        return Rows(*(np.concatenate([a, b]) for a, b in zip(self, others, strict=True)))
