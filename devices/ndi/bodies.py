"""What an emulated tracker sees: rigid bodies that move by formula, or as a recording says."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.errors import DeviceInputError
from devices.frame import ToolStatus, TrackerFrame
from devices.rotation import quaternion_from_rotation

__all__ = ["Bodies", "BodyPose", "RecordedBodies", "SimulatedBodies"]


@dataclass(frozen=True)
class BodyPose:
    """A body as the cameras see it.

    Parameters
    ----------
    quaternion : tuple of 4 floats
        (w, x, y, z), w ≥ 0; float32 values, as the binary replies carry them.
    position_mm : tuple of 3 floats
        float32 values.
    error_mm : float
    out_of_volume : bool
    """

    quaternion: tuple[float, float, float, float]
    position_mm: tuple[float, float, float]
    error_mm: float = 0.1
    out_of_volume: bool = False


def _single(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(np.float32(value)) for value in values)


class Bodies(ABC):
    """A number of bodies and their poses per frame."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of bodies."""

    def name(self, body: int) -> str:
        """Name of a body; a tool on a cable carries it as its part number."""
        return f"BODY-{body}"

    @abstractmethod
    def pose(self, body: int, frame: int) -> BodyPose | None:
        """Pose of a body in the frame counted from the start of tracking, or None where it is not seen."""


class SimulatedBodies(Bodies):
    """Bodies that circle and turn inside a Polaris's volume, each in its own way; any number of them.

    Parameters
    ----------
    count : int
        Bodies that are there; indices beyond it are bodies too.
    rate_hz : float
        Frames per second, to give the motion its speed (at most 60 mm/s and 0.4 rad/s).
    """

    def __init__(self, count: int = 3, rate_hz: float = 60.0) -> None:
        if count < 0:
            raise DeviceInputError(f"a number of tools is ≥ 0, got {count}")
        self._count, self._rate_hz = count, rate_hz

    def __len__(self) -> int:
        return self._count

    def pose(self, body: int, frame: int) -> BodyPose | None:
        """Pose at ``frame / rate_hz``, by formula: the truth that a client can be compared with."""
        t = frame / self._rate_hz
        phase = 0.7 * body
        x = 120.0 * math.cos(0.35 * t + phase) + 60.0 * ((body % 5) - 2)
        y = 90.0 * math.sin(0.42 * t + 1.3 * phase)
        z = -1500.0 - 150.0 * math.sin(0.25 * t + phase) - 12.0 * (body % 7)
        angle = 0.9 * math.sin(0.4 * t + phase)
        tilt = 0.5 + 0.3 * body
        axis = (math.cos(tilt) * 0.8, math.sin(tilt) * 0.8, 0.6)
        half = math.sin(0.5 * angle)
        w, qx, qy, qz = _single((math.cos(0.5 * angle), half * axis[0], half * axis[1], half * axis[2]))
        px, py, pz = _single((x, y, z))
        return BodyPose((w, qx, qy, qz), (px, py, pz), float(np.float32(0.08 + 0.01 * (body % 9))))


class RecordedBodies(Bodies):
    """Bodies that move as recorded: frame k of the device shows recorded frame k, again from the start at the end.

    Parameters
    ----------
    frames : sequence of TrackerFrame
        At least one.
    """

    def __init__(self, frames: Sequence[TrackerFrame]) -> None:
        if not frames:
            raise DeviceInputError("a recording to emulate must hold at least one frame")
        self._frames = frames
        self.names = tuple(dict.fromkeys(name for frame in frames for name in frame.tools))

    def __len__(self) -> int:
        return len(self.names)

    def name(self, body: int) -> str:
        """Name of the recorded tool."""
        return self.names[body % len(self.names)]

    def pose(self, body: int, frame: int) -> BodyPose | None:
        """Recorded pose, or None where the recording has none that is OK or out of volume."""
        tool = self._frames[frame % len(self._frames)].tools.get(self.names[body % len(self.names)])
        if tool is None or tool.T_tracker_tool is None:
            return None
        if tool.status not in (ToolStatus.OK, ToolStatus.OUT_OF_VOLUME):
            return None
        w, x, y, z = _single(quaternion_from_rotation(tool.T_tracker_tool[:3, :3]).tolist())
        px, py, pz = _single(tool.T_tracker_tool[:3, 3].tolist())
        error = 0.0 if math.isnan(tool.error_mm) else float(np.float32(tool.error_mm))
        return BodyPose((w, x, y, z), (px, py, pz), error, tool.status is ToolStatus.OUT_OF_VOLUME)
