"""OpenIGTLink: receive poses as a `Tracker`, and send frames to any number of clients."""

from __future__ import annotations

import select
import socket
import threading
from collections import deque
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from devices.clock import Clock, SystemClock
from devices.errors import DeviceInputError, ProtocolError, TransportError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.igtl_groups import MessageGroups
from devices.igtl_messages import (
    Message,
    MessageReader,
    Status,
    decode_poses,
    decode_status,
    encode,
    encode_status,
    encode_transform,
)
from devices.rotation import is_rigid
from devices.timing import ClockLine
from devices.tracker import Tracker
from devices.transport import TcpLine

__all__ = ["IgtlServer", "IgtlTracker"]

DEFAULT_PORT = 18944
_SLICE_S = 0.02
_POSES = ("TRANSFORM", "TDATA", "POSITION", "QTRANS")
_WANTED = frozenset((*_POSES, "STATUS"))
_STATUS_CODE = {
    ToolStatus.MISSING: 16,
    ToolStatus.DISABLED: 15,
    ToolStatus.OUT_OF_VOLUME: 13,
    ToolStatus.PARTIALLY_OUT_OF_VOLUME: 13,
    ToolStatus.INVALID: 2,
}


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
            try:
                data = self.line.read(min(_SLICE_S, remaining_s))
            except TransportError:
                if self._stopping.is_set():
                    return None
                raise
            if data:
                self._take(data)
                continue
            if self._groups.current:
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


class IgtlServer:
    """Send frames to every client that connects, each message to each of them, in order.

    A tool that is OK goes out as TRANSFORM with the frame's time in its header; one that is not goes out as STATUS,
    never as a matrix. A client that does not read is dropped once 8 MB wait for it; it never holds the others up.

    Parameters
    ----------
    port : int
        0 takes a free one.
    host : str
    clock : Clock or None
        Turns frame times into the Unix times of message headers.
    """

    _MOST_WAITING = 8 << 20

    def __init__(self, port: int = DEFAULT_PORT, host: str = "127.0.0.1", clock: Clock | None = None) -> None:
        if not 0 <= port < 65536:
            raise DeviceInputError(f"a TCP port lies in 0–65535, got {port}")
        self.host, self.port = host, port
        self.clock = SystemClock() if clock is None else clock
        self.dropped = 0
        self._lock = threading.Lock()
        self._waiting: dict[socket.socket, bytearray] = {}
        self._readers: dict[socket.socket, MessageReader] = {}
        self._wake: socket.socket | None = None
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def clients(self) -> int:
        """Number of clients connected now."""
        with self._lock:
            return len(self._waiting)

    def start(self) -> Self:
        """Listen; returns once clients can connect."""
        try:
            listener = socket.create_server((self.host, self.port))
        except OSError as error:
            raise TransportError(f"cannot listen on {self.host}:{self.port}: {error}") from error
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._stopping.clear()
        self._wake, woken = socket.socketpair()
        name = f"OpenIGTLink server {self.port}"
        self._thread = threading.Thread(target=self._run, args=(listener, woken), name=name, daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Close all connections."""
        self._stopping.set()
        if self._thread is not None and self._wake is not None:
            self._wake.send(b"x")
            self._thread.join(5.0)
            self._wake.close()
            self._thread = self._wake = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def send(self, frame: TrackerFrame) -> None:
        """Send a frame to all clients, from any thread; returns without waiting for them."""
        stamp_s = self.clock.unix_s(frame.time_s)
        if not 0.0 <= stamp_s < 2**32:
            raise DeviceInputError(f"frame {frame.number}: its time {stamp_s!r} s does not fit a message header")
        messages = []
        for name, pose in frame.tools.items():
            if pose.status is ToolStatus.OK and is_rigid(pose.T_tracker_tool):
                messages.append(encode_transform(name, stamp_s, pose.T_tracker_tool))  # type: ignore[arg-type]
                continue
            status = ToolStatus.INVALID if pose.status is ToolStatus.OK else pose.status
            said = Status(_STATUS_CODE[status], 0, status.name[:20], status.value)
            messages.append(encode_status(name, stamp_s, said))
        self.send_bytes(b"".join(messages))

    def send_bytes(self, data: bytes) -> None:
        """Send encoded messages to all clients."""
        with self._lock:
            for client in list(self._waiting):
                self._waiting[client] += data
                self._flush(client)
            behind = any(self._waiting.values())
            if behind and self._wake is not None:
                self._wake.send(b"x")

    def _flush(self, client: socket.socket) -> None:
        waiting = self._waiting[client]
        try:
            while waiting:
                sent = client.send(waiting)
                del waiting[:sent]
        except BlockingIOError:
            if len(waiting) > self._MOST_WAITING:
                self.dropped += 1
                self._drop(client)
        except OSError:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._waiting.pop(client, None)
        self._readers.pop(client, None)
        client.close()

    def _run(self, listener: socket.socket, woken: socket.socket) -> None:
        with listener, woken:
            while not self._stopping.is_set():
                with self._lock:
                    clients = list(self._waiting)
                    behind = [client for client in clients if self._waiting[client]]
                try:
                    readable, writable, _ = select.select([listener, woken, *clients], behind, [], 0.5)
                except (OSError, ValueError):
                    continue  # a client was dropped by `send` in between
                for ready in readable:
                    if ready is woken:
                        woken.recv(4096)
                    elif ready is listener:
                        self._accept(listener)
                    else:
                        self._listen_to(ready)
                with self._lock:
                    for client in writable:
                        if client in self._waiting:
                            self._flush(client)
            with self._lock:
                for client in list(self._waiting):
                    self._drop(client)

    def _accept(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except OSError:
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # or half-open clients stay for ever
        with self._lock:
            self._waiting[client] = bytearray()
            self._readers[client] = MessageReader()

    def _listen_to(self, client: socket.socket) -> None:
        """Clients may ask for TDATA to be started and stopped: they are told that it is, poses come anyway."""
        try:
            data = client.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        with self._lock:
            reader = self._readers.get(client)
            if reader is None:
                return
            if not data:
                self._drop(client)
                return
            for message in reader.feed(data):
                if isinstance(message, Message) and message.kind in ("STT_TDATA", "STP_TDATA"):
                    self._waiting[client] += encode("RTS_TDATA", message.name, message.time_s, b"\0\0")
            if self._waiting[client]:
                self._flush(client)
