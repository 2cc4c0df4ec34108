"""The stream: newest frame only, honest counters, errors to the caller, an end that always comes."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from devices import (
    ManualClock,
    ReplayTracker,
    SimulatedTracker,
    Stream,
    Tracker,
    TrackerError,
    TrackerFrame,
    TransportError,
)


class Script(Tracker):
    """Plays a list of frames and errors; afterwards it is silent until stopped."""

    def __init__(self, *steps: TrackerFrame | Exception | None, reconnects: bool = False, deaf: bool = False) -> None:
        super().__init__(ManualClock())
        self.steps = list(steps)
        self.played = threading.Event()
        self._reconnects, self._deaf = reconnects, deaf

    @property
    def tool_names(self) -> tuple[str, ...]:
        return ()

    @property
    def reconnects(self) -> bool:
        return self._reconnects

    def _read(self, timeout_s: float) -> TrackerFrame | None:
        if not self.steps:
            self.played.set()
            # a deaf one ignores its timeout, as a driver may that hangs in the kernel; only stop() wakes it
            self._stopping.wait(30.0 if self._deaf else timeout_s)
            return None
        step = self.steps.pop(0)
        if isinstance(step, Exception):
            raise step
        return step


def frame(number: int) -> TrackerFrame:
    return TrackerFrame(number, 0.1 * number, 0.1 * number)


def test_every_frame_reaches_the_callback_and_the_newest_the_mailbox() -> None:
    tracker = SimulatedTracker({"a": [(0.0, np.eye(4)), (2.0, np.eye(4))]}, dropout=0.2, seed=1, clock=ManualClock())
    expected = [f.number for f in tracker.frames()]
    seen: list[int] = []
    with Stream(tracker, on_frame=lambda f: seen.append(f.number)) as stream:
        assert stream.join(20.0)
        assert stream.latest().number == expected[-1]
    assert seen == expected
    assert stream.counters.frames == len(expected)
    assert stream.counters.gaps == expected[-1] - expected[0] + 1 - len(expected)
    assert stream.counters.unread == len(expected) - 1


def test_repeated_numbers_are_old_data() -> None:
    first, again, later = frame(3), frame(3), frame(7)
    tracker = Script(first, again, None, later)
    with Stream(tracker) as stream:
        assert tracker.played.wait(10.0)
        assert stream.latest() is later
        assert stream.counters.frames == 3
        assert stream.counters.repeated == 1
        assert stream.counters.gaps == 3


def test_a_step_of_three_is_no_gap() -> None:
    tracker = Script(frame(3), frame(6), frame(12))
    with Stream(tracker, number_step=3) as stream:
        assert tracker.played.wait(10.0)
        assert stream.counters.gaps == 1


def test_wait_returns_something_newer() -> None:
    recorded = [frame(0), frame(1)]
    with Stream(ReplayTracker(recorded, clock=ManualClock())) as stream:
        newest = stream.wait(None, 10.0)
        while newest is not None and newest.number < 1:
            newest = stream.wait(newest, 10.0)
        assert newest is recorded[1]
        assert stream.wait(newest, 10.0) is None  # the end, not a timeout
        assert not stream.is_running


def test_an_error_is_handed_over_once_and_ends_the_stream() -> None:
    with Stream(Script(frame(1), TrackerError("tool broken", 0x13))) as stream:
        assert stream.join(10.0)
        with pytest.raises(TrackerError, match="tool broken"):
            stream.latest()
        assert stream.latest().number == 1
        assert stream.counters.errors == 1


def test_a_tracker_that_reconnects_goes_on_after_a_lost_line() -> None:
    tracker = Script(frame(1), TransportError("unplugged"), frame(9), reconnects=True)
    with Stream(tracker) as stream:
        assert tracker.played.wait(10.0)
        with pytest.raises(TransportError, match="unplugged"):
            stream.latest()
        assert stream.latest().number == 9
        assert stream.is_running
    with Stream(Script(frame(1), TransportError("unplugged"), frame(9))) as stream:
        assert stream.join(10.0)


def test_an_error_in_the_callback_belongs_to_the_caller() -> None:
    def fail(_: TrackerFrame) -> None:
        raise ZeroDivisionError("callback")

    with Stream(Script(frame(1)), on_frame=fail) as stream:
        assert stream.join(10.0)
        with pytest.raises(ZeroDivisionError):
            stream.wait(None, 10.0)


@pytest.mark.parametrize("deaf", [False, True])
def test_it_stops_on_a_silent_line(deaf: bool) -> None:
    tracker = Script(deaf=deaf)
    stream = Stream(tracker)
    stream.start()
    assert tracker.played.wait(10.0)
    thread = next(t for t in threading.enumerate() if t.name == "stream of Script")
    stream.stop()
    assert not tracker.is_running
    thread.join(10.0)
    assert not thread.is_alive()


def test_an_error_at_the_start_is_raised_at_the_start() -> None:
    class Absent(Script):
        def _start(self) -> None:
            raise TransportError("no such port")

    with pytest.raises(TransportError, match="no such port"):
        Stream(Absent()).start()
    assert issubclass(TransportError, OSError)
