"""No more numbers than an error asks for: budgets are tried, each fit is measured as it is stored (DESIGN §3)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from hhsr.fitting.options import FitOptions
from hhsr.fitting.report import error_of
from hhsr.model import ErrorFigures, FloatArray, IntArray, Node, Tree, frozen
from hhsr.shape import Shape

FIRST_NUMBERS = 64
MOST_NUMBERS = 20_000
LEAST_GROWTH, MOST_GROWTH = 1.15, 3.0
# The figures in the file are measured where the source lies: rounding must not put them back above the goal.
CERTAIN = 1.0 - 1e-6


def enough(fitted: Callable[[int], Node], vertices: FloatArray, faces: IntArray, options: FitOptions) -> Node:
    """Return the first fit, of ever larger budgets, whose measured error is as small as the options ask for.

    fitted: budget → root. vertices, faces: the source in the normalised frame, mm. The error falls more slowly than
    the number of numbers grows: the budget grows by as much as the error is too large, from 15 % to threefold. Without
    success by `max_parameters` (20,000) that fit is returned, and its figures say how far it came.
    """
    most = options.max_parameters if options.max_parameters is not None else MOST_NUMBERS
    budget = min(FIRST_NUMBERS, most)
    while True:
        root = fitted(budget)
        shape = Shape(Tree(root, frozen(np.zeros(6))))
        over = excess(error_of(shape, vertices, faces, options.samples, options.seed), options)
        if over <= CERTAIN or budget >= most:
            return root
        budget = min(math.ceil(budget * float(np.clip(over, LEAST_GROWTH, MOST_GROWTH))), most)


def excess(error: ErrorFigures, options: FitOptions) -> float:
    """Return how many times an error is what the options ask for: of mean and maximum the worse; ≤ 1: enough."""
    shares = [0.0]
    if options.max_mean_error_mm is not None:
        shares.append(error.mean_mm / options.max_mean_error_mm)
    if options.max_error_mm is not None:
        shares.append(error.max_mm / options.max_error_mm)
    return max(shares)
