"""The clock of an emulated device: it runs with the loop that serves it, and stands still while that is held up."""

from __future__ import annotations

from threading import Event

from devices.clock import Clock

__all__ = ["PacedClock"]


class PacedClock(Clock):
    """Device time for an emulator whose process shares its machine with others.

    A real device answers within a millisecond, whatever the host's machine does; an emulator that is not run for 40 ms
    would skip two frames that no client could have asked for. So its time moves on by `turn` only, by no more than the
    loop meant to wait, and what it was held up is made good at 1.25 times the speed: frames come late, as over a slow
    line, and each of them stands for at least 4/5 of a period. A client that does not ask for a whole period
    loses the frame, as it would with the device.

    Parameters
    ----------
    clock : Clock
        Real time.
    """

    #: how much longer than meant a wait may take, s; a sound machine stays far below
    _LATE_S = 0.002
    _CATCH_UP = 0.25
    #: beyond this (a suspended machine) the time is not made good, s
    _MOST_BEHIND_S = 1.0

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._now_s = self._seen_s = clock.now_s()
        #: what the device was held up in all, s
        self.held_up_s = 0.0

    def now_s(self) -> float:
        """Return device time at the last turn, s."""
        return self._now_s

    def unix_s(self, time_s: float) -> float:
        """Return the Unix time of a reading."""
        return self._clock.unix_s(time_s)

    def wait_until(self, time_s: float, interrupt: Event | None = None) -> None:
        """Sleep until device time is `time_s`, or until `interrupt` is set: what is meant passes for the device too."""
        meant_s = max(0.0, time_s - self._now_s)
        self._clock.wait_until(self._clock.now_s() + meant_s, interrupt)
        self.turn(meant_s)

    def real_s(self, device_s: float) -> float:
        """Return the real time in which `device_s` of device time pass from now on, s."""
        behind = self._seen_s - self._now_s > 1e-6
        return device_s / (1.0 + self._CATCH_UP) if behind else device_s

    def is_held_up(self, meant_s: float) -> bool:
        """Whether the loop comes later than it meant to when it began to wait for at most `meant_s`."""
        return self._clock.now_s() - self._seen_s > meant_s + self._LATE_S

    def turn(self, meant_s: float) -> None:
        """Move on to the present, as far as a loop that meant to wait for at most `meant_s` may have seen it."""
        now_s = self._clock.now_s()
        passed_s, self._seen_s = now_s - self._seen_s, now_s
        step_s = min(passed_s, meant_s + self._LATE_S)
        self.held_up_s += passed_s - step_s
        behind_s = now_s - (self._now_s + step_s)
        if behind_s > self._MOST_BEHIND_S:
            step_s += behind_s
        else:
            step_s += min(behind_s, self._CATCH_UP * step_s)
        self._now_s += step_s
