"""Decode the replies that are text: TX and PHSR."""

from __future__ import annotations

import math
import re

from devices.errors import ProtocolError
from devices.ndi.replies import HandleReport, HandleState, Option, Point, PoseReport

__all__ = ["decode_handles", "decode_tx"]

_HEX = re.compile(r"[0-9A-Fa-f]+\Z")
_SIGNED = re.compile(r"[+-][0-9]+\Z")


class _Text:
    """A cursor over a reply's text; every step checks what it takes."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0

    def take(self, count: int) -> str:
        piece = self.text[self.at : self.at + count]
        if len(piece) < count:
            raise ProtocolError(f"TX reply ends {count - len(piece)} characters early, at {self.text[-20:]!r}")
        self.at += count
        return piece

    def word(self, word: str) -> bool:
        if self.text.startswith(word, self.at):
            self.at += len(word)
            return True
        return False

    def at_line_end(self) -> bool:
        return self.text.startswith("\n", self.at)

    def hexadecimal(self, count: int) -> int:
        piece = self.take(count)
        if not _HEX.match(piece):
            raise ProtocolError(f"TX reply: expected {count} hexadecimal digits, got {piece!r}")
        return int(piece, 16)

    def number(self, count: int, scale: float) -> float:
        piece = self.take(count)
        if not _SIGNED.match(piece):
            raise ProtocolError(f"TX reply: expected a sign and {count - 1} digits, got {piece!r}")
        return int(piece) / scale

    def point(self) -> Point:
        return self.number(7, 100.0), self.number(7, 100.0), self.number(7, 100.0)

    def markers(self) -> tuple[Point, ...]:
        count = self.hexadecimal(2)
        if count:
            self.hexadecimal((count + 3) // 4)  # out-of-volume bits
        return tuple(self.point() for _ in range(count))


def decode_tx(text: str, options: Option = Option.POSES) -> PoseReport:
    """Decode the text of a TX reply.

    Parameters
    ----------
    text : str
        Without checksum.
    options : Option
        The options that were sent.

    Raises
    ------
    ProtocolError
        Where the text is not laid out so to its last character.
    """
    cursor = _Text(text)
    handles = tuple(_tx_handle(cursor, int(options)) for _ in range(cursor.hexadecimal(2)))
    strays = cursor.markers() if options & Option.STRAYS else None
    status = cursor.hexadecimal(4)
    if cursor.at != len(text):
        raise ProtocolError(f"TX reply goes on behind its end: {text[cursor.at :][:40]!r}")
    return PoseReport(handles, status, strays)


def _tx_handle(cursor: _Text, options: int) -> HandleReport:
    handle, state = cursor.hexadecimal(2), HandleState.TRACKED
    quaternion, position, error, port_status, frame, markers = None, None, math.nan, 0, None, None
    if cursor.word("UNOCCUPIED"):
        # some devices end the line here, others give status and frame as for MISSING: clients disagree
        if not cursor.word("\n"):
            port_status, frame = cursor.hexadecimal(8), cursor.hexadecimal(8)
            if not cursor.word("\n"):
                raise ProtocolError("TX reply: no line end behind UNOCCUPIED")
        return HandleReport(handle, HandleState.UNOCCUPIED, port_status=port_status, frame=frame)
    if options & Option.POSES.value:
        if cursor.word("MISSING"):
            state = HandleState.MISSING
        elif cursor.word("DISABLED"):
            state = HandleState.DISABLED
        else:
            quaternion = (cursor.number(6, 1e4), cursor.number(6, 1e4), cursor.number(6, 1e4), cursor.number(6, 1e4))
            position = cursor.point()
            error = cursor.number(6, 1e4)
        port_status, frame = cursor.hexadecimal(8), cursor.hexadecimal(8)
    if options & Option.TOOL_INFORMATION.value and not cursor.at_line_end():
        cursor.take(20)
    stray = options & Option.SINGLE_STRAY.value and not cursor.at_line_end()
    if stray and not (cursor.word("MISSING") or cursor.word("DISABLED")):
        cursor.point()
    if options & Option.TOOL_MARKERS.value and not cursor.at_line_end():
        markers = cursor.markers()
    if not cursor.word("\n"):
        raise ProtocolError(f"TX reply: expected a line end behind handle {handle:02X}")
    return HandleReport(handle, state, quaternion, position, error, port_status, frame, markers)


def decode_handles(text: str) -> list[tuple[int, int]]:
    """Decode a PHSR reply: (handle, status of 12 bits) of each port handle.

    >>> decode_handles("020A0010B01F")
    [(10, 1), (11, 31)]
    """
    cursor = _Text(text)
    handles = [(cursor.hexadecimal(2), cursor.hexadecimal(3)) for _ in range(cursor.hexadecimal(2))]
    if cursor.at != len(text):
        raise ProtocolError(f"PHSR reply goes on behind its end: {text!r}")
    return handles
