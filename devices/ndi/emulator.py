"""An emulated NDI tracker on a pseudo-terminal or a TCP port, for clients that cannot tell."""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from devices.clock import SystemClock
from devices.errors import DeviceInputError, TransportError
from devices.ndi.device import Device
from devices.ndi.faults import Faults
from devices.ndi.pace import PacedClock
from devices.scheduling import hurry_this_thread

__all__ = ["Emulator", "PtyEmulator", "TcpEmulator"]

_POLL_S = 0.05
_TRACKING = (b"TX", b"BX")
#: a device that lost its cable is back after this, s
_PLUG_S = 0.3
# what the kernel says in front of each packet of a pseudo-terminal in packet mode, the same on Linux and macOS
_DATA, _FLUSHED_BOTH = 0x00, 0x03

Waited = TypeVar("Waited", int, socket.socket)


class Disconnected(Exception):
    """The client has gone, or a fault cut the line."""


class Emulator(ABC):
    """Serve a `Device` on a line, on a thread of its own, until `stop`.

    The thread asks to be run before others, and a device in real time gets a `PacedClock`: what holds the emulator up
    makes frames late, but skips none.

    Parameters
    ----------
    device : Device or None
    faults : Faults or None
    """

    def __init__(self, device: Device | None = None, faults: Faults | None = None) -> None:
        self.device = Device() if device is None else device
        self.faults = Faults() if faults is None else faults
        if self.faults.wrap:
            self.device.first_frame = 2**32 - 120
        if isinstance(self.device.clock, SystemClock):
            self.device.clock = PacedClock(self.device.clock)
        self._meant_s = 0.0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    @abstractmethod
    def url(self) -> str:
        """What `open_tracker` takes to reach it."""

    @abstractmethod
    def _listen(self) -> None:
        """Open the line."""

    @abstractmethod
    def _serve(self) -> None:
        """Answer one client until it has gone; return now and then where there is none."""

    @abstractmethod
    def _hang_up(self) -> None:
        """Cut the line, and have it ready again a little later."""

    @abstractmethod
    def _close(self) -> None:
        """Close everything."""

    def start(self) -> Self:
        """Listen, and serve from a thread; returns once clients can connect."""
        if self._thread is None:
            self._stopping.clear()
            self._listen()
            self._thread = threading.Thread(target=self._run, name=f"emulator on {self.url}", daemon=True)
            self._thread.start()
        return self

    def stop(self) -> None:
        """Stop serving and close the line."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(5.0)
            self._thread = None
            self._close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        hurry_this_thread()
        while not self._stopping.is_set():
            try:
                self._serve()
            except Disconnected:
                self._hang_up()

    def _ready(self, lines: Sequence[Waited]) -> list[Waited]:
        """Wait a moment, at most until the next frame is due, for lines that can be read.

        A loop that was held up answers first, for the time when it should have woken: the question may be that old.
        """
        clock = self.device.clock
        if not isinstance(clock, PacedClock):
            return select.select(lines, [], [], _POLL_S)[0]
        self._turn(clock)
        self._meant_s = min(_POLL_S, clock.real_s(max(0.0, self.device.next_frame_s())))
        ready = select.select(lines, [], [], self._meant_s)[0]
        if not (ready and self.device.tracking and clock.is_held_up(self._meant_s)):
            self._turn(clock)
        return ready

    def _turn(self, clock: PacedClock) -> None:
        clock.turn(self._meant_s)
        self._meant_s = 0.0

    def _pause(self, time_s: float) -> None:
        """Let the device do nothing for a while; its frames go on."""
        clock = self.device.clock
        clock.wait_until(clock.now_s() + time_s, self._stopping)

    def _answer(self, data: bytes, write_line: int | socket.socket) -> None:
        """Answer what came in, with whatever the faults make of it."""
        for message, reply in self.device.exchanges(data):
            due = False
            if message.startswith(_TRACKING) and self.device.tracking:
                due = self.faults.moment()
                if due and self.faults.out_of_volume:
                    self.device.out_of_volume ^= {0}
            for delivery in self.faults.deliver(reply, due):
                if delivery.delay_s > 0.0:
                    self._pause(delivery.delay_s)
                if delivery.disconnect:
                    raise Disconnected
                self._write(write_line, delivery.data)

    def _write(self, line: int | socket.socket, data: bytes) -> None:
        view = memoryview(data)
        while view and not self._stopping.is_set():
            if not select.select([], [line], [], _POLL_S)[1]:
                continue
            try:
                sent = os.write(line, view) if isinstance(line, int) else line.send(view)
            except OSError:
                raise Disconnected from None
            view = view[sent:]


class PtyEmulator(Emulator):
    """An emulator on a pseudo-terminal: `path` opens like a serial port.

    A serial break cannot be seen here. But clients that reset by a break flush the line first, both ways, and wait: a
    double flush that no command follows within 150 ms is answered as a break would be.

    Parameters
    ----------
    link : str, Path or None
        A symbolic link that always points to the terminal, also after a disconnection gave it another name.
    """

    _BREAK_S = 0.15

    def __init__(
        self, device: Device | None = None, faults: Faults | None = None, link: str | Path | None = None
    ) -> None:
        super().__init__(device, faults)
        self.link = None if link is None else Path(link)
        self._master = self._slave = -1
        self._terminal = ""
        self._flushed_s: float | None = None

    @property
    def path(self) -> str:
        """What a client opens: the link where there is one."""
        return self._terminal if self.link is None else str(self.link)

    @property
    def url(self) -> str:
        """What `open_tracker` takes to reach it."""
        return f"ndi:{self.path}"

    def _listen(self) -> None:
        try:
            import fcntl
            import pty
            import termios
            import tty
        except ImportError as error:
            raise DeviceInputError(
                f"this system has no pseudo-terminals ({error}): emulate on a TCP port instead (--tcp, TcpEmulator)"
            ) from error
        self._master, self._slave = pty.openpty()
        # raw, or the terminal would echo; the slave stays open here, or reads fail whenever no client has it open
        tty.setraw(self._slave)
        fcntl.ioctl(self._master, termios.TIOCPKT, struct.pack("i", 1))
        self._terminal = os.ttyname(self._slave)
        if self.link is not None:
            try:
                if self.link.is_symlink():
                    self.link.unlink()
                self.link.symlink_to(self._terminal)
            except OSError as error:
                raise DeviceInputError(f"{self.link}: cannot be made a link to {self._terminal}: {error}") from error

    def _serve(self) -> None:
        ready = self._ready([self._master])
        now_s = self.device.clock.now_s()
        if not ready:
            if self._flushed_s is not None and now_s - self._flushed_s >= self._BREAK_S:
                self._flushed_s = None
                self.device.reset()
                self._answer(b"RESET\r", self._master)
            return
        try:
            packet = os.read(self._master, 4096)
        except OSError as error:
            if error.errno == errno.EIO:
                self._stopping.wait(_POLL_S)
                return
            raise
        kind = packet[0]
        if kind == _DATA:
            self._flushed_s = None
            self._answer(packet[1:], self._master)
        elif kind & _FLUSHED_BOTH == _FLUSHED_BOTH:
            self._flushed_s = now_s

    def _hang_up(self) -> None:
        self._close()
        self.device.reset()
        self._pause(_PLUG_S)
        if not self._stopping.is_set():
            self._listen()

    def _close(self) -> None:
        if self.link is not None and self.link.is_symlink():
            self.link.unlink()
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1


class TcpEmulator(Emulator):
    """An emulator on a TCP port; one client at a time, a new one takes the place of the old.

    Parameters
    ----------
    port : int
        0 takes a free one.
    host : str
    """

    def __init__(
        self, device: Device | None = None, faults: Faults | None = None, port: int = 0, host: str = "127.0.0.1"
    ) -> None:
        super().__init__(device, faults)
        if not 0 <= port < 65536:
            raise DeviceInputError(f"a TCP port lies in 0–65535, got {port}")
        self.host, self.port = host, port
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None

    @property
    def url(self) -> str:
        """What `open_tracker` takes to reach it."""
        return f"ndi:tcp://{self.host}:{self.port}"

    def _listen(self) -> None:
        try:
            self._listener = socket.create_server((self.host, self.port))
        except OSError as error:
            raise TransportError(f"cannot listen on {self.host}:{self.port}: {error}") from error
        self.port = self._listener.getsockname()[1]

    def _serve(self) -> None:
        listener, client = self._listener, self._client
        assert listener is not None
        waiting = [listener] if client is None else [listener, client]
        for ready in self._ready(waiting):
            if ready is listener:
                self._drop()
                self._client, _ = listener.accept()
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client.setblocking(False)
                return
            try:
                data = ready.recv(4096)
            except OSError:
                data = b""
            if not data:
                self._drop()
                return
            self._answer(data, ready)

    def _drop(self) -> None:
        self.device.forget_input()
        if self._client is not None:
            self._client.close()
            self._client = None

    def _hang_up(self) -> None:
        self._drop()
        self.device.reset()

    def _close(self) -> None:
        self._drop()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
