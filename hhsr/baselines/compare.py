"""HHSR beside its comparators on one surface: rows of a table, and a picture of error against parameters."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from hhsr.baselines.methods import METHODS, fit_baseline
from hhsr.errors import FitError
from hhsr.fitting import FitOptions, fit
from hhsr.read import Surface

RECIPES = ("hhsr", "hhsr_paper")


class Row(NamedTuple):
    """One fit: parameters, bytes of its file, two-sided true distances in mm, seconds of fitting."""

    method: str
    budget: int
    parameters: int
    bytes: int
    mean_mm: float
    p95_mm: float
    max_mm: float
    seconds: float


def compare(
    surface: Surface,
    budgets: Sequence[int],
    methods: Iterable[str] = (*RECIPES, *METHODS),
    progress: Callable[[str, int], None] = lambda method, budget: None,
) -> list[Row]:
    """Fit a surface by every method at every budget of parameters; Draco's file is as large as HHSR's (default recipe).

    A method that cannot be fitted within a budget has no row there.
    """
    rows: list[Row] = []
    for budget in budgets:
        size: int | None = None
        for method in methods:
            progress(method, budget)
            try:
                row = _recipe_row(surface, method, budget) if method in RECIPES else _row(surface, method, budget, size)
            except FitError:
                continue
            if method == RECIPES[0]:
                size = row.bytes
            rows.append(row)
    return rows


def _recipe_row(surface: Surface, method: str, budget: int) -> Row:
    options = FitOptions(max_parameters=budget) if method == RECIPES[0] else FitOptions.paper(max_parameters=budget)
    begun = time.perf_counter()
    shape = fit(surface, options)
    seconds = time.perf_counter() - begun
    assert shape.fit_error is not None  # a fit measures itself
    return Row(method, budget, shape.parameters, shape.bytes, *shape.fit_error, seconds)


def _row(surface: Surface, method: str, budget: int, max_bytes: int | None) -> Row:
    found = fit_baseline(method, surface, budget, max_bytes)
    return Row(method, budget, found.parameters, found.bytes, *found.error(surface), found.seconds)


def draw(rows: Sequence[Row], path: Path, title: str) -> None:
    """Write a picture of mean (line) and largest error (dots) against parameters, both axes logarithmic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for method in dict.fromkeys(row.method for row in rows):
        own = sorted((row for row in rows if row.method == method), key=lambda row: row.parameters)
        numbers = [row.parameters for row in own]
        (line,) = axes.loglog(numbers, [row.mean_mm for row in own], "o-", label=method)
        axes.loglog(numbers, [row.max_mm for row in own], ":", color=line.get_color(), linewidth=1)
    axes.set_xlabel("stored numbers")
    axes.set_ylabel("two-sided distance, mm (line: mean, dots: largest)")
    axes.set_title(title)
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=150)
