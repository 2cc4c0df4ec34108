"""A straight path of a needle: where it enters, where its tip stops."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from guidance.errors import InputError
from guidance.needle import Array, Needle
from guidance.rigid import pose


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Entry and final tip position (3,), mm, LPS of the patient."""

    entry: Array
    tip: Array

    def __post_init__(self) -> None:
        for name in ("entry", "tip"):
            point = np.array(getattr(self, name), dtype=np.float64)
            if point.shape != (3,) or not np.isfinite(point).all():
                raise InputError(f"{name} must be three finite numbers in mm, got {getattr(self, name)!r}")
            point.flags.writeable = False
            object.__setattr__(self, name, point)
        if self.depth_mm < 1e-6:
            raise InputError("entry and tip are the same point: a path needs a direction")

    @property
    def depth_mm(self) -> float:
        """Inserted length, mm."""
        return float(np.linalg.norm(self.tip - self.entry))

    @property
    def direction(self) -> Array:
        """Unit vector (3,) from entry to tip."""
        return np.asarray((self.tip - self.entry) / self.depth_mm)

    def point(self, depth_mm: float) -> Array:
        """The point (3,) at a depth along the path, mm from the entry (negative: before it)."""
        return np.asarray(self.entry + depth_mm * self.direction)

    def tip_pose(self, depth_mm: float) -> Array:
        """`T_patient_tip` (4, 4) with the tip at a depth (mm) and the needle along the path.

        The roll about the axis is that of `rigid.pose`, so equal paths give equal poses.
        """
        return pose(self.point(depth_mm), self.direction)

    def needle_axis(self, needle: Needle) -> tuple[Array, Array]:
        """Hub and tip (3,) of the needle at the end of the path, mm."""
        return needle.hub(self.tip, self.direction), self.tip

    def deviation(self, tip: Array, direction: Array) -> tuple[float, float]:
        """How far a tip lies from this path's line (mm) and how far a unit direction turns from it (degrees)."""
        offset = tip - self.entry
        across = offset - (offset @ self.direction) * self.direction
        sine = float(np.linalg.norm(np.cross(self.direction, direction)))
        angle = float(np.degrees(np.arctan2(sine, float(self.direction @ direction))))
        return float(np.linalg.norm(across)), angle

    def to_record(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return {
            "entry_mm": self.entry.tolist(),
            "tip_mm": self.tip.tolist(),
            "direction": self.direction.tolist(),
            "depth_mm": self.depth_mm,
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Trajectory:
        """Back from `to_record`."""
        return cls(np.asarray(record["entry_mm"]), np.asarray(record["tip_mm"]))
