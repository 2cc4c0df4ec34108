"""OpenIGTLink out: frames to any number of clients."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from devices.clock import Clock, SystemClock
from devices.errors import DeviceInputError, ProtocolError, TransportError
from devices.frame import ToolStatus, TrackerFrame
from devices.igtl_messages import (
    DEFAULT_PORT,
    Message,
    MessageReader,
    Status,
    encode,
    encode_position,
    encode_status,
    encode_transform,
    encode_transforms,
)
from devices.rotation import is_rigid

__all__ = ["IgtlServer"]

#: resolution in ms (at least so long between two messages), name of the frame in which poses are wanted
_STT_TDATA = struct.Struct(">I32s")
_STATUS_CODE = {
    ToolStatus.MISSING: 16,
    ToolStatus.DISABLED: 15,
    ToolStatus.OUT_OF_VOLUME: 13,
    ToolStatus.PARTIALLY_OUT_OF_VOLUME: 13,
    ToolStatus.INVALID: 2,
}

_ENCODERS = {"TRANSFORM": encode_transform, "POSITION": encode_position}


@dataclass
class _Client:
    """One client: what waits for it, and whether it asked for tracking data (then the name of its messages)."""

    waiting: bytearray = field(default_factory=bytearray)
    reader: MessageReader = field(default_factory=lambda: MessageReader(("STT_TDATA", "STP_TDATA")))
    tracking: str | None = None
    resolution_s: float = 0.0
    last_s: float = -np.inf

    def is_due(self, stamp_s: float) -> bool:
        """Whether enough time has passed since the last tracking data; notes that they are sent now."""
        if stamp_s - self.last_s < self.resolution_s - 1e-6:
            return False
        self.last_s = stamp_s
        return True

    def answer(self, message: Message | ProtocolError) -> bytes:
        """What to say to a message: whether tracking data were started or stopped (0: yes, 1: no)."""
        if isinstance(message, ProtocolError) or message.kind not in ("STT_TDATA", "STP_TDATA"):
            return b""
        done = True
        if message.kind == "STP_TDATA":
            self.tracking = None
        else:
            done = len(message.content) == _STT_TDATA.size
            if done:
                resolution_ms, _ = _STT_TDATA.unpack(message.content)
                self.tracking, self.resolution_s, self.last_s = message.name, 1e-3 * resolution_ms, -np.inf
        return encode("RTS_TDATA", message.name, message.time_s, b"\0" if done else b"\1")


class IgtlServer:
    """Send frames to every client that connects, each message to each of them, in order.

    A tool that is OK goes out as TRANSFORM (or POSITION) with the frame's time in its header; one that is not goes out
    as STATUS, never as a matrix. A client that asks for tracking data (STT_TDATA) gets all tools that are OK in one
    TDATA message instead, no more often than it asks for, until it sends STP_TDATA. A client that does not read is
    dropped once 8 MB wait for it; it never holds the others up.

    Parameters
    ----------
    port : int
        0 takes a free one.
    host : str
    clock : Clock or None
        Turns frame times into the Unix times of message headers.
    poses_as : {"TRANSFORM", "POSITION"}
        The kind of message that a tool goes out as; a POSITION is shorter, with a quaternion.
    """

    _MOST_WAITING = 8 << 20

    def __init__(
        self,
        port: int = DEFAULT_PORT,
        host: str = "127.0.0.1",
        clock: Clock | None = None,
        poses_as: str = "TRANSFORM",
    ) -> None:
        if not 0 <= port < 65536:
            raise DeviceInputError(f"a TCP port lies in 0–65535, got {port}")
        if poses_as not in _ENCODERS:
            raise DeviceInputError(f"poses_as: got {poses_as!r}, expected one of {', '.join(_ENCODERS)}")
        self._encode = _ENCODERS[poses_as]
        self.host, self.port = host, port
        self.clock = SystemClock() if clock is None else clock
        self.dropped = 0
        self._lock = threading.Lock()
        self._clients: dict[socket.socket, _Client] = {}
        self._wake: socket.socket | None = None
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def clients(self) -> int:
        """Number of clients connected now."""
        with self._lock:
            return len(self._clients)

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
            self._poke(self._wake)
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
        seen: dict[str, NDArray[np.float64]] = {}
        single, others = [], []
        for name, pose in frame.tools.items():
            T = pose.T_tracker_tool
            if T is not None and pose.status is ToolStatus.OK and is_rigid(T):
                seen[name] = T
                single.append(self._encode(name, stamp_s, T))
                continue
            status = ToolStatus.INVALID if pose.status is ToolStatus.OK else pose.status
            said = Status(_STATUS_CODE[status], 0, status.name[:20], status.value)
            single.append(encode_status(name, stamp_s, said))
            others.append(single[-1])
        apart = b"".join(single)
        with self._lock:
            for link, client in list(self._clients.items()):
                if client.tracking is None:
                    self._put(link, apart)
                elif client.is_due(stamp_s):
                    self._put(link, b"".join([encode_transforms(client.tracking, stamp_s, seen), *others]))
            self._wake_up()

    def send_bytes(self, data: bytes) -> None:
        """Send encoded messages to all clients."""
        with self._lock:
            for link in list(self._clients):
                self._put(link, data)
            self._wake_up()

    def _put(self, link: socket.socket, data: bytes) -> None:
        self._clients[link].waiting += data
        self._flush(link)

    def _wake_up(self) -> None:
        """Have the thread send what did not go at once."""
        if self._wake is not None and any(client.waiting for client in self._clients.values()):
            self._poke(self._wake)

    @staticmethod
    def _poke(wake: socket.socket) -> None:
        with contextlib.suppress(OSError):  # the thread may have ended by itself already, or been poked enough
            wake.send(b"x")

    def _flush(self, link: socket.socket) -> None:
        waiting = self._clients[link].waiting
        try:
            while waiting:
                sent = link.send(waiting)
                del waiting[:sent]
        except BlockingIOError:
            if len(waiting) > self._MOST_WAITING:
                self.dropped += 1
                self._drop(link)
        except OSError:
            self._drop(link)

    def _drop(self, link: socket.socket) -> None:
        self._clients.pop(link, None)
        link.close()

    def _run(self, listener: socket.socket, woken: socket.socket) -> None:
        with listener, woken:
            while not self._stopping.is_set():
                with self._lock:
                    links = list(self._clients)
                    behind = [link for link in links if self._clients[link].waiting]
                try:
                    readable, writable, _ = select.select([listener, woken, *links], behind, [], 0.5)
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
                    for link in writable:
                        if link in self._clients:
                            self._flush(link)
            with self._lock:
                for link in list(self._clients):
                    self._drop(link)

    def _accept(self, listener: socket.socket) -> None:
        try:
            link, _ = listener.accept()
        except OSError:
            return
        try:
            link.setblocking(False)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # or half-open clients stay for ever
        except OSError:  # gone again already
            link.close()
            return
        with self._lock:
            self._clients[link] = _Client()

    def _listen_to(self, link: socket.socket) -> None:
        try:
            data = link.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        with self._lock:
            client = self._clients.get(link)
            if client is None:
                return
            if not data:
                self._drop(link)
                return
            replies = b"".join(client.answer(message) for message in client.reader.feed(data))
            if replies:
                self._put(link, replies)
