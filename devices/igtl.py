"""OpenIGTLink: receive poses as a `Tracker`, and send frames to any number of clients."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from devices.clock import Clock
from devices.errors import ProtocolError, TransportError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.igtl_groups import MessageGroups
from devices.igtl_messages import DEFAULT_PORT, Message, MessageReader, decode_poses, decode_status
from devices.igtl_server import IgtlServer
from devices.rotation import is_rigid
from devices.timing import ClockLine
from devices.tracker import Tracker
from devices.transport import TcpLine

__all__ = ["DEFAULT_PORT", "IgtlServer", "IgtlTracker"]

_SLICE_S = 0.02
#: a group of messages that does not go on for so long is a frame; a peer that was held up for less goes on in it
_PAUSE_S = 0.04
_POSES = ("TRANSFORM", "TDATA", "POSITION", "QTRANS")
_WANTED = frozenset((*_POSES, "STATUS"))


def _received_pose(message: Message, T: NDArray[np.float64]) -> ToolPose:
    """A pose that came is OK only where it is rigid and finite, and the sender does not say otherwise."""
    for key, value in message.metadata.items():
        if key.lower().endswith("status") and value.upper() != "OK":
            return ToolPose(ToolStatus.INVALID, None)
    return ToolPose(ToolStatus.OK, T) if is_rigid(T) else ToolPose(ToolStatus.INVALID, None)


class IgtlTracker(Tracker):
    """Poses from an OpenIGTLink server: TRANSFORM, TDATA and POSITION, in the order in which they were sent.

    A tool is named as the message is (``StylusTipToReference``). Messages with one header timestamp make one frame. A
    NaN, a matrix that is not rigid, a position without orientation or a status other than OK is a tool that is INVALID,
    never a pose; a STATUS message in a tool's name says that it has none.

    Parameters
    ----------
    host : str
    port : int
    latency_s : float
        From measurement to sending, where the sender gives no timestamps.
    clock : Clock or None
    """

    def __init__(self, host: str, port: int = DEFAULT_PORT, latency_s: float = 0.0, clock: Clock | None = None) -> None:
        super().__init__(clock)
        self.line = TcpLine(host, port)
        self.latency_s = latency_s
        self._reader = MessageReader(_WANTED)
        self._groups = MessageGroups()
        self._clock_line = ClockLine()
        self._queue: deque[TrackerFrame] = deque()
        self._names: dict[str, None] = {}
        self._number = -1
        self._idle_s = 0.0
        #: messages received, of any kind, and those of kinds that hold no poses
        self.messages = self.other_messages = 0
        #: header timestamp of the last frame made, Unix time; 0 where the sender gives none
        self.last_stamp_s = 0.0

    @property
    def tool_names(self) -> tuple[str, ...]:
        """Names that have come so far."""
        return tuple(self._names)

    @property
    def reconnects(self) -> bool:
        """Whether a lost connection is made again: always."""
        return True

    @property
    def is_live(self) -> bool:
        """Whether frames should be read at once: arrival times tell when."""
        return True

    def _start(self) -> None:
        self._open()

    def _open(self) -> None:
        self.line.open()
        self._reader, self._groups, self._clock_line = MessageReader(_WANTED), MessageGroups(), ClockLine()

    def _stop(self) -> None:
        self.line.close()

    def _read(self, timeout_s: float) -> TrackerFrame | None:
        if not self._queue and not self.line.is_open:
            if not self._may_reconnect(timeout_s):
                return None
            self._open()
            self.counters.reconnects += 1
        remaining_s = timeout_s
        while not self._queue and not self._stopping.is_set():
            slice_s = min(_SLICE_S, remaining_s)
            try:
                data = self.line.read(slice_s)
            except TransportError:
                if self._stopping.is_set():
                    return None
                raise
            if data:
                self._idle_s = 0.0
                self._take(data)
                continue
            self._idle_s += slice_s
            if self._groups.current and self._idle_s >= _PAUSE_S and not self._reader.pending:
                self._close_group()
            remaining_s -= _SLICE_S
            if remaining_s <= 0.0:
                break
        return self._queue.popleft() if self._queue else None

    def _take(self, data: bytes) -> None:
        for message in self._reader.feed(data):
            if isinstance(message, ProtocolError):
                self.counters.crc_errors += "checksum" in str(message)
                self.counters.malformed += "checksum" not in str(message)
                continue
            self.messages += 1
            try:
                self._accept(message)
            except ProtocolError:
                self.counters.malformed += 1
        if self._reader.lost:
            self.line.close()
            raise TransportError(f"{self.line}: what comes is not OpenIGTLink; the connection was given up")

    def _accept(self, message: Message) -> None:
        if message.kind == "STATUS":
            status = decode_status(message.content)
            if status.error_name not in ToolStatus.__members__ and message.name not in self._names:
                self.other_messages += 1
                return
            if status.code != 1:
                told = ToolStatus.__members__.get(status.error_name, ToolStatus.INVALID)
                told = ToolStatus.INVALID if told is ToolStatus.OK else told
                self._add(message.name, message.time_s, ToolPose(told, None))
            return
        if message.kind not in _POSES:
            self.other_messages += 1
            return
        poses = decode_poses(message)
        if message.kind == "TDATA":
            if self._groups.current:
                self._close_group()
            for name, T in poses.items():
                self._groups.current[name] = _received_pose(message, T)
            self._groups.stamp_s = message.time_s
            self._close_group()
            return
        for name, T in poses.items():
            self._add(name, message.time_s, _received_pose(message, T))

    def _add(self, name: str, stamp_s: float, pose: ToolPose) -> None:
        if self._groups.closes(name, stamp_s):
            self._close_group()
        if self._groups.add(name, stamp_s, pose):
            self._close_group()

    def _close_group(self) -> None:
        tools, stamp_s, repeated = self._groups.take()
        self.last_stamp_s = stamp_s
        self._names.update(dict.fromkeys(tools))
        self.counters.repeated += repeated
        self._number += not repeated
        arrival_s = self.clock.now_s()
        time_s = arrival_s - self.latency_s
        if stamp_s > 0.0:
            time_s = self._clock_line.add(stamp_s, arrival_s)
        self._queue.append(TrackerFrame(max(0, self._number), time_s, arrival_s, tools))
