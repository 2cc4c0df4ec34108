"""Readers of two public kinds of CSV: one row per frame and transform, and the NDI Aurora's one row per sample."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from devices.errors import DeviceInputError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.rotation import is_rigid, pose_from_quaternion

__all__ = ["read_csv_frames"]

_TRANSFORM_COLUMNS = ["frame", "timestamp", "unfiltered_timestamp", "frame_number", "name", "status"]
_MATRIX_COLUMNS = [f"m{row}{column}" for row in range(3) for column in range(4)]
_STATUS = {
    "OK": ToolStatus.OK,
    "MISSING": ToolStatus.MISSING,
    "OUT_OF_VIEW": ToolStatus.MISSING,
    "OUT_OF_VOLUME": ToolStatus.OUT_OF_VOLUME,
    "PARTIALLY_OUT_OF_VOLUME": ToolStatus.PARTIALLY_OUT_OF_VOLUME,
    "DISABLED": ToolStatus.DISABLED,
}
_AURORA_COLUMNS = ["Sample:", "Hour", "Minutes", "Seconds", "ms"]
_DAY_S = 86_400.0


def read_csv_frames(path: Path, text: str) -> list[TrackerFrame] | None:
    """Return the frames of a CSV recording, or None where the text is none of the known kinds.

    Parameters
    ----------
    path : Path
        For messages.
    text : str
        The whole file.

    Raises
    ------
    DeviceInputError
        Where a row of a known kind cannot be read.
    """
    lines = text.splitlines()
    first = [cell.strip() for cell in lines[0].split(",")] if lines else []
    if first == _TRANSFORM_COLUMNS + _MATRIX_COLUMNS:
        return _transform_frames(path, csv.reader(lines[1:]))
    for row, line in enumerate(lines[:20]):
        if [cell.strip() for cell in line.split(",")][:5] == _AURORA_COLUMNS:
            return _aurora_frames(lines[row].split(","), lines[row + 1 :])
    return None


def _transform_pose(status: str, cells: list[str]) -> ToolPose:
    if any(cell == "" for cell in cells):
        return ToolPose(ToolStatus.MISSING if status in ("OK", "") else _STATUS.get(status, ToolStatus.INVALID), None)
    T = np.eye(4)
    T[:3] = np.reshape([float(cell) for cell in cells], (3, 4))
    # a row without a status is not known to be good, and OK on a matrix that is no pose is no pose
    trusted = _STATUS.get(status, ToolStatus.INVALID)
    if trusted is ToolStatus.OK and not is_rigid(T):
        trusted = ToolStatus.INVALID
    return ToolPose(trusted, T)


def _transform_frames(path: Path, rows: Iterable[list[str]]) -> list[TrackerFrame]:
    """One row per frame and transform: a tool is named as its transform (`StylusToTracker`)."""
    frames: list[TrackerFrame] = []
    tools: dict[str, ToolPose] = {}
    current: tuple[str, int, float, float] | None = None
    for line, row in enumerate(rows, start=2):
        if not row:
            continue
        try:
            index, time_s, unfiltered_s, number, name, status, *cells = row
            if len(cells) != 12:
                raise ValueError(f"{len(cells)} matrix entries instead of 12")
            head = (index, int(number or index), float(time_s), float(unfiltered_s or time_s))
            pose = _transform_pose(status, cells)
        except ValueError as error:
            raise DeviceInputError(f"{path}: line {line}: {error}: {','.join(row)[:80]!r}") from None
        if current is not None and head[0] != current[0]:
            frames.append(TrackerFrame(*current[1:], tools))
            tools = {}
        if not tools:
            current = head
        tools[name] = pose
    if current is not None:
        frames.append(TrackerFrame(*current[1:], tools))
    return frames


def _aurora_pose(cells: list[str]) -> ToolPose:
    x, y, z, *quaternion = (float(cell) for cell in cells)
    # the logger writes zeros where the sensor was not seen; a quaternion has length 1, never 0
    length = math.sqrt(sum(q * q for q in quaternion))
    if not abs(length - 1.0) < 0.01 or not math.isfinite(x + y + z):
        return ToolPose(ToolStatus.MISSING if length == 0.0 else ToolStatus.INVALID, None)
    return ToolPose(ToolStatus.OK, pose_from_quaternion(quaternion, (x, y, z)))


def _aurora_frames(header: list[str], lines: list[str]) -> list[TrackerFrame]:
    """One row per sample: time of day, then x y z q0 qx qy qz of each sensor, named by its letter."""
    names = [cell.strip()[1:] for cell in header[5::7] if cell.strip()]
    frames: list[TrackerFrame] = []
    day_s = 0.0
    for line in lines:
        cells = [cell.strip() for cell in line.split(",")]
        try:
            number, hour, minute, second, millisecond = (int(cell) for cell in cells[:5])
            poses = [_aurora_pose(cells[5 + 7 * k : 12 + 7 * k]) for k in range(len(names))]
        except ValueError:
            # the logger was stopped in the middle of a row, or wrote a remark: no sample
            continue
        time_s = day_s + 3600.0 * hour + 60.0 * minute + second + 0.001 * millisecond
        if frames and time_s < frames[-1].time_s - 0.5 * _DAY_S:
            day_s += _DAY_S
            time_s += _DAY_S
        frames.append(TrackerFrame(number, time_s, time_s, dict(zip(names, poses, strict=True))))
    return frames
