"""NDI trackers as a `Tracker`: Polaris and Aurora over a serial line, Vega over TCP."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from devices.clock import Clock
from devices.errors import DeviceInputError, ProtocolError, TrackerError, TransportError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.ndi.binary_replies import decode_bx, decode_bx2
from devices.ndi.replies import Option, PoseReport, tool_pose
from devices.ndi.rom import read_rom
from devices.ndi.session import Interrupted, Session, SilentLine
from devices.ndi.text_replies import decode_tx
from devices.timing import ClockLine, warm_up
from devices.tracker import Tracker
from devices.transport import Line, SerialLine, TcpLine

__all__ = ["NdiTracker", "ndi_line"]

_MODES = ("auto", "TX", "BX", "BX2")
_DEFAULT_PORT = 8765
_SETUP_TRIES = 3
#: errors in tracking replies that say that the device no longer tracks: it was reset or restarted
_NOT_TRACKING = (0x0C, 0x10)
_UNKNOWN_COMMAND = 0x01
_PORT_OCCUPIED = 0x40
#: a tool whose own frame number is farther behind the newest is old data
_STALE_FRAMES = 6
_PLUG_AGAIN_S = 2.0
#: a line that says nothing for so long, s, and twice in a row, is lost
_SILENT_S = 0.75
_WRAP = 1 << 32


def ndi_line(place: str) -> Line:
    """Line to a tracker at ``tcp://HOST[:PORT]`` (port 8765 by default) or at the name of a serial port."""
    if not place.startswith("tcp://"):
        return SerialLine(place)
    host, colon, port = place.removeprefix("tcp://").rstrip("/").rpartition(":")
    if not colon:
        host, port = port, str(_DEFAULT_PORT)
    if not port.isdigit():
        raise DeviceInputError(f"{place!r}: expected tcp://HOST:PORT")
    return TcpLine(host.strip("[]"), int(port))


class NdiTracker(Tracker):
    """A Polaris, Vega or Aurora.

    `start` wakes the device from any state, agrees on a speed, loads and enables the tools, and starts tracking;
    `read` asks for poses until a new frame is there; `stop` ends tracking and leaves the device at 9600 baud. Damaged
    replies are counted, dropped and asked for again. After 0.8 s without an answer, or where the line is lost,
    `read` raises `TransportError`; the next `read` starts afresh.

    Parameters
    ----------
    place : str or Line
        ``/dev/ttyUSB0``, ``COM3``, ``tcp://HOST:PORT``, or a line.
    roms : sequence of str, Path or bytes
        Definitions of passive tools.
    names : sequence of str
        Names of those tools, in order; by default the file's stem, or the part number.
    wired : bool
        Whether tools on cables are initialised too; they are named by their part numbers.
    baud_rate : int
        Highest speed to try on a serial line.
    mode : str
        ``"TX"``, ``"BX"`` or ``"BX2"``; ``"auto"`` takes the best that the device has.
    markers, strays : bool
        Whether to ask for the tools' single markers and for markers that belong to none.
    latency_s : float
        From measurement to the reply: what arrivals are set back by.
    reply_timeout_s, command_timeout_s : float
        How long a tracking reply may take, and any other (INIT, PINIT and TSTART 2.5 times as long).
    clock : Clock or None

    Raises
    ------
    DeviceInputError
        Where an argument or a tool definition is wrong; at once, before anything is sent.
    """

    def __init__(
        self,
        place: str | Line,
        roms: Sequence[str | Path | bytes] = (),
        names: Sequence[str] = (),
        wired: bool = True,
        baud_rate: int = 115200,
        mode: str = "auto",
        markers: bool = False,
        strays: bool = False,
        latency_s: float = 0.0,
        reply_timeout_s: float = 0.4,
        command_timeout_s: float = 2.0,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(clock)
        if mode not in _MODES:
            raise DeviceInputError(f"mode: expected one of {', '.join(_MODES)}, got {mode!r}")
        if len(names) > len(roms):
            raise DeviceInputError(f"{len(names)} names for {len(roms)} tool definitions")
        if not (latency_s >= 0.0 and reply_timeout_s > 0.0):
            raise DeviceInputError(
                f"expected latency_s ≥ 0 and reply_timeout_s > 0, got {latency_s}, {reply_timeout_s}"
            )
        self.line = ndi_line(place) if isinstance(place, str) else place
        self._definitions = [read_rom(rom) for rom in roms]
        self._names: list[str] = []
        for k, (rom, definition) in enumerate(zip(roms, self._definitions, strict=True)):
            stem = definition.part_number or f"tool-{k}" if isinstance(rom, bytes) else Path(rom).stem
            self._names.append(_unused(names[k] if k < len(names) else stem, self._names))
        self._wired, self._baud_rate, self._wanted_mode = wired, baud_rate, mode
        self._options = Option.POSES | Option.OUT_OF_VOLUME
        self._options |= Option.TOOL_MARKERS if markers else Option(0)
        self._options |= Option.STRAYS if strays else Option(0)
        self.latency_s, self._reply_timeout_s = latency_s, reply_timeout_s
        self._lock = threading.RLock()
        self._session = Session(self.line, self.counters, self._stopping, command_timeout_s)
        self._tools: dict[int, str] = {}
        self._tracking = False
        self._silent = self._refused = self._behind = 0
        self._last_raw = -1
        self._last_reply: str | bytes = b""
        self._queue: deque[TrackerFrame] = deque()
        self._number: int | None = None
        self._clock_line = ClockLine()
        self._next_poll_s = self._plugged_s = self._new_s = -np.inf
        self._period_s = 1.0 / 60.0
        self._slow_s = 0.0
        #: reply in use, and the system status and alerts of the last one
        self.mode = mode
        self.system_status = 0
        self.alerts: tuple[tuple[int, int], ...] = ()

    @property
    def tool_names(self) -> tuple[str, ...]:
        """Names of the tools; those on cables once tracking has started."""
        return tuple(self._tools.values()) or tuple(self._names)

    @property
    def reconnects(self) -> bool:
        """Whether a lost line is looked for again: always."""
        return True

    @property
    def is_live(self) -> bool:
        """Whether frames that are read late are lost: a device keeps its newest frame only."""
        return True

    # start and stop

    def _start(self) -> None:
        self._number = None
        warm_up()
        with self._lock:
            self._connect()

    def _stop(self) -> None:
        with self._lock:
            self._session.close(self._tracking)
            self._tracking = False

    def _connect(self) -> None:
        """Set up everything; a damaged or missing reply on the way starts it over, a refusal does not."""
        failure: Exception | None = None
        self._queue.clear()
        for _ in range(_SETUP_TRIES):
            try:
                self._set_up()
                return
            except Interrupted:
                self.line.close()
                raise
            except (ProtocolError, SilentLine) as error:
                failure = error
            except (TransportError, TrackerError):
                self._session.close(False)
                raise
        self._session.close(False)
        raise TransportError(f"{self.line}: cannot be set up: {failure}") from failure

    def _set_up(self) -> None:
        session = self._session
        session.wake()
        session.agree_on_speed(self._baud_rate, lambda s: self.clock.wait_until(self.clock.now_s() + s, self._stopping))
        self.mode = self._wanted_mode
        if self.mode == "auto":
            self.mode = "BX2" if session.interface_version() >= 3 else "BX"
        session.free_stale()
        self._tools = {}
        for name, definition in zip(self._names, self._definitions, strict=True):
            self._tools[session.load(definition)] = name
        self._enable_wired()
        if not self._tools:
            raise TrackerError(f"{self.line}: no tools: none plugged in, and no tool definition (rom=) was given")
        self._start_tracking()

    def _enable_wired(self) -> None:
        if self._wired:
            for handle, name in self._session.enable_wired(list(self._tools)).items():
                self._tools[handle] = _unused(name, list(self._tools.values()))

    def _start_tracking(self) -> None:
        self._session.start_tracking()
        self._tracking = True
        self._silent = self._refused = self._behind = 0
        self._last_raw = -1
        self._last_reply = b""
        self._clock_line = ClockLine()

    # reading

    def _read(self, timeout_s: float) -> TrackerFrame | None:
        end_s = self.clock.now_s() + timeout_s
        with self._lock:
            if self._stopping.is_set() or not self._running:
                return None
            try:
                if not self._tracking:
                    if not self._may_reconnect(timeout_s):
                        return None
                    self._connect()
                    self.counters.reconnects += 1
                while True:
                    frame = self._poll()
                    if frame is not None or self.clock.now_s() >= end_s or self._stopping.is_set():
                        return frame
            except Interrupted:
                return None
            except (TransportError, TrackerError):
                self._tracking = False
                self.line.close()
                raise

    def _poll(self) -> TrackerFrame | None:
        """Ask once, unless a frame of the last reply waits; None where there is nothing new or nothing whole."""
        if self._queue:
            return self._queue.popleft()
        due_s = max(self._next_poll_s, self.clock.now_s())
        self.clock.wait_until(self._next_poll_s, self._stopping)
        try:
            reports = self._ask()
        except ProtocolError:
            return None
        except Interrupted:
            raise
        except SilentLine as error:
            self._silent += 1
            if self._silent < 2 or self._silent * self._reply_timeout_s < _SILENT_S:
                return None
            raise TransportError(f"{self.line}: the tracker has fallen silent") from error
        except TrackerError as error:
            self._accept_refusal(error)
            return None
        self._silent = self._refused = 0
        arrival_s = self.clock.now_s()
        self._slow_s = min(self._period_s, max(arrival_s - due_s, 0.98 * self._slow_s))
        frames = [self._frame(report, arrival_s) for report in reports]
        self._queue.extend(frame for frame in frames if frame is not None)
        self._plan_next(arrival_s, bool(self._queue))
        if any(report.system_status & _PORT_OCCUPIED for report in reports) and self._wired:
            self._plug_in(arrival_s)
        return self._queue.popleft() if self._queue else None

    def _ask(self) -> list[PoseReport]:
        arguments = f"{int(self._options):04X}"
        if self.mode == "BX2":
            wanted = {0: "none", Option.TOOL_MARKERS: "tools", Option.STRAYS: "strays"}
            kind = wanted.get(self._options & (Option.TOOL_MARKERS | Option.STRAYS), "all")
            arguments = f"--6d=tools --3d={kind} --1d=buttons"
        reply = self._session.ask(self.mode, arguments, self._reply_timeout_s)
        if reply == self._last_reply:  # as most are: no newer frame, and nothing in it to decode
            self.counters.repeated += self.mode != "BX2"
            return []
        self._last_reply = reply
        try:
            if self.mode == "TX" and isinstance(reply, str):
                return [decode_tx(reply, self._options)]
            if self.mode == "BX" and isinstance(reply, bytes):
                return [decode_bx(reply, self._options)]
            if self.mode == "BX2" and isinstance(reply, bytes):
                reports = decode_bx2(reply)
                self.alerts = next((report.alerts for report in reports if report.alerts), self.alerts)
                framed = [report for report in reports if report.handles]
                return sorted(framed, key=lambda report: self._ahead(report.handles[0].frame or 0))
            raise ProtocolError(f"{self.mode}: a reply of the wrong kind: {reply[:40]!r}")
        except ProtocolError:
            self.counters.malformed += 1
            self._session.settle()
            raise

    def _accept_refusal(self, error: TrackerError) -> None:
        if error.code in _NOT_TRACKING:
            raise TransportError(f"{self.line}: the tracker no longer tracks, it was reset or switched off") from error
        if error.code == _UNKNOWN_COMMAND and self._wanted_mode == "auto" and self.mode != "TX":
            self.mode = "BX" if self.mode == "BX2" else "TX"
            return
        self._refused += 1
        if self._refused >= 5:
            raise error

    def _plan_next(self, arrival_s: float, new: bool) -> None:
        """Ask again half a frame later, earlier by what waking and asking took lately; if in vain, a little later."""
        wait_s = max(0.0, 0.5 * self._period_s - 2.0 * self._slow_s) if new else 0.05 * self._period_s
        self._next_poll_s = arrival_s + wait_s

    def _plug_in(self, now_s: float) -> None:
        """A tool was plugged in: it must be initialised and enabled, which is possible only while not tracking."""
        if now_s - self._plugged_s < _PLUG_AGAIN_S:
            return  # a status bit that will not go must not keep the others from being tracked
        self._plugged_s = now_s
        self._session.stop_tracking()
        self._tracking = False
        self._enable_wired()
        self._start_tracking()

    # frames

    def _frame(self, report: PoseReport, arrival_s: float) -> TrackerFrame | None:
        numbers = [handle.frame for handle in report.handles if handle.frame is not None]
        raw = max(numbers, key=self._ahead, default=None)
        if raw is None or not self._is_newer(raw):
            self.counters.repeated += 1
            return None
        ahead = 1
        if self._last_raw >= 0:
            ahead = self._ahead(raw)
            self._period_s += 0.1 * (min(0.1, (arrival_s - self._new_s) / ahead) - self._period_s)
        self._new_s = arrival_s
        self._last_raw = raw
        # after a reconnection the device counts anew; the numbers handed out never go back
        self._number = raw if self._number is None else self._number + ahead
        count = float(self._number) if report.device_time_s is None else report.device_time_s
        time_s = min(self._clock_line.add(count, arrival_s) - self.latency_s, arrival_s)
        self.system_status = report.system_status
        markers = bool(self._options & Option.TOOL_MARKERS)
        tools: dict[str, ToolPose] = {}
        for handle in report.handles:
            if handle.handle not in self._tools:
                continue
            pose = tool_pose(handle, markers)
            if (
                handle.frame is not None
                and (raw - handle.frame) % _WRAP > _STALE_FRAMES
                and pose.status is ToolStatus.OK
            ):
                pose = ToolPose(ToolStatus.INVALID, pose.T_tracker_tool, pose.error_mm, pose.markers_mm, pose.switches)
            tools[self._tools[handle.handle]] = pose
        strays = None
        if self._options & Option.STRAYS:
            strays = np.array(report.strays_mm or (), dtype=np.float64).reshape(-1, 3)
        return TrackerFrame(self._number, time_s, arrival_s, tools, strays)

    def _ahead(self, raw: int) -> int:
        """How far a raw frame number is ahead of the last one, across the counter's wrap at 2³²; negative behind."""
        if self._last_raw < 0:
            return raw
        return (raw - self._last_raw + _WRAP // 2) % _WRAP - _WRAP // 2

    def _is_newer(self, raw: int) -> bool:
        """Whether a frame is new; a late copy is not. A device that counts on from behind was restarted."""
        if self._ahead(raw) > 0 or self._last_raw < 0:
            self._behind = 0
            return True
        self._behind += raw != self._last_raw
        if self._behind < 30:
            return False
        self._behind, self._last_raw = 0, -1
        return True


def _unused(name: str, taken: Sequence[str]) -> str:
    """The name, or with the next free number behind it."""
    candidate, k = name, 2
    while candidate in taken:
        candidate, k = f"{name}-{k}", k + 1
    return candidate
