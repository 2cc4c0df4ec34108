"""Lay out the replies of an emulated tracker: TX, BX, BX2 and their frames with checksums."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from devices.ndi.bodies import BodyPose
from devices.ndi.crc import crc16
from devices.ndi.replies import Option, Point
from devices.rotation import rotation_from_quaternion

__all__ = ["SeenTool", "binary_reply", "bx2_body", "bx_body", "text_reply", "tx_text"]


@dataclass(frozen=True)
class SeenTool:
    """One port handle at one moment, as a reply will tell it.

    Parameters
    ----------
    handle : int
    occupied, enabled : bool
    pose : BodyPose or None
        None where the tool is not seen.
    port_status : int
    frame : int
        32 bits.
    markers : tuple of points
        In the tool's frame, mm.
    """

    handle: int
    occupied: bool
    enabled: bool
    pose: BodyPose | None
    port_status: int
    frame: int
    markers: tuple[Point, ...] = ()

    def markers_seen(self) -> tuple[Point, ...]:
        """Markers in the tracker's frame, mm; none where the tool is not seen."""
        if self.pose is None or not self.markers:
            return ()
        R = rotation_from_quaternion(self.pose.quaternion)
        moved = np.asarray(self.markers) @ R.T + self.pose.position_mm
        return tuple((float(x), float(y), float(z)) for x, y, z in moved)


def text_reply(text: str) -> bytes:
    """Text with its checksum and end."""
    message = text.encode("ascii")
    return message + b"%04X\r" % crc16(message)


def binary_reply(body: bytes) -> bytes:
    """Binary body with header and checksums; the long header where the length needs it."""
    header = struct.pack("<HH", 0xA5C4, len(body)) if len(body) < 1 << 16 else struct.pack("<HI", 0xA5C8, len(body))
    return header + struct.pack("<H", crc16(header)) + body + struct.pack("<H", crc16(body))


def _hides(tool: SeenTool, options: Option) -> bool:
    """Whether the pose is left out because it is out of volume and nobody asked for such poses."""
    return tool.pose is None or (tool.pose.out_of_volume and not options & Option.OUT_OF_VOLUME)


def _signed(value: float, digits: int, scale: float) -> str:
    limit = 10**digits - 1
    return f"{max(-limit, min(limit, round(value * scale))):+0{digits + 1}d}"


def _point(point: Point) -> str:
    return "".join(_signed(value, 6, 100.0) for value in point)


def _markers_text(points: tuple[Point, ...], out_of_volume: bool) -> str:
    nibbles = (len(points) + 3) // 4
    bits = (1 << len(points)) - 1 if out_of_volume else 0
    return f"{len(points):02X}" + (f"{bits:0{nibbles}X}" if nibbles else "") + "".join(map(_point, points))


def tx_text(
    tools: list[SeenTool], options: Option, strays: tuple[Point, ...], system_status: int, bare_unoccupied: bool
) -> str:
    """Text of a TX reply; `bare_unoccupied` ends the line of an unoccupied handle at once, as ndicapi expects."""
    lines = []
    for tool in tools:
        line = f"{tool.handle:02X}"
        if not tool.occupied:
            line += "UNOCCUPIED" + ("" if bare_unoccupied else f"{tool.port_status:08X}{tool.frame:08X}")
            lines.append(line + "\n")
            continue
        hidden = _hides(tool, options)
        if options & Option.POSES:
            if not tool.enabled:
                line += "DISABLED"
            elif hidden or tool.pose is None:
                line += "MISSING"
            else:
                line += "".join(_signed(q, 5, 1e4) for q in tool.pose.quaternion)
                line += _point(tool.pose.position_mm) + _signed(tool.pose.error_mm, 5, 1e4)
            line += f"{tool.port_status:08X}{tool.frame:08X}"
        if options & Option.TOOL_INFORMATION:
            line += "0" * 20
        if options & Option.SINGLE_STRAY:
            line += "MISSING" if tool.enabled else "DISABLED"
        if options & Option.TOOL_MARKERS:
            points = () if hidden or not tool.enabled else tool.markers_seen()
            line += _markers_text(points, tool.pose is not None and tool.pose.out_of_volume)
        lines.append(line + "\n")
    stray = _markers_text(strays, False) if options & Option.STRAYS else ""
    return f"{len(tools):02X}" + "".join(lines) + stray + f"{system_status:04X}"


def _markers_bytes(points: tuple[Point, ...], out_of_volume: bool) -> bytes:
    count = len(points)
    bits = ((1 << count) - 1 if out_of_volume else 0).to_bytes((count + 7) // 8, "little")
    return bytes([count]) + bits + b"".join(struct.pack("<3f", *point) for point in points)


def bx_body(tools: list[SeenTool], options: Option, strays: tuple[Point, ...], system_status: int) -> bytes:
    """Body of a BX reply; an unoccupied handle is told as disabled."""
    body = bytearray([len(tools)])
    for tool in tools:
        if not (tool.occupied and tool.enabled):
            body += bytes([tool.handle, 0x04])
            continue
        hidden = _hides(tool, options)
        body += bytes([tool.handle, 0x02 if hidden else 0x01])
        if options & Option.POSES:
            if not hidden and tool.pose is not None:
                body += struct.pack("<8f", *tool.pose.quaternion, *tool.pose.position_mm, tool.pose.error_mm)
            body += struct.pack("<II", tool.port_status, tool.frame)
        if options & Option.TOOL_INFORMATION:
            body += bytes(11)
        if options & Option.SINGLE_STRAY:
            body += bytes(1)
        if options & Option.TOOL_MARKERS:
            points = () if hidden else tool.markers_seen()
            body += _markers_bytes(points, tool.pose is not None and tool.pose.out_of_volume)
    if options & Option.STRAYS:
        body += _markers_bytes(strays, False)
    return bytes(body) + struct.pack("<H", system_status)


def _component(kind: int, items: int, payload: bytes) -> bytes:
    return struct.pack("<HIHI", kind, 12 + len(payload), 0, items) + payload


def _container(components: list[bytes]) -> bytes:
    return struct.pack("<HH", 1, len(components)) + b"".join(components)


def bx2_body(
    tools: list[SeenTool] | None, frame: int, time_s: float, markers: str, buttons: bool, strays: tuple[Point, ...]
) -> bytes:
    """Body of a BX2 reply with one passive frame, or with none where `tools` is None: nothing new to tell.

    `markers` is the value of ``--3d``: none, tools, strays or all.
    """
    if tools is None:
        return _container([])
    tracked = [tool for tool in tools if tool.occupied and tool.enabled]
    poses = b""
    for tool in tracked:
        if tool.pose is None:
            poses += struct.pack("<HH", tool.handle, 0x100 | 0x1F)
        else:
            code = 0x09 if tool.pose.out_of_volume else 0x00
            poses += struct.pack("<HH", tool.handle, code)
            poses += struct.pack("<8f", *tool.pose.quaternion, *tool.pose.position_mm, tool.pose.error_mm)
    components = [_component(0x02, len(tracked), poses)]
    groups = [(tool.handle, tool.markers_seen()) for tool in tracked] if markers in ("tools", "all") else []
    if markers in ("strays", "all"):
        groups.append((0xFFFF, strays))
    if groups:
        points = b""
        for handle, group in groups:
            points += struct.pack("<HH", handle, len(group))
            points += b"".join(struct.pack("<BBH3f", 0, 0, k, *point) for k, point in enumerate(group))
        components.append(_component(0x03, len(groups), points))
    if buttons:
        pressed = b"".join(
            struct.pack("<HH3B", tool.handle, 3, *((tool.port_status >> bit) & 1 for bit in (1, 2, 3)))
            for tool in tracked
        )
        components.append(_component(0x04, len(tracked), pressed))
    seconds = int(time_s)
    head = struct.pack("<BBHIII", 2, 0, 0, frame, seconds, min(999_999_999, round((time_s - seconds) * 1e9)))
    return _container([_component(0x01, 1, head + _container(components))])
