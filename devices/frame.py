"""What every tracker delivers: a numbered, timed frame with one pose or one reason per tool."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceInputError

__all__ = ["ToolPose", "ToolStatus", "TrackerFrame"]


class ToolStatus(enum.Enum):
    """Why a tool has a pose to be trusted, or has none. Only `OK` carries a trusted pose."""

    OK = "ok"
    MISSING = "missing"
    OUT_OF_VOLUME = "out of volume"
    PARTIALLY_OUT_OF_VOLUME = "partially out of volume"
    DISABLED = "disabled"
    INVALID = "invalid"


def _same(a: NDArray[np.float64] | None, b: NDArray[np.float64] | None) -> bool:
    if a is None or b is None:
        return a is b
    return np.array_equal(a, b, equal_nan=True)


def _frozen(array: object, shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    try:
        copy = np.array(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise DeviceInputError(f"{name}: expected an array of numbers, got {array!r}") from None
    if copy.ndim != len(shape) or any(want not in (got, -1) for got, want in zip(copy.shape, shape, strict=True)):
        wanted = str(shape).replace("-1", "n")
        raise DeviceInputError(f"{name}: expected shape {wanted}, got {copy.shape}")
    copy.setflags(write=False)
    return copy


@dataclass(frozen=True, eq=False)
class ToolPose:
    """One tool in one frame.

    Parameters
    ----------
    status : ToolStatus
        Only `ToolStatus.OK` carries a trusted pose.
    T_tracker_tool : (4, 4) array or None
        Pose, mm; None where there is none. It may be present with another status (out of volume): not to be trusted.
        Kept as a read-only copy.
    error_mm : float
        The tracker's own rms marker error, NaN where it states none.
    markers_mm : (n, 3) array or None
        The tool's single markers in the tracker's frame, where the tracker was asked for them; NaN rows are not seen.
    switches : int
        Bit k is set while switch k of the tool is pressed.
    """

    status: ToolStatus
    T_tracker_tool: NDArray[np.float64] | None
    error_mm: float = math.nan
    markers_mm: NDArray[np.float64] | None = None
    switches: int = 0

    def __post_init__(self) -> None:
        if self.T_tracker_tool is not None:
            object.__setattr__(self, "T_tracker_tool", _frozen(self.T_tracker_tool, (4, 4), "T_tracker_tool"))
        elif self.status is ToolStatus.OK:
            raise DeviceInputError("ToolPose: status OK needs a pose; use another status where there is none")
        if self.markers_mm is not None:
            object.__setattr__(self, "markers_mm", _frozen(self.markers_mm, (-1, 3), "markers_mm"))

    def same(self, other: ToolPose) -> bool:
        """Tell whether `other` holds the same values bit for bit (NaN equals NaN)."""
        return (
            self.status is other.status
            and _same(self.T_tracker_tool, other.T_tracker_tool)
            and (self.error_mm == other.error_mm or (math.isnan(self.error_mm) and math.isnan(other.error_mm)))
            and _same(self.markers_mm, other.markers_mm)
            and self.switches == other.switches
        )


@dataclass(frozen=True, eq=False)
class TrackerFrame:
    """One frame of a tracker.

    Parameters
    ----------
    number : int
        The device's frame number, non-decreasing; a repeated number is old data.
    time_s : float
        When the poses were valid, on the clock of `arrival_s` (device time mapped, or arrival less the latency).
    arrival_s : float
        When the frame reached us.
    tools : mapping of str to ToolPose
        Every tool that the tracker reports, seen or not. Kept as a read-only copy.
    strays_mm : (n, 3) array or None
        Markers that belong to no tool, in the tracker's frame, where the tracker was asked for them.
    """

    number: int
    time_s: float
    arrival_s: float
    tools: Mapping[str, ToolPose] = field(default_factory=dict)
    strays_mm: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "tools", MappingProxyType(dict(self.tools)))
        if self.strays_mm is not None:
            object.__setattr__(self, "strays_mm", _frozen(self.strays_mm, (-1, 3), "strays_mm"))

    def same(self, other: TrackerFrame) -> bool:
        """Tell whether `other` holds the same values bit for bit, tools in the same order (NaN equals NaN)."""
        return (
            (self.number, self.time_s, self.arrival_s) == (other.number, other.time_s, other.arrival_s)
            and list(self.tools) == list(other.tools)
            and all(pose.same(other.tools[name]) for name, pose in self.tools.items())
            and _same(self.strays_mm, other.strays_mm)
        )
