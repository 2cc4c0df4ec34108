"""Numbers in lanes of either kind, so that a formula is written once: vectors of code that is emitted, or arrays.

Where a lane has no number, `least` and `most` take the other one, and no index may come of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir

from hhsr.kernels.layout import CELL_SIZE, LANES, LEAF_INT_SIZE
from hhsr.kernels.runs import RUN_SIZE
from hhsr.kernels.vectors import DOUBLE, LONG, Vector, fused, gather, gather_columns, gather_rows, root


class Emitted:
    """Lanes of code that a builder of LLVM's emits: LANES, or one, with the same bits."""

    def __init__(self, builder: Any, lanes: int, runs: Any, blob: Any, ints: Any, tab: Any) -> None:
        self.builder, self.lanes = builder, lanes
        self.runs, self.blob, self.ints, self.tab = runs, blob, ints, tab
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

    def _columns(self, table: Any, index: Vector, count: int) -> list[Vector]:
        """Return the elements from each lane's index on, one vector for each place."""
        whole = count - count % LANES if self.lanes == LANES else 0
        columns = [v for k in range(0, whole, LANES) for v in gather_columns(self.builder, table, index + k)]
        return columns + [gather(self.builder, table, index + k) for k in range(whole, count)]

    def record(self, index: Vector) -> list[Vector]:
        return self._columns(self.runs, index, RUN_SIZE)

    def leaf(self, index: Vector) -> list[Vector]:
        return self._columns(self.ints, index, LEAF_INT_SIZE)

    def axes(self, index: Vector) -> list[Vector]:
        return self._columns(self.blob, index, LANES)

    def pair(self, index: Vector) -> list[Vector]:
        return gather_rows(self.builder, self.ints, index, 2)

    def bends(self, index: Vector) -> list[Vector]:
        return [bend.doubles() for bend in gather_rows(self.builder, self.tab, index, 2)]

    def word(self, index: Vector) -> Vector:
        return gather(self.builder, self.ints, index)

    def cell(self, index: Vector) -> list[Vector]:
        return [number.doubles() for number in self._columns(self.tab, index, CELL_SIZE)]


class Counted:
    """Lanes of arrays: what is emitted, but for the last bits."""

    one = np.float64(1.0)
    number, longs, doubles = np.float64, np.int64, np.float64
    where, least, most, equal, root = staticmethod(np.where), np.fmin, np.fmax, np.equal, np.sqrt

    def __init__(self, runs: Any, blob: Any, ints: Any, tab: Any) -> None:
        self.runs, self.blob, self.ints, self.tab = runs.ravel(), blob, ints, tab

    def fused(self, factor: Any, other: Any, more: Any) -> Any:
        return factor * other + more

    def power(self, exponent: Any) -> Any:
        return np.left_shift(1, exponent)

    def record(self, index: Any) -> list[Any]:
        return [self.runs[index + k] for k in range(RUN_SIZE)]

    def leaf(self, index: Any) -> list[Any]:
        return [self.ints[index + k] for k in range(LEAF_INT_SIZE)]

    def axes(self, index: Any) -> list[Any]:
        return [self.blob[index + k] for k in range(6)]

    def pair(self, index: Any) -> list[Any]:
        return [self.ints[index], self.ints[index + 1]]

    def bends(self, index: Any) -> list[Any]:
        return [np.float64(self.tab[index]), np.float64(self.tab[index + 1])]

    def word(self, index: Any) -> Any:
        return self.ints[index]

    def cell(self, index: Any) -> list[Any]:
        return [np.float64(self.tab[index + k]) for k in range(CELL_SIZE)]
