"""Watching: poses go to a monitor as they arrive, ticks fill the silence."""

from __future__ import annotations

from collections.abc import Iterator

from devices.errors import TransportError
from devices.frame import TrackerFrame
from devices.stream import Stream
from devices.tracker import Tracker
from guidance.event_log import EventLog
from guidance.monitor import Monitor
from guidance.states import Report


def watch(
    source: Tracker | Stream, monitor: Monitor, log: EventLog | None = None, timeout_s: float = 0.1
) -> Iterator[Report]:
    """Yield a report per frame, and one per `timeout_s` of silence, until the source ends or the caller stops.

    Parameters
    ----------
    source : devices.Tracker or devices.Stream
        Started here, and stopped when the iteration ends. A tracker gives every frame (replay, simulation); a stream
        gives the newest, so a slow consumer never falls behind a live device.
    monitor : Monitor
    log : EventLog, optional
    timeout_s : float
        Longest silence without a report, s.

    Raises
    ------
    devices.TransportError
        If the line is lost and the tracker cannot find it again; while it can, the reports age and become UNKNOWN.
    """
    tracker = source.tracker if isinstance(source, Stream) else source
    last: TrackerFrame | None = None
    with source:
        while True:
            frame = None
            try:
                frame = source.wait(last, timeout_s) if isinstance(source, Stream) else source.read(timeout_s)
            except TransportError:
                if not tracker.reconnects:
                    raise
            if frame is not None:
                last = frame
                report = monitor.update(frame)
                if log is not None:
                    log.frame(frame, report)
            elif tracker.is_finished or (isinstance(source, Stream) and not source.is_running):
                return
            else:
                now = tracker.now_s()
                report = monitor.tick(now)
                if log is not None:
                    log.tick(now, report)
            yield report
