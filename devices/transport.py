"""Byte lines to devices: serial ports and TCP. The only file that imports `serial`."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from abc import ABC, abstractmethod

import serial

from devices.errors import DeviceInputError, TransportError

__all__ = ["Line", "SerialLine", "TcpLine"]

_SLICE_S = 0.05


class Line(ABC):
    """A line of bytes in both directions; every failure is a `TransportError`."""

    #: whether the line has a speed that both ends must agree on
    has_speed = False

    @abstractmethod
    def open(self) -> None:
        """Open at the speed of a device that was just reset: 9600 8N1."""

    @abstractmethod
    def close(self) -> None:
        """Close; does nothing where it is closed."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether `open` succeeded and nothing was lost since."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send all of the bytes."""

    @abstractmethod
    def read(self, timeout_s: float) -> bytes:
        """Return what has come, at once where something is there; empty after about `timeout_s`."""

    @abstractmethod
    def drop_input(self) -> None:
        """Forget what has come and was not read."""

    def set_speed(self, baud_rate: int) -> None:
        """Change the speed of this end."""
        raise TransportError(f"{self}: has no speed to set")

    def send_break(self) -> bool:
        """Send a break where the line knows one; tell whether it does."""
        return False


class SerialLine(Line):
    """A serial port, through pyserial.

    Parameters
    ----------
    port : str
        ``/dev/ttyUSB0``, ``COM3``, or a link to one.
    """

    has_speed = True

    def __init__(self, port: str) -> None:
        if not port:
            raise DeviceInputError("a serial port needs a name such as /dev/ttyUSB0 or COM3")
        self.port = port
        self._serial: serial.Serial | None = None

    def __str__(self) -> str:
        return self.port

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._serial is not None

    def open(self) -> None:
        """Open at 9600 8N1."""
        self.close()
        try:
            # the timeout is fixed: changing it costs a reconfiguration of the port on every read
            self._serial = serial.Serial(self.port, 9600, timeout=_SLICE_S, write_timeout=2.0)
        except (OSError, ValueError) as error:
            raise TransportError(
                f"{self.port}: cannot be opened: {error}; is it plugged in, and may you use it?"
            ) from error

    def close(self) -> None:
        """Close the port."""
        port, self._serial = self._serial, None
        if port is not None:
            # an unplugged port cannot even be closed; nothing of it is left
            with contextlib.suppress(OSError):
                port.close()

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise TransportError(f"{self.port}: is closed")
        return self._serial

    def _lost(self, error: BaseException) -> TransportError:
        self.close()
        return TransportError(f"{self.port}: lost: {error}")

    def write(self, data: bytes) -> None:
        """Send all of the bytes."""
        try:
            self._opened().write(data)
        except TransportError:
            raise
        except OSError as error:
            raise self._lost(error) from error

    def read(self, timeout_s: float) -> bytes:
        """Return what has come; waits for the first byte in slices of 50 ms."""
        port = self._opened()
        try:
            for _ in range(max(1, round(timeout_s / _SLICE_S))):
                data = port.read(1)
                if data:
                    return bytes(data + port.read(port.in_waiting))
        except (OSError, TypeError) as error:  # pyserial meets None where another thread closed the port
            raise self._lost(error) from error
        return b""

    def drop_input(self) -> None:
        """Forget what has come and was not read."""
        try:
            port = self._opened()
            if port.in_waiting:  # asking is quicker than flushing, and this runs before every question
                port.reset_input_buffer()
        except TransportError:
            raise
        except Exception as error:  # termios.error is no OSError
            raise self._lost(error) from error

    def set_speed(self, baud_rate: int) -> None:
        """Change the speed of this end; `DeviceInputError` where the machine does not know it."""
        port = self._opened()
        previous = port.baudrate
        try:
            port.baudrate = baud_rate
        except (ValueError, OSError) as error:
            port.baudrate = previous
            raise DeviceInputError(f"{self.port}: this machine has no {baud_rate} baud: {error}") from error

    def send_break(self) -> bool:
        """Send a break of 0.25 s; a pseudo-terminal takes it and passes nothing on."""
        try:
            self._opened().send_break(0.25)
        except TransportError:
            raise
        except Exception as error:
            raise self._lost(error) from error
        return True


class TcpLine(Line):
    """A TCP connection.

    Parameters
    ----------
    host : str
    port : int
    connect_timeout_s : float
    """

    def __init__(self, host: str, port: int, connect_timeout_s: float = 2.0) -> None:
        if not host or not 0 < port < 65536:
            raise DeviceInputError(f"expected HOST:PORT with a port in 1–65535, got {host!r}:{port}")
        self.host, self.port, self._connect_timeout_s = host, port, connect_timeout_s
        self._socket: socket.socket | None = None
        self._closed = 0  # how often: a connection that comes up after another thread closed the line is not kept
        self._lock = threading.Lock()

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    @property
    def is_open(self) -> bool:
        """Whether the connection stands."""
        return self._socket is not None

    def open(self) -> None:
        """Connect."""
        self.close()
        before = self._closed
        try:
            connection = socket.create_connection((self.host, self.port), self._connect_timeout_s)
        except OSError as error:
            raise TransportError(f"{self}: no connection: {error}; is the device on, and in this network?") from error
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(2.0)
        with self._lock:
            wanted = self._closed == before
            if wanted:
                self._socket = connection
        if not wanted:
            connection.close()
            raise TransportError(f"{self}: closed while it was connecting")

    def close(self) -> None:
        """Close the connection."""
        with self._lock:
            self._closed += 1
            connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise TransportError(f"{self}: is not connected")
        return self._socket

    def _lost(self, why: object) -> TransportError:
        self.close()
        return TransportError(f"{self}: connection lost: {why}")

    def write(self, data: bytes) -> None:
        """Send all of the bytes."""
        connection = self._opened()
        try:
            connection.sendall(data)
        except OSError as error:
            raise self._lost(error) from error

    def read(self, timeout_s: float) -> bytes:
        """Return what has come."""
        connection = self._opened()
        try:
            if not select.select([connection], [], [], timeout_s)[0]:
                return b""
            data = connection.recv(65536)
        except (OSError, ValueError) as error:  # ValueError: closed by another thread
            raise self._lost(error) from error
        if not data:
            raise self._lost("closed by the other side")
        return data

    def drop_input(self) -> None:
        """Forget what has come and was not read."""
        while self.read(0.0):
            pass
