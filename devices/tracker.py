"""The one interface of all trackers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from threading import Event
from types import TracebackType
from typing import Self

from devices.clock import Clock, SystemClock
from devices.errors import DeviceInputError, TrackerError
from devices.frame import TrackerFrame
from devices.scheduling import HASTE

__all__ = ["LineCounters", "Tracker"]

_ATTEMPT_EVERY_S = 0.25
#: frames of a live tracker between two looks at the garbage collector
_FREEZE_EVERY = 256


@dataclass
class LineCounters:
    """What a tracker counted on its line since it was made.

    Parameters
    ----------
    crc_errors, malformed, timeouts, repeated, reconnects : int
        Replies dropped for their checksum, for their layout, missing replies, replies that held no newer frame, and
        times the line was lost and found again.
    """

    crc_errors: int = 0
    malformed: int = 0
    timeouts: int = 0
    repeated: int = 0
    reconnects: int = 0


class Tracker(ABC):
    """A source of `TrackerFrame`: `start`, `read` until done, `stop`; or a ``with`` block, which does the outer two.

    To write one, give it `tool_names` and `_read`; override `_start` and `_stop` where there is something to open.
    A tool without a pose is data (`ToolStatus`), not an exception. One thread at a time may use a tracker, but
    `stop` may be called from any.

    Parameters
    ----------
    clock : Clock or None
        The clock of `arrival_s`; the machine's own by default.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = SystemClock() if clock is None else clock
        self.counters = LineCounters()
        self._stopping = Event()
        self._running = False
        self._since_freeze = 0
        self._next_attempt_s = -math.inf

    @property
    @abstractmethod
    def tool_names(self) -> tuple[str, ...]:
        """Names of the tools; where tools may be plugged in, those known so far."""

    @property
    def is_running(self) -> bool:
        """Whether `start` was called and `stop` was not."""
        return self._running

    @property
    def is_finished(self) -> bool:
        """Whether no frame will ever follow (the end of a recording); a live device never finishes."""
        return False

    @property
    def reconnects(self) -> bool:
        """Whether `read` after a `TransportError` tries to find the device again."""
        return False

    @property
    def is_live(self) -> bool:
        """Whether a device is behind it whose frames are lost, or wrongly timed, when they are read late."""
        return False

    def now_s(self) -> float:
        """Return the present on the clock of `arrival_s` (a replay has its own), s."""
        return self.clock.now_s()

    def start(self) -> None:
        """Open the device and begin to track; does nothing where it already runs."""
        if self._running:
            return
        self._stopping.clear()
        self._start()
        self._running = True
        if self.is_live:
            HASTE.begin()

    def interrupt(self) -> None:
        """End a `read` that waits, from any thread; what follows can only be `stop`."""
        self._stopping.set()

    def stop(self) -> None:
        """End tracking and close the device; does nothing where it does not run. Interrupts a `read` that waits."""
        self.interrupt()
        if self._running:
            self._running = False
            if self.is_live:
                HASTE.end()
            self._stop()

    def read(self, timeout_s: float = 1.0) -> TrackerFrame | None:
        """Return the next frame, or None where none came within `timeout_s` or none will come.

        Parameters
        ----------
        timeout_s : float
            Longest wait, s, ≥ 0.

        Raises
        ------
        TrackerError
            Where the tracker was not started, or the device refuses.
        TransportError
            Where the line is lost.
        """
        if not timeout_s >= 0.0:
            raise DeviceInputError(f"read: the timeout must be ≥ 0 s, got {timeout_s!r}")
        if not self._running:
            raise TrackerError(f"{type(self).__name__}: read before start(); use a with block or call start() first")
        frame = self._read(timeout_s)
        if frame is not None and self.is_live:
            self._since_freeze += 1
            if self._since_freeze >= _FREEZE_EVERY:
                self._since_freeze = 0
                HASTE.go_on()
        return frame

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _may_reconnect(self, timeout_s: float) -> bool:
        """Wait, within the timeout, until the next try to find a lost device is due; tell whether it is.

        Tries are a quarter of a second apart, so a caller that just reads on does not spin.
        """
        now_s = self.clock.now_s()
        self.clock.wait_until(min(self._next_attempt_s, now_s + timeout_s), self._stopping)
        now_s = self.clock.now_s()
        if now_s < self._next_attempt_s or self._stopping.is_set():
            return False
        self._next_attempt_s = now_s + _ATTEMPT_EVERY_S
        return True

    def _start(self) -> None:  # noqa: B027 - not every tracker has something to open
        """Open the device."""

    def _stop(self) -> None:  # noqa: B027
        """Close the device."""

    @abstractmethod
    def _read(self, timeout_s: float) -> TrackerFrame | None:
        """Return the next frame, or None after `timeout_s`."""
