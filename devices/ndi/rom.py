"""Tool definition files (`.rom`): read and checked before a tracker is asked to believe them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceInputError

__all__ = ["ToolDefinition", "read_rom"]

_SMALLEST, _LARGEST = 752, 1024
_CHUNK = 64
_MARKERS = 20


@dataclass(frozen=True, eq=False)
class ToolDefinition:
    """A tool definition as a tracker loads it.

    Parameters
    ----------
    content : bytes
        The file, unchanged.
    markers_mm : (n, 3) array
        Marker positions in the tool's frame.
    normals : (n, 3) array
        Directions in which the markers are seen.
    manufacturer, part_number : str
    """

    content: bytes
    markers_mm: NDArray[np.float64]
    normals: NDArray[np.float64]
    manufacturer: str
    part_number: str

    @property
    def chunks(self) -> list[tuple[int, bytes]]:
        """(address, 64 bytes) pieces as PVWR sends them, the last one padded with zeros."""
        return [
            (start, self.content[start : start + _CHUNK].ljust(_CHUNK, b"\0"))
            for start in range(0, len(self.content), _CHUNK)
        ]


def read_rom(source: str | Path | bytes) -> ToolDefinition:
    """Read a tool definition and check what can be checked.

    Parameters
    ----------
    source : str, Path or bytes
        A file, or its content.

    Returns
    -------
    ToolDefinition

    Raises
    ------
    DeviceInputError
        Where it cannot be read, is cut, has another kind or a wrong checksum, or its markers make no tool: a
        tracker would take a spoilt file and silently track nothing.
    """
    name = "tool definition" if isinstance(source, bytes) else str(source)
    try:
        content = source if isinstance(source, bytes) else Path(source).read_bytes()
    except OSError as error:
        raise DeviceInputError(f"{name}: cannot be read: {error}") from error
    if content[:4] != b"NDI\0":
        raise DeviceInputError(f"{name}: no tool definition: it begins with {content[:4]!r}, expected b'NDI\\x00'")
    if not _SMALLEST <= len(content) <= _LARGEST:
        raise DeviceInputError(f"{name}: {len(content)} bytes, expected {_SMALLEST} to {_LARGEST}; is the file cut?")
    (stated,) = struct.unpack_from("<H", content, 4)
    total = sum(content[6:]) & 0xFFFF
    if stated != total:
        raise DeviceInputError(
            f"{name}: checksum {stated:04X}, expected {total:04X}; the file is damaged, copy it again"
        )
    (count,) = struct.unpack_from("<I", content, 0x1C)
    if not 3 <= count <= _MARKERS:
        raise DeviceInputError(f"{name}: {count} markers, a tool with a pose has 3 to {_MARKERS}")
    markers = np.frombuffer(content, "<f4", 3 * count, 0x48).reshape(-1, 3).astype(np.float64)
    normals = np.frombuffer(content, "<f4", 3 * count, 0x138).reshape(-1, 3).astype(np.float64)
    if not (np.isfinite(markers).all() and np.abs(markers).max() < 2_000.0 and np.isfinite(normals).all()):
        raise DeviceInputError(f"{name}: marker positions are not finite or beyond 2 m; the file is damaged")
    manufacturer, part = (_text(content[start:stop]) for start, stop in ((0x244, 0x250), (0x250, 0x264)))
    return ToolDefinition(content, markers, normals, manufacturer, part)


def _text(field: bytes) -> str:
    return field.split(b"\0")[0].decode("ascii", "replace").strip()
