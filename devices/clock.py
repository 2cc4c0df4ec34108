"""Clocks: time is handed in, so that simulations and tests run on their own."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from threading import Event

from devices.errors import DeviceInputError

__all__ = ["Clock", "ManualClock", "SystemClock"]


class Clock(ABC):
    """A clock in seconds that never runs backwards; its zero has no meaning."""

    @abstractmethod
    def now_s(self) -> float:
        """Return the present, s."""

    @abstractmethod
    def wait_until(self, time_s: float, interrupt: Event | None = None) -> None:
        """Return when the clock shows `time_s`, or earlier once `interrupt` is set."""

    def unix_s(self, time_s: float) -> float:
        """Return the Unix time of a reading, for peers on other machines; a simulated clock gives its own."""
        return time_s


class SystemClock(Clock):
    """The machine's monotonic clock: the only reader of real time in the project."""

    def __init__(self) -> None:
        self._unix_offset_s = time.time() - time.monotonic()

    def unix_s(self, time_s: float) -> float:
        """Return the Unix time of a reading, by the offset at the time this clock was made."""
        return time_s + self._unix_offset_s

    def now_s(self) -> float:
        """Return the monotonic time, s."""
        return time.monotonic()

    def wait_until(self, time_s: float, interrupt: Event | None = None) -> None:
        """Sleep until `time_s`, or until `interrupt` is set."""
        remaining = time_s - time.monotonic()
        if remaining <= 0.0:
            return
        if interrupt is None:
            time.sleep(remaining)
        else:
            interrupt.wait(remaining)


class ManualClock(Clock):
    """A clock that moves only when told to; waiting on it moves it at once.

    Parameters
    ----------
    start : float
        First reading, s.

    Examples
    --------
    >>> clock = ManualClock(10.0)
    >>> clock.advance(0.5)
    >>> clock.now_s()
    10.5
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now_s = float(start)

    def now_s(self) -> float:
        """Return the present, s."""
        return self._now_s

    def advance(self, dt: float) -> None:
        """Move the clock forward by `dt` ≥ 0, s."""
        if not dt >= 0.0:
            raise DeviceInputError(f"advance: a clock does not run backwards, got {dt!r} s")
        self._now_s += dt

    def wait_until(self, time_s: float, interrupt: Event | None = None) -> None:
        """Move the clock to `time_s` if that lies ahead."""
        self._now_s = max(self._now_s, time_s)
