"""Framing of the NDI Combined API, without any I/O: commands to bytes, bytes cut anywhere to checked replies."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from devices.errors import DeviceInputError, ProtocolError, TrackerError
from devices.ndi.crc import crc16

__all__ = [
    "ERROR_MEANING",
    "BinaryReply",
    "CrcError",
    "ErrorReply",
    "ReplyReader",
    "TextReply",
    "command",
    "refusal",
]

ERROR_MEANING = {
    0x01: "invalid command",
    0x02: "command too long",
    0x03: "command too short",
    0x04: "bad CRC in the command",
    0x05: "command timed out",
    0x06: "communication parameters not possible",
    0x07: "wrong number of parameters",
    0x08: "invalid port handle",
    0x09: "invalid tracking priority or mode",
    0x0A: "invalid LED",
    0x0B: "invalid LED state",
    0x0C: "command not allowed in the current mode",
    0x0D: "no tool assigned to the port handle",
    0x0E: "port handle not initialised",
    0x0F: "port handle not enabled",
    0x10: "system not initialised",
    0x11: "tracking cannot be stopped",
    0x12: "tracking cannot be started",
    0x13: "tool cannot be initialised: is its definition whole?",
    0x14: "invalid parameters of the camera",
    0x15: "system cannot be initialised",
    0x16: "diagnostic mode cannot be started",
    0x17: "diagnostic mode cannot be stopped",
    0x19: "firmware of the device is not consistent",
    0x1A: "internal error of the device",
    0x1C: "markers cannot be fired",
    0x1E: "SROM of the tool cannot be read",
    0x1F: "SROM of the tool cannot be written",
    0x21: "current test failed",
    0x22: "wavelength not supported",
    0x23: "parameter out of range",
    0x24: "volume not available",
    0x25: "feature not supported by this device",
    0x28: "too many tools",
    0x2A: "device is out of memory",
    0x2B: "port handle was not allocated",
    0x2C: "port handle is not occupied",
    0x2D: "no port handles left",
    0x2F: "incompatible port description",
    0x30: "tool or port is already assigned",
    0x32: "invalid operation",
    0x33: "feature not available",
    0x34: "no such user parameter",
    0x35: "wrong type of user parameter",
    0x36: "user parameter out of range",
    0x37: "index of user parameter out of range",
    0x38: "wrong size of user parameter",
    0x39: "no permission to change user parameter",
    0x3B: "file not found",
    0x3C: "file cannot be written",
    0x3D: "file cannot be read",
    0x40: "tool definition is wrong",
    0x41: "tool not supported by this device",
    0x42: "device not found",
    0xF1: "too much environmental infrared light",
    0xF4: "flash memory cannot be erased",
    0xF5: "flash memory cannot be written",
    0xF6: "flash memory cannot be read",
}

# the longest texts (VER, GET with wildcards) stay below 4 kB; this only bounds what noise can make us keep
_LONGEST_TEXT = 65_536
_LONGEST_BODY = 1 << 20
_BINARY = 0xA5C4
_LONG_BINARY = 0xA5C8


class CrcError(ProtocolError):
    """A reply whose checksum is wrong; nothing of it was used."""


@dataclass(frozen=True)
class TextReply:
    """Text of a reply, its checksum taken off."""

    text: str


@dataclass(frozen=True)
class ErrorReply:
    """The device refused a command: ``ERRORxx``."""

    code: int

    @property
    def meaning(self) -> str:
        """What the code says."""
        return ERROR_MEANING.get(self.code, "unknown error code")


@dataclass(frozen=True)
class BinaryReply:
    """Body of a binary reply (BX, BX2), its header and checksums taken off."""

    body: bytes


Reply = TextReply | ErrorReply | BinaryReply


def command(name: str, arguments: str = "") -> bytes:
    r"""Bytes of a command with its checksum.

    >>> command("INIT")
    b'INIT:E3A5\r'
    """
    text = f"{name}:{arguments}"
    if not text.isascii() or "\r" in text:
        raise DeviceInputError(f"a command is printable ASCII without a carriage return, got {text!r}")
    message = text.encode("ascii")
    return message + b"%04X\r" % crc16(message)


def refusal(asked: str, reply: ErrorReply) -> TrackerError:
    """Error that says what was asked, and in words why the device refused."""
    return TrackerError(f"{asked}: the tracker answers ERROR{reply.code:02X}: {reply.meaning}", reply.code)


class ReplyReader:
    r"""Turn bytes of a line, cut anywhere, into replies.

    A reply that fails its checksum or cannot be one is returned as a `ProtocolError`, and reading goes on behind it.
    After a bad header the end of the reply is unknown: all bytes at hand are dropped, and who reads the line should let
    it fall silent before it asks again.

    Examples
    --------
    >>> reader = ReplyReader()
    >>> reader.feed(b"OKA"), reader.feed(b"YA896\rERROR0CF8")
    ([], [TextReply(text='OKAY')])
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Number of bytes of a reply that is not complete."""
        return len(self._buffer)

    def clear(self) -> None:
        """Forget the reply begun."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Reply | ProtocolError]:
        """Take bytes as they came; return what they complete, in order."""
        self._buffer += data
        done: list[Reply | ProtocolError] = []
        while self._buffer:
            reply = self._take_binary() if self._buffer[0] in (0xC4, 0xC8) else self._take_text()
            if reply is None:
                break
            done.append(reply)
        return done

    def _take_text(self) -> Reply | ProtocolError | None:
        end = self._buffer.find(b"\r")
        if end < 0:
            if len(self._buffer) <= _LONGEST_TEXT:
                return None
            self._buffer.clear()
            return ProtocolError(f"more than {_LONGEST_TEXT} bytes without an end of reply; is this an NDI tracker?")
        message = bytes(self._buffer[:end])
        del self._buffer[: end + 1]
        if len(message) < 4:
            return ProtocolError(f"a reply of {len(message)} bytes has no checksum: {message!r}")
        body, stated = message[:-4], message[-4:]
        if stated.upper() != b"%04X" % crc16(body):
            return CrcError(f"checksum {stated!r} of the reply {body[:60]!r} is wrong, expected {crc16(body):04X}")
        if not body.isascii():
            return ProtocolError(f"a text reply holds bytes that are not ASCII: {body[:60]!r}")
        text = body.decode("ascii")
        if text.startswith("ERROR") and len(text) == 7:
            try:
                return ErrorReply(int(text[5:], 16))
            except ValueError:
                return ProtocolError(f"no error code: {text!r}")
        return TextReply(text)

    def _take_binary(self) -> Reply | ProtocolError | None:
        buffer = self._buffer
        if len(buffer) < 6:
            return None
        (start,) = struct.unpack_from("<H", buffer)
        if start == _BINARY:
            header, (length,) = 4, struct.unpack_from("<H", buffer, 2)
        elif start == _LONG_BINARY:
            header, (length,) = 6, struct.unpack_from("<I", buffer, 2)
        else:
            buffer.clear()
            return ProtocolError(f"no start of a reply: {start:04X}")
        if len(buffer) < header + 2:
            return None
        (stated,) = struct.unpack_from("<H", buffer, header)
        if stated != crc16(bytes(buffer[:header])):
            buffer.clear()
            return CrcError("checksum of a binary reply's header is wrong")
        if length > _LONGEST_BODY:
            buffer.clear()
            return ProtocolError(f"a binary reply claims {length} bytes, more than any tracker sends")
        end = header + 2 + length
        if len(buffer) < end + 2:
            return None
        body = bytes(buffer[header + 2 : end])
        (stated,) = struct.unpack_from("<H", buffer, end)
        del buffer[: end + 2]
        if stated != crc16(body):
            return CrcError("checksum of a binary reply's body is wrong")
        return BinaryReply(body)
