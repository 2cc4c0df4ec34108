"""Device time to host time: a line through arrivals, for devices that count frames or keep a clock of their own."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.errors import DeviceInputError

__all__ = ["ClockFit", "ClockLine", "fit_clock", "warm_up"]


@dataclass(frozen=True)
class ClockFit:
    """A line from device counts (frame numbers, or device seconds) to arrival times.

    Parameters
    ----------
    origin : float
        Count at which the line passes through `origin_s`.
    origin_s : float
    period_s : float
        Seconds per count.
    jitter_s : float
        Robust standard deviation of the arrivals about the line.
    earliest_s, latest_s : float
        How far the earliest arrivals (2 %) lie before the line, negative, and the latest of all behind it.
    used : int
        Arrivals that the line was fitted to; late ones are left out.
    """

    origin: float
    origin_s: float
    period_s: float
    jitter_s: float
    earliest_s: float
    latest_s: float
    used: int

    def time_s(self, count: ArrayLike) -> NDArray[np.float64]:
        """When a count was reached, s, on the clock of the arrivals (their mean delay included)."""
        return np.asarray(self.origin_s + self.period_s * (np.asarray(count, dtype=np.float64) - self.origin))


def fit_clock(counts: ArrayLike, arrivals_s: ArrayLike) -> ClockFit:
    """Fit the line by least squares, leaving out arrivals that are late (more than 4 robust deviations off).

    Parameters
    ----------
    counts : (n,) array_like
        Frame numbers or device seconds, n ≥ 3, not all equal.
    arrivals_s : (n,) array_like
        Host times, s.

    Returns
    -------
    ClockFit

    Raises
    ------
    DeviceInputError
        Where there are too few, or unequal numbers, or not finite ones.
    """
    x, y = np.asarray(counts, dtype=np.float64), np.asarray(arrivals_s, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 3 or not np.isfinite(x + y).all() or x.min() == x.max():
        raise DeviceInputError(f"fit_clock: expected two equal rows of ≥ 3 finite numbers, got {x.shape} and {y.shape}")
    used = np.ones(len(x), dtype=bool)
    slope, intercept, residual, spread = 0.0, 0.0, np.zeros(len(x)), 0.0
    x0, y0 = x.mean(), y.mean()
    for _ in range(4):
        dx, dy = x[used] - x0, y[used] - y0
        variance = ((dx - dx.mean()) ** 2).sum()
        if variance == 0.0:
            break
        slope = float(((dx - dx.mean()) * (dy - dy.mean())).sum() / variance)
        intercept = float(dy.mean() - slope * dx.mean())
        residual = (y - y0) - intercept - slope * (x - x0)
        spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
        keep = np.abs(residual - np.median(residual)) <= max(4.0 * spread, 1e-6)
        if keep.sum() < 3 or (keep == used).all():
            break
        used = keep
    return ClockFit(
        float(x0),
        float(y0 + intercept),
        slope,
        spread,
        float(np.quantile(residual[used], 0.02)),
        float(residual.max()),
        int(used.sum()),
    )


def warm_up() -> None:
    """Fit once: the first fit loads parts of numpy for up to 40 ms, which would cost a polled tracker two frames."""
    fit_clock(range(16), [0.1 * k + 0.01 * (k % 3) for k in range(16)])


class ClockLine:
    """The line kept up to date while frames arrive.

    A frame's time is taken from the line through the earliest arrivals: delays only ever add.

    Parameters
    ----------
    window : int
        Number of newest frames that the line is fitted to.

    Examples
    --------
    >>> line = ClockLine()
    >>> times = [line.add(k, 100.0 + k / 60.0 + (0.004 if k % 5 == 0 else 0.0)) for k in range(120)]
    >>> abs(times[100] - (100.0 + 100 / 60.0)) < 0.001
    True
    """

    _LEAST = 12
    _REFIT = 8

    def __init__(self, window: int = 256) -> None:
        self._seen: deque[tuple[float, float]] = deque(maxlen=max(self._LEAST, window))
        self._since_fit = 0
        self._latest_s = -np.inf
        self.fit: ClockFit | None = None

    def add(self, count: float, arrival_s: float) -> float:
        """Take one arrival; return when its frame was valid, s: never after its arrival, never before the last."""
        self._seen.append((float(count), arrival_s))
        self._since_fit += 1
        if len(self._seen) >= self._LEAST and (self.fit is None or self._since_fit >= self._REFIT):
            rows = np.array(self._seen)
            if rows[:, 0].min() < rows[:, 0].max():
                self.fit = fit_clock(rows[:, 0], rows[:, 1])
            self._since_fit = 0
        time_s = arrival_s
        if self.fit is not None:
            time_s = min(arrival_s, float(self.fit.time_s(count)) + self.fit.earliest_s)
        self._latest_s = max(self._latest_s, time_s)
        return min(self._latest_s, arrival_s)
