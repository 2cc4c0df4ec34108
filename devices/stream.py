"""A reader thread with a mailbox that holds the newest frame only: the consumer never works on a backlog."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from devices.errors import DeviceError, TransportError
from devices.frame import TrackerFrame
from devices.scheduling import AS_ANY_OTHER, hurry_this_thread
from devices.tracker import Tracker

__all__ = ["Stream", "StreamCounters"]

_POLL_S = 0.1
_RETRY_S = 0.2
_JOIN_S = 0.4
#: frames that may wait for the callback before the reader waits too
_MOST_WAITING = 256


@dataclass(frozen=True)
class StreamCounters:
    """What a `Stream` has counted since it started.

    Parameters
    ----------
    frames : int
        Frames received.
    gaps : int
        Frames that the device numbered and that never came.
    repeated : int
        Frames that carried no newer number: old data, not put into the mailbox.
    unread : int
        Frames that a newer one replaced in the mailbox before anyone took them.
    crc_errors, timeouts, reconnects, errors : int
        Bad checksums, missing replies and reconnections as the tracker counted them, and errors raised by it.
    """

    frames: int = 0
    gaps: int = 0
    repeated: int = 0
    unread: int = 0
    crc_errors: int = 0
    timeouts: int = 0
    reconnects: int = 0
    errors: int = 0


class Stream:
    """Read a tracker on a thread of its own and keep its newest frame.

    The reader thread does nothing else, and asks the operating system to be run before others where the tracker is
    live; the callback runs on a second thread, so that one that takes 100 ms now and then costs no frame.

    Parameters
    ----------
    tracker : Tracker
        Started by `start` and stopped by `stop`.
    on_frame : callable or None
        Called on a thread of its own with every frame that is newer than the last: in order, none left out. Where
        256 frames wait for it, the reader waits too, and a live tracker loses frames (`counters.gaps`).
        An error that it raises ends the stream and is handed to the caller.
    number_step : int
        How far the device's frame number moves from one frame to the next (a tracker at 20 Hz may count at 60 Hz).
    hurry : bool
        False leaves the threads for a live tracker scheduled as any other (see `devices.scheduling`).

    Notes
    -----
    An error of the tracker is raised once, by the next `latest` or `wait`, whichever comes first. After a
    `TransportError` the thread reads on where the tracker can reconnect; any other error ends the stream.

    Examples
    --------
    >>> import numpy as np
    >>> from devices import ManualClock, SimulatedTracker
    >>> tracker = SimulatedTracker({"needle": [(0.0, np.eye(4)), (1.0, np.eye(4))]}, clock=ManualClock())
    >>> with Stream(tracker) as stream:
    ...     finished = stream.join(10.0)
    ...     stream.latest().number, stream.counters.gaps
    (60, 0)
    """

    def __init__(
        self,
        tracker: Tracker,
        on_frame: Callable[[TrackerFrame], None] | None = None,
        number_step: int = 1,
        hurry: bool = True,
    ) -> None:
        self.tracker = tracker
        self._on_frame = on_frame
        self._number_step = max(1, int(number_step))
        self._hurry = hurry
        self._condition = threading.Condition()
        self._newest: TrackerFrame | None = None
        self._taken = True
        self._error: BaseException | None = None
        self._frames = self._gaps = self._repeated = self._unread = self._errors = 0
        self._last_number: int | None = None
        self._stopping = threading.Event()
        self._waiting: deque[TrackerFrame] = deque()
        self._read_out = True
        self._alive: set[threading.Thread] = set()
        self._threads: list[threading.Thread] = []
        #: how the operating system schedules the reader thread, in words
        self.scheduling = AS_ANY_OTHER

    @property
    def is_running(self) -> bool:
        """Whether it reads, or frames wait for the callback; False after a recording's end or an error that ends it."""
        return bool(self._alive)

    @property
    def counters(self) -> StreamCounters:
        """The counts so far."""
        with self._condition:
            line = self.tracker.counters
            return StreamCounters(
                self._frames,
                self._gaps,
                self._repeated + line.repeated,
                self._unread,
                line.crc_errors,
                line.timeouts,
                line.reconnects,
                self._errors,
            )

    def start(self) -> None:
        """Start the tracker, then the threads; an error of the tracker's start is raised here."""
        if self._threads:
            return
        self.tracker.start()
        self._stopping.clear()
        self._read_out = False
        name = f"stream of {type(self.tracker).__name__}"
        self._threads = [threading.Thread(target=self._run, name=name, daemon=True)]
        if self._on_frame is not None:
            self._threads.append(threading.Thread(target=self._call, name=f"{name}, callback", daemon=True))
        self._alive = set(self._threads)
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop threads and tracker within 0.5 s, also where the line is silent or the callback does not return."""
        self._stopping.set()
        self.tracker.interrupt()
        with self._condition:
            self._condition.notify_all()
        self._join(_JOIN_S)
        # a thread that did not end in time sits in the tracker: closing the device under it makes it raise and end
        self.tracker.stop()
        with self._condition:
            self._waiting.clear()
        self._threads = []

    def latest(self) -> TrackerFrame | None:
        """Return the newest frame, or None before the first; look at its `arrival_s`, it may be old.

        Raises
        ------
        DeviceError
            What the tracker raised since the last call, once.
        """
        with self._condition:
            self._raise_pending()
            self._taken = True
            return self._newest

    def wait(self, after: TrackerFrame | None = None, timeout_s: float = 1.0) -> TrackerFrame | None:
        """Return the newest frame as soon as it is another one than `after`; None after `timeout_s` or at the end."""
        with self._condition:
            self._condition.wait_for(
                lambda: self._newest is not after or self._error is not None or not self.is_running, timeout_s
            )
            self._raise_pending()
            if self._newest is after:
                return None
            self._taken = True
            return self._newest

    def join(self, timeout_s: float) -> bool:
        """Wait until the stream has ended by itself (a recording's end, an error); tell whether it has."""
        self._join(timeout_s)
        return not self.is_running

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _join(self, timeout_s: float) -> None:
        """Wait for the threads, both together no longer than that; a callback that calls this does not wait."""
        if threading.current_thread() in self._threads:
            return
        with self._condition:
            ended = self._condition.wait_for(lambda: not self._alive, timeout_s)
        for thread in self._threads if ended else ():
            thread.join()

    def _raise_pending(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    # the reader thread

    def _run(self) -> None:
        try:
            if self._hurry and self.tracker.is_live:
                self.scheduling = hurry_this_thread()
            self._read_on()
        except BaseException as error:  # every error of this thread belongs to the caller
            self._hand_over(error)
        finally:
            self._end()

    def _read_on(self) -> None:
        while not self._stopping.is_set() and not self.tracker.is_finished:
            try:
                frame = self.tracker.read(_POLL_S)
            except TransportError as error:
                self._hand_over(error)
                if not self.tracker.reconnects:
                    return
                self._stopping.wait(_RETRY_S)
                continue
            if frame is not None:
                self._accept(frame)

    def _hand_over(self, error: BaseException) -> None:
        if self._stopping.is_set() and isinstance(error, DeviceError):
            return
        with self._condition:
            self._errors += 1
            self._error = error
            self._condition.notify_all()

    def _end(self) -> None:
        with self._condition:
            self._read_out = True
            self._alive.discard(threading.current_thread())
            self._condition.notify_all()

    def _accept(self, frame: TrackerFrame) -> None:
        with self._condition:
            self._frames += 1
            last = self._last_number
            if last is not None and frame.number == last:
                self._repeated += 1
                return
            if last is not None and frame.number > last:
                self._gaps += (frame.number - last - 1) // self._number_step
            self._last_number = frame.number
            self._unread += not self._taken
            self._newest, self._taken = frame, False
            if self._on_frame is not None:
                self._condition.wait_for(lambda: len(self._waiting) < _MOST_WAITING or self._stopping.is_set())
                self._waiting.append(frame)
            self._condition.notify_all()

    # the callback's thread

    def _call(self) -> None:
        assert self._on_frame is not None
        if self._hurry and self.tracker.is_live:
            # or the reader would wait for Python's lock whenever the system kept this thread waiting with it
            hurry_this_thread(real_time=False)
        try:
            while True:
                with self._condition:
                    self._condition.wait_for(lambda: self._waiting or self._read_out)
                    if not self._waiting:
                        return
                    frame = self._waiting.popleft()
                    if len(self._waiting) == _MOST_WAITING - 1:
                        self._condition.notify_all()
                self._on_frame(frame)
        except BaseException as error:
            self._hand_over(error)
            self._stopping.set()
            self.tracker.interrupt()
        finally:
            self._end()
