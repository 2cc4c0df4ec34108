"""`guidance track`: a live table of what a tracker sees, and a recording of it."""

from __future__ import annotations

import math
import signal
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from devices.errors import DeviceError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.recording import Recorder
from devices.registry import open_tracker
from devices.scheduling import hurry_this_thread
from devices.stream import Stream
from devices.tracker import Tracker

__all__ = ["Session", "terminated_as_interrupted", "track"]

_REDRAW_S = 0.1
_STALE_S = 0.5
_COLOURS = {ToolStatus.OK: "green", ToolStatus.MISSING: "yellow", ToolStatus.DISABLED: "dim"}


class Session:
    """What the table shows: the newest pose of each tool, and how often good ones came lately.

    Parameters
    ----------
    tracker : Tracker
    """

    _WINDOW = 120

    def __init__(self, tracker: Tracker) -> None:
        self.tracker = tracker
        self.note = ""
        self._newest: dict[str, tuple[TrackerFrame, ToolPose]] = {}
        self._arrivals: deque[float] = deque(maxlen=self._WINDOW)

    def add(self, frame: TrackerFrame) -> None:
        """Take the next frame."""
        self._arrivals.append(frame.arrival_s)
        for name, pose in list(frame.tools.items()):
            self._newest[name] = (frame, pose)

    @property
    def rate_hz(self) -> float:
        """Frames per second over the last two seconds or so; NaN before the second frame."""
        times = list(self._arrivals)
        if len(times) < 2 or times[-1] <= times[0]:
            return math.nan
        return (len(times) - 1) / (times[-1] - times[0])

    def table(self, stream: Stream, now_s: float) -> Table:
        """The present as a table: status, position, error, rate and age of each tool."""
        counters = stream.counters
        line = f"{counters.frames} frames, {counters.gaps} lost, {counters.crc_errors} CRC errors"
        line += f", {counters.reconnects} reconnections" if counters.reconnects else ""
        table = Table(title=type(self.tracker).__name__, caption=f"{line}  {self.note}".strip(), box=box.SIMPLE_HEAD)
        table.add_column("tool", no_wrap=True)
        table.add_column("status")
        for heading in ("x mm", "y mm", "z mm", "error mm", "rate Hz", "age ms", "frame"):
            table.add_column(heading, justify="right", no_wrap=True)
        names = dict.fromkeys((*self.tracker.tool_names, *self._newest))
        for name in names:
            table.add_row(*self._row(name, now_s))
        return table

    def _row(self, name: str, now_s: float) -> list[str]:
        if name not in self._newest:
            return [name, "[dim]no frame yet[/]", *["–"] * 7]
        frame, pose = self._newest[name]
        age_s = now_s - frame.time_s
        colour, status = _COLOURS.get(pose.status, "red"), pose.status.value
        if age_s > _STALE_S:
            colour, status = "red", f"stale ({status})"
        place = ["–"] * 3
        if pose.T_tracker_tool is not None:
            place = [f"{value:.2f}" for value in pose.T_tracker_tool[:3, 3]]
        error = "–" if math.isnan(pose.error_mm) else f"{pose.error_mm:.3f}"
        rate = "–" if math.isnan(self.rate_hz) else f"{self.rate_hz:.1f}"
        return [name, f"[{colour}]{status}[/]", *place, error, rate, f"{1e3 * age_s:.0f}", str(frame.number)]


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does, so that trackers are stopped and files closed."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def track(
    url: Annotated[
        str, typer.Argument(help="sim:PLAN.json, replay:FILE, ndi:/dev/ttyUSB0?rom=A.rom, igtl://HOST:PORT")
    ],
    record: Annotated[Path | None, typer.Option(help="Write every frame to this file (JSON lines).")] = None,
    duration: Annotated[float | None, typer.Option(help="Stop after so many seconds.", min=0.0)] = None,
) -> None:
    """Show a live table of the tools: status, position, error, rate, age; until the recording ends or Ctrl-C."""
    console = Console()
    try:
        with ExitStack() as stack:
            stack.enter_context(terminated_as_interrupted())
            tracker = open_tracker(url)
            if tracker.is_live:
                hurry_this_thread(real_time=False)  # drawing must not keep the reader waiting
            session = Session(tracker)
            recorder = None if record is None else stack.enter_context(Recorder(record, source=url))

            def take(frame: TrackerFrame) -> None:
                session.add(frame)
                if recorder is not None:
                    recorder.write(frame)

            stream = stack.enter_context(Stream(tracker, on_frame=take))
            live = stack.enter_context(Live(console=console, refresh_per_second=10, transient=False))
            _watch(session, stream, live, duration)
    except KeyboardInterrupt:
        pass
    except (DeviceError, OSError) as error:
        typer.echo(f"track: {error}", err=True)
        raise typer.Exit(2) from None
    if record is not None:
        console.print(f"{stream.counters.frames} frames in {record}")


def _watch(session: Session, stream: Stream, live: Live, duration_s: float | None) -> None:
    """Redraw until the stream ends, or the time is up; what a tracker that reconnects complains of becomes a note."""
    clock = session.tracker.clock
    end_s = math.inf if duration_s is None else clock.now_s() + duration_s
    while clock.now_s() < end_s:
        ended = stream.join(_REDRAW_S)
        try:
            stream.latest()
        except DeviceError as error:
            if not session.tracker.reconnects:
                raise
            session.note = f"[red]{error}[/]"
        live.update(session.table(stream, session.tracker.now_s()))
        if ended:
            return
