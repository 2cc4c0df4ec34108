"""Decode the replies that are binary: BX and BX2 (General Binary Format), little-endian."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace

from devices.errors import ProtocolError
from devices.ndi.replies import (
    BX2_OUT,
    BX2_PARTLY_OUT,
    ENABLED,
    INITIALISED,
    OUT_OF_VOLUME,
    PARTIALLY_OUT_OF_VOLUME,
    HandleReport,
    HandleState,
    Option,
    Point,
    PoseReport,
)

__all__ = ["decode_bx", "decode_bx2"]


# plain numbers: the operators of enum.Flag cost more than decoding a tool
_POSES, _TOOL_INFORMATION = int(Option.POSES), int(Option.TOOL_INFORMATION)
_SINGLE_STRAY, _TOOL_MARKERS, _STRAYS = int(Option.SINGLE_STRAY), int(Option.TOOL_MARKERS), int(Option.STRAYS)


class _Bytes:
    """A cursor over a binary body; every step checks that the bytes are there."""

    def __init__(self, body: bytes, what: str) -> None:
        self.body, self.what, self.at = body, what, 0

    def take(self, layout: str) -> tuple[int | float, ...]:
        try:
            values = struct.unpack_from("<" + layout, self.body, self.at)
        except struct.error:
            raise ProtocolError(f"{self.what} reply of {len(self.body)} bytes ends early") from None
        self.at += struct.calcsize("<" + layout)
        return values

    def integer(self, layout: str) -> int:
        return self.take(layout)[0]  # type: ignore[return-value]

    def integers(self, layout: str) -> tuple[int, int]:
        first, second = self.take(layout)
        return first, second  # type: ignore[return-value]

    def points(self, count: int) -> tuple[Point, ...]:
        values = self.take(f"{3 * count}f")
        return tuple((values[k], values[k + 1], values[k + 2]) for k in range(0, 3 * count, 3))

    def markers(self) -> tuple[Point, ...]:
        count = self.integer("B")
        self.take(f"{(count + 7) // 8}B")  # out-of-volume bits
        return self.points(count)

    def end(self) -> None:
        if self.at != len(self.body):
            raise ProtocolError(f"{self.what} reply: {len(self.body) - self.at} bytes too many")


_BX_STATE = {0x01: HandleState.TRACKED, 0x02: HandleState.MISSING, 0x04: HandleState.DISABLED}


def decode_bx(body: bytes, options: Option = Option.POSES) -> PoseReport:
    """Decode the body of a BX reply; raises `ProtocolError` where it is not laid out so to its last byte.

    Parameters
    ----------
    body : bytes
        Without header and checksums.
    options : Option
        The options that were sent.
    """
    cursor = _Bytes(body, "BX")
    bits = int(options)
    handles = tuple(_bx_handle(cursor, bits) for _ in range(cursor.integer("B")))
    strays = cursor.markers() if bits & _STRAYS else None
    status = cursor.integer("H")
    cursor.end()
    return PoseReport(handles, status, strays)


def _bx_handle(cursor: _Bytes, options: int) -> HandleReport:
    handle, code = cursor.integers("BB")
    state = _BX_STATE.get(code)
    if state is None:
        raise ProtocolError(f"BX reply: handle {handle:02X} has status {code:02X}, expected 01, 02 or 04")
    if state is HandleState.DISABLED:
        return HandleReport(handle, state)
    quaternion, position, error, port_status, frame, markers = None, None, math.nan, 0, None, None
    if options & _POSES:
        if state is HandleState.TRACKED:
            w, x, y, z, px, py, pz, error = cursor.take("8f")
            quaternion, position = (w, x, y, z), (px, py, pz)
        port_status, frame = cursor.integers("II")
    if options & _TOOL_INFORMATION:
        cursor.take("11B")
    if options & _SINGLE_STRAY and cursor.integer("B"):
        cursor.points(1)
    if options & _TOOL_MARKERS:
        markers = cursor.markers()
    return HandleReport(handle, state, quaternion, position, error, port_status, frame, markers)


_FRAME, _POSE_6D, _POINT_3D, _BUTTON_1D, _ALERT = 0x01, 0x02, 0x03, 0x04, 0x12
_STRAY_HANDLE = 0xFFFF
_BX2_MISSING = 0x100
_BX2_NOT_ENABLED, _BX2_UNPLUGGED = 0x20, 0x21


def decode_bx2(body: bytes) -> list[PoseReport]:
    """Decode the body of a BX2 reply: one report per frame it holds, none where there is no new frame.

    A tool may be left out of a frame: that is no news of it, not a missing tool.

    Raises
    ------
    ProtocolError
        Where the body is not laid out so to its last byte.
    """
    cursor = _Bytes(body, "BX2")
    reports: list[PoseReport] = []
    alerts: list[tuple[int, int]] = []
    for kind, size, count in _components(cursor):
        end = cursor.at + size
        if kind == _FRAME:
            reports.extend(_bx2_frame(cursor) for _ in range(count))
        elif kind == _ALERT:
            alerts.extend((cursor.integer("H"), cursor.integer("H")) for _ in range(count))
        else:
            cursor.at = end
        if cursor.at != end:
            raise ProtocolError(f"BX2 reply: a component of type {kind} does not end where it says")
    cursor.end()
    if alerts:
        reports = (
            [replace(reports[0], alerts=tuple(alerts)), *reports[1:]]
            if reports
            else [PoseReport((), alerts=tuple(alerts))]
        )
    return reports


def _components(cursor: _Bytes) -> Iterator[tuple[int, int, int]]:
    """Walk a GBF container: version, count, then (type, size without header, items) with the cursor on each payload."""
    cursor.integer("H")
    for _ in range(cursor.integer("H")):
        kind, size, _, count = (int(value) for value in cursor.take("HIHI"))
        if not 12 <= size <= len(cursor.body) - cursor.at + 12:
            raise ProtocolError(f"BX2 reply: a component of type {kind} claims {size} bytes")
        yield kind, size - 12, count


def _bx2_frame(cursor: _Bytes) -> PoseReport:
    _, _, _, frame, seconds, nanoseconds = (int(value) for value in cursor.take("BBHIII"))
    handles: dict[int, HandleReport] = {}
    markers: dict[int, tuple[Point, ...]] = {}
    buttons: dict[int, int] = {}
    strays: tuple[Point, ...] | None = None
    for kind, size, count in _components(cursor):
        end = cursor.at + size
        for _ in range(min(count, size)):
            if kind == _POSE_6D:
                report = _bx2_pose(cursor, frame)
                handles[report.handle] = report
            elif kind == _POINT_3D:
                handle, points = _bx2_points(cursor)
                if handle == _STRAY_HANDLE:
                    strays = (strays or ()) + points
                else:
                    markers[handle] = points
            elif kind == _BUTTON_1D:
                handle, width = cursor.integer("H"), cursor.integer("H")
                pressed = cursor.take(f"{width}B")
                buttons[handle] = sum(1 << k for k, value in enumerate(pressed[:3]) if value)
        if kind not in (_POSE_6D, _POINT_3D, _BUTTON_1D):
            cursor.at = end
        if cursor.at != end:
            raise ProtocolError(f"BX2 reply: a component of type {kind} does not end where it says")
    merged = []
    for handle, report in handles.items():
        status = report.port_status | buttons.get(handle, 0) << 1
        merged.append(replace(report, markers_mm=markers.get(handle), port_status=status))
    return PoseReport(tuple(merged), 0, strays, seconds + 1e-9 * nanoseconds)


def _bx2_pose(cursor: _Bytes, frame: int) -> HandleReport:
    handle, status = cursor.integers("HH")
    code = status & 0xFF
    port_status = 1 | INITIALISED | ENABLED
    if code == BX2_OUT:
        port_status |= OUT_OF_VOLUME
    if code == BX2_PARTLY_OUT:
        port_status |= PARTIALLY_OUT_OF_VOLUME
    if status & _BX2_MISSING:
        states = {_BX2_NOT_ENABLED: HandleState.DISABLED, _BX2_UNPLUGGED: HandleState.UNOCCUPIED}
        state = states.get(code, HandleState.MISSING)
        return HandleReport(handle, state, port_status=port_status, frame=frame, code=code)
    w, x, y, z, px, py, pz, error = cursor.take("8f")
    tracked = HandleState.TRACKED
    return HandleReport(handle, tracked, (w, x, y, z), (px, py, pz), error, port_status, frame, None, code)


def _bx2_points(cursor: _Bytes) -> tuple[int, tuple[Point, ...]]:
    handle, count = cursor.integer("H"), cursor.integer("H")
    points = []
    for _ in range(count):
        status = cursor.integer("B")
        cursor.take("BH")
        (point,) = cursor.points(1)
        if status != 0x01:
            points.append(point)
    return handle, tuple(points)
