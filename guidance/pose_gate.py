"""Which poses count: a tracker frame goes in, a tip pose or the reason for not having one comes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.frame import ToolStatus, TrackerFrame
from guidance.limits import Limits
from guidance.needle import Array
from guidance.rigid import is_rigid

_AGREEING = 3  # poses in a row that make a new place believable after a jump


@dataclass(frozen=True, eq=False)
class Gated:
    """`T_patient_tip` (4, 4) where the pose is trusted, else None and why.

    old: the frame brings nothing new (repeated or late); what is known stays as old as it was.
    restart: the needle was elsewhere before, so its past motion says nothing.
    """

    T_patient_tip: Array | None
    reason: str = ""
    old: bool = False
    restart: bool = False


class PoseGate:
    """Checks frames in the order of arrival; remembers only the last number, time and place."""

    def __init__(self, tool: str, T_patient_tracker: Array | None, T_tool_tip: Array | None, limits: Limits) -> None:
        self._tool = tool
        self._T_patient_tracker = T_patient_tracker
        self._T_tool_tip = T_tool_tip
        self._limits = limits
        self._number: int | None = None
        self._time_s = -np.inf
        self._last: tuple[float, Array] | None = None  # time and tip of the last trusted pose
        self._doubted: list[tuple[float, Array]] = []

    def check(self, frame: TrackerFrame) -> Gated:
        """Judge one frame."""
        if not (np.isfinite(frame.time_s) and np.isfinite(frame.arrival_s)):
            return Gated(None, f"frame {frame.number} has no finite time")
        if self._number is not None and frame.number <= self._number and not self._is_restarted(frame):
            return Gated(None, f"frame number {frame.number} again, after {self._number}: old data", old=True)
        if frame.time_s <= self._time_s and not self._is_restarted(frame):
            return Gated(None, f"frame {frame.number} is no later than the one before: old data", old=True)
        self._number, self._time_s = frame.number, frame.time_s
        reason = self._distrust(frame)
        if reason:
            return Gated(None, reason)
        T = self._T_patient_tracker @ frame.tools[self._tool].T_tracker_tool @ self._T_tool_tip  # type: ignore[operator]
        return self._place(frame.time_s, T)

    def _is_restarted(self, frame: TrackerFrame) -> bool:
        """A tracker started anew counts from the beginning: believe it once its past would be stale anyway."""
        return frame.time_s > self._time_s + self._limits.stale_s

    def _distrust(self, frame: TrackerFrame) -> str:
        limits = self._limits
        if self._T_patient_tracker is None:
            return "not registered: T_patient_tracker is missing"
        if self._T_tool_tip is None:
            return "needle not calibrated: T_tool_tip is missing"
        pose = frame.tools.get(self._tool)
        if pose is None:
            return f"the tracker does not report a tool {self._tool!r}"
        if pose.status is not ToolStatus.OK:
            return f"the tracker says {self._tool!r} is {pose.status.value}"
        if pose.T_tracker_tool is None or not np.isfinite(pose.T_tracker_tool).all():
            return "the pose has no finite numbers"
        if not is_rigid(pose.T_tracker_tool, limits.rigid_tolerance):
            return "the pose is not a rigid transform"
        if pose.error_mm > limits.max_tracker_error_mm:
            return f"the tracker states an error of {pose.error_mm:.2f} mm, above {limits.max_tracker_error_mm:g} mm"
        age = frame.arrival_s - frame.time_s
        if age > limits.stale_s:
            return f"the pose was {age:.2f} s old on arrival"
        return ""

    def _place(self, time_s: float, T: Array) -> Gated:
        """Refuse a jump that no needle makes, unless several poses agree on the new place."""
        tip = T[:3, 3].copy()
        if self._last is None or self._is_reachable(self._last, time_s, tip):
            self._last, self._doubted = (time_s, tip), []
            return Gated(T)
        if self._doubted and not self._is_reachable(self._doubted[-1], time_s, tip):
            self._doubted = []
        self._doubted.append((time_s, tip))
        if len(self._doubted) >= _AGREEING:
            self._last, self._doubted = (time_s, tip), []
            return Gated(T, restart=True)
        jump = float(np.linalg.norm(tip - self._last[1]))
        return Gated(None, f"the needle jumped by {jump:.0f} mm in {time_s - self._last[0]:.3f} s: an outlier")

    def _is_reachable(self, before: tuple[float, Array], time_s: float, tip: Array) -> bool:
        reach = self._limits.max_speed_mm_s * (time_s - before[0]) + 6.0 * self._limits.noise_mm
        return float(np.linalg.norm(tip - before[1])) <= reach
