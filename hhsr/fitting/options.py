"""What a fit may cost and how it is made: one frozen record, checked when it is built."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from hhsr.errors import InputError

RECIPES = ("default", "paper")
BASES = ("ellipsoid", "turned", "any")


@dataclass(frozen=True)
class FitOptions:
    """Options of `hhsr.fit`. Lengths in mm, volumes in mm³; the defaults fit an organ of any size.

    Parameters
    ----------
    max_parameters : most numbers that may be stored (`Shape.parameters` ≤ this), ≥ 16; None: what the error asks for.
    max_mean_error_mm, max_error_mm : stop spending when the two-sided mean / sampled maximum is below; None: no goal.
    max_error_weight : what the largest miss counts beside the mean, 0 … 1, where the default recipe chooses: 0.1 lowers
        maxima and costs some of the mean.
    bases : what the default recipe's leaves may buy where it brings more than as many centres: "ellipsoid": nothing
        beyond six half axes; "turned": axes of their own; "any": exponents and knots too, which queries pay for.
    retain : keep the whole mesh as one retained part (a vessel tree); the budget is then not asked.
    recipe : "default", or "paper": mutex cuts by Eq. 9, superquadrics with spline exponents, uniform centres, bands.
    seed : of every random choice.
    t_mm : two points of a contour map farther apart than this are not neighbours (PAPER §3.1); None: 1/40 of the
        longest side.
    t1 : a part is cut while its pairs weigh more than this share of the root's, 0 … 1.
    t2_mm3 : a part whose bounding box is smaller is retained.
    t3_mm : a part whose mean error of fit is larger is retained; None: 10 % of the longest side.
    directions : planes of how many directions make the contour maps.
    half_width_mm : half width d of a band before it is reduced until valid; None: t_mm / 2; 0: no bands.
    samples : points drawn per side when the error is measured, ≥ 1000.

    Raises
    ------
    InputError : a value outside its range, or options that contradict each other.
    """

    max_parameters: int | None = None
    max_mean_error_mm: float | None = None
    max_error_mm: float | None = None
    max_error_weight: float = 0.01
    bases: Literal["ellipsoid", "turned", "any"] = "ellipsoid"
    retain: bool = False
    recipe: Literal["default", "paper"] = "default"
    seed: int = 0
    t_mm: float | None = None
    t1: float = 0.05
    t2_mm3: float = 0.0
    t3_mm: float | None = None
    directions: int = 32
    half_width_mm: float | None = None
    samples: int = 20_000

    def __post_init__(self) -> None:
        """Refuse what no fit can keep."""
        if self.recipe not in RECIPES:
            raise InputError(f"recipe: got {self.recipe!r}, expected one of {', '.join(RECIPES)}")
        if self.bases not in BASES:
            raise InputError(f"bases: got {self.bases!r}, expected one of {', '.join(BASES)}")
        if self.max_parameters is not None:
            _whole("max_parameters", self.max_parameters, 16, 10_000_000)
        _whole("seed", self.seed, 0, 2**63 - 1)
        _whole("directions", self.directions, 3, 1000)
        _whole("samples", self.samples, 1000, 10_000_000)
        for name in ("max_mean_error_mm", "max_error_mm", "t_mm", "t3_mm"):
            _number(name, getattr(self, name), math.nextafter(0.0, 1.0), math.inf)
        _number("max_error_weight", self.max_error_weight, 0.0, 1.0)
        _number("t1", self.t1, 0.0, 1.0)
        _number("t2_mm3", self.t2_mm3, 0.0, math.inf)
        _number("half_width_mm", self.half_width_mm, 0.0, math.inf)

    @staticmethod
    def paper(
        t_mm: float | None = None,
        t1: float = 0.05,
        t2_mm3: float = 0.0,
        t3_mm: float | None = None,
        max_parameters: int | None = None,
        **others: Any,
    ) -> FitOptions:
        """Return the options of the paper's own fit (PAPER §3–§5): its four thresholds, and a budget if wanted."""
        return FitOptions(
            recipe="paper", t_mm=t_mm, t1=t1, t2_mm3=t2_mm3, t3_mm=t3_mm, max_parameters=max_parameters, **others
        )

    def to_json(self) -> Mapping[str, Any]:
        """Return what differs from the defaults, as JSON values: what a file keeps of its fit."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}


def _whole(name: str, value: Any, low: int, high: int) -> None:
    """Raise InputError unless `value` is a whole number in [low, high]."""
    whole = isinstance(value, int) or (hasattr(value, "__index__") and not isinstance(value, bool))
    if isinstance(value, bool) or not whole or not low <= int(value) <= high:
        raise InputError(f"{name}: got {value!r}, expected a whole number in [{low}, {high}]")


def _number(name: str, value: Any, low: float, high: float) -> None:
    """Raise InputError unless `value` is None or a number in [low, high] (infinite only where that is the end)."""
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value) or not low <= value <= high:
        raise InputError(f"{name}: got {value!r}, expected a number in [{low:g}, {high:g}]")
