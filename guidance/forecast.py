"""First contact ahead: when the moving capsule meets a shape, as an interval that means it.

The axis predicted for a time ahead is a segment. Its distance to the shape changes no faster than its ends move, so
stepping ahead by (gap / speed) never jumps over a contact. Three such walks run side by side: the capsule as
predicted, the capsule grown by k standard deviations of the prediction (no contact can come earlier), and the capsule
shrunk by as much (contact has come by then). What is thinner than the uncertainty may be missed: then the interval
ends where the tip has passed it.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from guidance.limits import Limits
from guidance.motion import Motion
from guidance.needle import Array, Needle
from guidance.states import Forecast

if TYPE_CHECKING:
    from hhsr import Shape

_TOLERANCE_MM = 0.05  # of the clearances asked here: 10 ms at 5 mm/s
_TOUCH_MM = 0.06  # a gap this small is contact
_SPARE_S = 0.5
_PASSING_STEP_S = 0.1
_STEPS = 60


def forecast_contact(
    shape: Shape, needle: Needle, motion: Motion, limits: Limits, age_s: float, gap_mm: float = -inf
) -> Forecast:
    """When the needle will first touch a shape if it goes on as it moves now.

    Parameters
    ----------
    shape : hhsr.Shape
        LPS, mm.
    needle : Needle
    motion : Motion
        In the patient's frame.
    limits : Limits
    age_s : float
        How old the motion is at the time from which the forecast counts.
    gap_mm : float
        A lower bound of the present clearance, where one is known: what is far is settled without asking the shape.

    Returns
    -------
    Forecast
        All inf where no contact is likely soon (`approach_s` and its hysteresis). The interval leaves out what a hand
        may decide to do.
    """
    horizon = limits.horizon_s
    sideways = needle.length_mm * float(np.linalg.norm(motion.direction.rate))
    speed = motion.speed_mm_s + sideways
    grid = np.linspace(0.0, horizon, 17)
    growth = _growth(motion, limits, grid, 0.0)
    soon = limits.approach_s * (1.0 + limits.hysteresis_share) + _SPARE_S
    reach = speed * soon + float(np.interp(soon, grid, growth)) + _TOUCH_MM
    if gap_mm > reach:
        return Forecast()
    start = _clearance(shape, needle, motion, 0.0)
    if start > reach:
        return Forecast()
    nominal = _walk(shape, needle, motion, horizon, speed, np.zeros(len(grid)), grid, start)
    at = min(nominal, horizon)
    lever = (1.0 - float(shape.closest_approach(*_one(motion, at, needle)).t)) * needle.length_mm
    growth = _growth(motion, limits, grid, lever)
    earliest = _walk(shape, needle, motion, horizon, speed, growth, grid, start)
    latest = _walk(shape, needle, motion, horizon, speed, -growth, grid, start) if nominal < inf else inf
    certain = latest < inf
    if nominal < inf and not certain:
        latest = _passed(shape, needle, motion, horizon, growth, grid, nominal)
    return Forecast(
        seconds=max(nominal - age_s, 0.0),
        earliest_s=max(min(earliest, nominal) - age_s - limits.timing_s, 0.0),
        latest_s=max(max(latest, nominal) - age_s + limits.timing_s, 0.0),
        travel_mm=max(nominal, 0.0) * motion.speed_mm_s,
        certain=certain,
    )


def _passed(
    shape: Shape, needle: Needle, motion: Motion, horizon: float, growth: Array, grid: Array, nominal: float
) -> float:
    """When the tip, wherever it may be by then, has passed the shape (s); inf if not within the horizon.

    Used where the needle may just miss something thin: if the tip meets it, it does so before this time.
    """
    times = np.arange(nominal, horizon, _PASSING_STEP_S)
    if not len(times):
        return inf
    _, tips = motion.axis(times, needle.length_mm)
    gap = shape.signed_distance(tips, tolerance_mm=_TOLERANCE_MM) - needle.radius_mm - np.interp(times, grid, growth)
    gone = np.flatnonzero(gap > _TOUCH_MM)
    return float(times[gone[0]]) if len(gone) else inf


def _clearance(shape: Shape, needle: Needle, motion: Motion, ahead_s: float) -> float:
    return float(shape.clearance(*_one(motion, ahead_s, needle), needle.radius_mm, tolerance_mm=_TOLERANCE_MM))


def _one(motion: Motion, ahead_s: float, needle: Needle) -> tuple[Array, Array]:
    hubs, tips = motion.axis(np.array([ahead_s]), needle.length_mm)
    return hubs[0], tips[0]


def _growth(motion: Motion, limits: Limits, grid: Array, lever_mm: float) -> Array:
    """By how much (mm) the predicted capsule may be off at the times of the grid, at the stated coverage."""
    spread = [np.hypot(motion.tip.spread(t), lever_mm * motion.direction.spread(t)) for t in grid]
    return limits.coverage_sigmas * np.asarray(spread)


def _walk(
    shape: Shape, needle: Needle, motion: Motion, horizon: float, speed: float, growth: Array, grid: Array, start: float
) -> float:
    """The first time (s) at which the capsule, grown by `growth` over `grid`, touches the shape; inf if none."""
    steepest = float(np.abs(np.diff(growth)).max() / (grid[1] - grid[0])) if len(grid) > 1 else 0.0
    rate = max(speed + 1.1 * steepest, 1e-6)
    time, distance = 0.0, start
    for _ in range(_STEPS):
        gap = distance - float(np.interp(time, grid, growth))
        if gap <= _TOUCH_MM:
            return time
        time += gap / rate
        if time > horizon:
            return inf
        distance = _clearance(shape, needle, motion, time)
    # grazing: the walk has not finished. No contact lies before this time, and nothing proves one after it.
    return time if growth[-1] >= 0.0 else inf
