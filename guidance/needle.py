"""The needle: a straight capsule from hub to tip.

Tip frame: origin at the tip, +z the way the needle points (hub → tip). So a pose `T_patient_tip` carries the
whole needle: the tip is its translation, the direction its third column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from guidance.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Needle:
    """A straight needle.

    Parameters
    ----------
    length_mm : float
        Hub to tip, the most that can be inserted.
    radius_mm : float
        Of the shaft; the tip is taken as a half ball of the same radius (a bevel lies within it).
    """

    length_mm: float
    radius_mm: float

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("length_mm", self.length_mm, 1.0, 1000.0),
            ("radius_mm", self.radius_mm, 0.0, 20.0),
        ):
            if not (np.isfinite(value) and low <= value <= high):
                raise InputError(f"needle {name} is {value!r}; expected a number from {low:g} to {high:g} mm")

    def hub(self, tip: Array, direction: Array) -> Array:
        """Hub positions (..., 3), mm, for tips (..., 3) and unit directions (..., 3)."""
        return np.asarray(tip - self.length_mm * direction)

    def axis(self, T_patient_tip: Array) -> tuple[Array, Array]:
        """Hub and tip (3,), mm, in the patient's frame, of a (4, 4) tip pose."""
        tip, direction = T_patient_tip[:3, 3], T_patient_tip[:3, 2]
        return self.hub(tip, direction), tip.copy()
