"""Lanes of either kind that read tables, each at an index of its own: records of runs, leaves, cells."""

from __future__ import annotations

from typing import Any

import numpy as np

from hhsr.kernels.either_lanes import Counted, Emitted
from hhsr.kernels.layout import CELL_SIZE, LANES, LEAF_INT_SIZE
from hhsr.kernels.runs import RUN_SIZE
from hhsr.kernels.vectors import Vector, gather, gather_columns, gather_rows


class EmittedTables(Emitted):
    """Lanes of code that is emitted, and the tables."""

    def __init__(self, builder: Any, lanes: int, runs: Any, blob: Any, ints: Any, tab: Any) -> None:
        super().__init__(builder, lanes)
        self.runs, self.blob, self.ints, self.tab = runs, blob, ints, tab

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


class CountedTables(Counted):
    """Lanes of arrays, and the tables."""

    def __init__(self, runs: Any, blob: Any, ints: Any, tab: Any) -> None:
        self.runs, self.blob, self.ints, self.tab = runs.ravel(), blob, ints, tab

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
