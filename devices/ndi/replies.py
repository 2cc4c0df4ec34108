"""What tracking replies say, whether they came as TX, BX or BX2, and how that becomes a `ToolPose`.

Option bits 0001 pose and status, 0002 tool information, 0004 single stray, 0008 markers of
each tool, 0800 report poses out of volume too, 1000 stray markers.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.frame import ToolPose, ToolStatus
from devices.rotation import pose_from_quaternion

__all__ = [
    "HandleReport",
    "HandleState",
    "Option",
    "PoseReport",
    "tool_pose",
]

Point = tuple[float, float, float]
# port status bits (TX, BX)
INITIALISED, ENABLED, OUT_OF_VOLUME, PARTIALLY_OUT_OF_VOLUME = 0x10, 0x20, 0x40, 0x80
# codes of BX2's status with a meaning for a pose
BX2_PARTLY_OUT, BX2_OUT, BX2_FEW_MARKERS, BX2_TOOL_MISSING = 0x03, 0x09, 0x0D, 0x1F


class Option(enum.IntFlag):
    """Reply options of TX and BX."""

    POSES = 0x0001
    TOOL_INFORMATION = 0x0002
    SINGLE_STRAY = 0x0004
    TOOL_MARKERS = 0x0008
    OUT_OF_VOLUME = 0x0800
    STRAYS = 0x1000


class HandleState(enum.Enum):
    """What a reply says about a port handle before any number."""

    TRACKED = "tracked"
    MISSING = "missing"
    DISABLED = "disabled"
    UNOCCUPIED = "unoccupied"


@dataclass(frozen=True)
class HandleReport:
    """One port handle in one reply.

    Parameters
    ----------
    handle : int
    state : HandleState
    quaternion : tuple of 4 floats or None
        (w, x, y, z) as sent.
    position_mm : tuple of 3 floats or None
    error_mm : float
        NaN where there is no pose.
    port_status : int
        Status bits of TX and BX; of BX2 translated into them as far as they have a place there.
    frame : int or None
        Device frame number, 32 bits.
    markers_mm : tuple of points or None
        Where asked for.
    code : int
        Error code of BX2's status (0: none).
    """

    handle: int
    state: HandleState
    quaternion: tuple[float, float, float, float] | None = None
    position_mm: Point | None = None
    error_mm: float = math.nan
    port_status: int = 0
    frame: int | None = None
    markers_mm: tuple[Point, ...] | None = None
    code: int = 0


@dataclass(frozen=True)
class PoseReport:
    """One tracking reply.

    Parameters
    ----------
    handles : tuple of HandleReport
    system_status : int
        Status bits of TX and BX; 0 in BX2.
    strays_mm : tuple of points or None
        Where asked for.
    device_time_s : float or None
        BX2's own timestamp.
    alerts : tuple of (kind, code)
        System alerts of BX2.
    """

    handles: tuple[HandleReport, ...]
    system_status: int = 0
    strays_mm: tuple[Point, ...] | None = None
    device_time_s: float | None = None
    alerts: tuple[tuple[int, int], ...] = ()


def tool_pose(report: HandleReport, markers: bool = False) -> ToolPose:
    """Turn one handle's report into a `ToolPose`: OK only where the device states no reservation at all.

    A quaternion whose length is off by more than 1 %, or a number that is not finite, is INVALID.
    """
    status = _status(report)
    switches = (report.port_status >> 1) & 0x7
    points: NDArray[np.float64] | None = None
    if markers:
        points = np.array(report.markers_mm or (), dtype=np.float64).reshape(-1, 3)
    T = None
    if report.quaternion is not None and report.position_mm is not None:
        length = math.sqrt(sum(q * q for q in report.quaternion))
        if math.isfinite(sum(report.position_mm)) and abs(length - 1.0) < 0.01:
            T = pose_from_quaternion(report.quaternion, report.position_mm)
        else:
            status = ToolStatus.INVALID
    if T is None and status is ToolStatus.OK:
        status = ToolStatus.INVALID
    return ToolPose(status, T, report.error_mm if T is not None else math.nan, points, switches)


def _status(report: HandleReport) -> ToolStatus:
    if report.state in (HandleState.DISABLED, HandleState.UNOCCUPIED):
        return ToolStatus.DISABLED
    if report.port_status & OUT_OF_VOLUME:
        return ToolStatus.OUT_OF_VOLUME
    if report.state is HandleState.MISSING:
        return ToolStatus.MISSING
    if report.port_status & PARTIALLY_OUT_OF_VOLUME:
        return ToolStatus.PARTIALLY_OUT_OF_VOLUME
    if report.port_status & (INITIALISED | ENABLED) != INITIALISED | ENABLED:
        return ToolStatus.DISABLED
    if report.code not in (0, BX2_PARTLY_OUT, BX2_OUT):
        return ToolStatus.MISSING if report.code in (BX2_FEW_MARKERS, BX2_TOOL_MISSING) else ToolStatus.INVALID
    return ToolStatus.OK
