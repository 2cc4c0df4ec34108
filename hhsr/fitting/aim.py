"""Mean against maximum: what a fit is to make small (DESIGN §3)."""

from __future__ import annotations

import math
from typing import NamedTuple

USUAL_WEIGHT = 0.01
USUAL_POWER = 1.5
POWERS = (1.2, 3.0)


class Aim(NamedTuple):
    """worst: what the largest miss weighs beside the mean where fits are judged. power: of the misses in refinement."""

    worst: float
    power: float


def aim_of(weight: float) -> Aim:
    """Return the aim for a weight of the largest miss: a power of 1.5 at 0.01, half more for each factor of ten."""
    power = USUAL_POWER + 0.5 * math.log10(max(weight, 1e-9) / USUAL_WEIGHT)
    return Aim(weight, min(max(power, POWERS[0]), POWERS[1]))
