"""Numbers in lanes of either kind, so that a formula is written once: vectors of code that is emitted, or arrays.

Where a lane has no number, `least` and `most` take the other one, and no index may come of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir

from hhsr.kernels.vectors import DOUBLE, LONG, Vector, fused, root


class Emitted:
    """Lanes of code that a builder of LLVM's emits: LANES, or one, with the same bits."""

    def __init__(self, builder: Any, lanes: int) -> None:
        self.builder, self.lanes = builder, lanes
        self.one = self.number(1.0)
        self.fused, self.root = fused, root

    def number(self, value: float) -> Vector:
        return Vector.of(self.builder, ir.Constant(DOUBLE, value), self.lanes)

    def where(self, truth: Vector, yes: Vector, no: Vector | float) -> Vector:
        return truth.where(yes, no)

    def least(self, one: Vector, other: Vector | float) -> Vector:
        return one.least(other)

    def most(self, one: Vector, other: Vector | float) -> Vector:
        return one.most(other)

    def equal(self, one: Vector, other: float) -> Vector:
        return one.is_(other)

    def longs(self, numbers: Vector) -> Vector:
        return numbers.longs()

    def doubles(self, numbers: Vector) -> Vector:
        return numbers.doubles()

    def power(self, exponent: Vector) -> Vector:
        return Vector.of(self.builder, ir.Constant(LONG, 1), self.lanes) << exponent


class Counted:
    """Lanes of arrays: what is emitted, but for the last bits."""

    one = np.float64(1.0)
    number, longs, doubles = np.float64, np.int64, np.float64
    where, least, most, equal, root = staticmethod(np.where), np.fmin, np.fmax, np.equal, np.sqrt

    def fused(self, factor: Any, other: Any, more: Any) -> Any:
        return factor * other + more

    def power(self, exponent: Any) -> Any:
        return np.left_shift(1, exponent)
