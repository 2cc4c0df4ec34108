"""What a scene is made of: structures, the target, the entry."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from guidance.errors import SceneError
from guidance.needle import Array

if TYPE_CHECKING:
    from hhsr import Shape

AVOID, TARGET, ENTRY, PASS = ROLES = ("avoid", "target", "entry", "pass")


@dataclass(frozen=True, eq=False)
class Structure:
    """One thing in the patient.

    Parameters
    ----------
    name : str
    shape : hhsr.Shape or None
        LPS, mm. None where the model is missing: planning refuses then, the monitor says UNKNOWN.
    role : {"avoid", "target", "entry", "pass"}
        `avoid` raises alarms and rules out paths; `target` is where to go; `entry` is the surface that the needle
        goes in through, once; `pass` may be crossed and is only reported.
    margin_mm : float
        Tissue to be left between the needle's surface and this structure, before any error is added.
    source : str
        Where the shape came from, for the record.
    """

    name: str
    shape: Shape | None
    role: str = AVOID
    margin_mm: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise SceneError(f"structure {self.name!r}: role is {self.role!r}; choose one of {', '.join(ROLES)}")
        if not (np.isfinite(self.margin_mm) and 0.0 <= self.margin_mm <= 100.0):
            raise SceneError(f"structure {self.name!r}: margin_mm is {self.margin_mm!r}; expected 0 to 100 mm")

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of the shape's stored form; "" where there is no shape."""
        return "" if self.shape is None else shape_hash(self.shape)


@dataclass(frozen=True, eq=False)
class Target:
    """The point (3,) to be reached, mm LPS, within a tolerance; `structure` names the shape around it, if any."""

    point: Array
    tolerance_mm: float = 2.0
    structure: str | None = None

    def __post_init__(self) -> None:
        point = np.array(self.point, dtype=np.float64)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise SceneError(f"target point must be three finite numbers in mm, got {self.point!r}")
        if not (np.isfinite(self.tolerance_mm) and 0.0 <= self.tolerance_mm <= 100.0):
            raise SceneError(f"target tolerance_mm is {self.tolerance_mm!r}; expected 0 to 100 mm")
        point.flags.writeable = False
        object.__setattr__(self, "point", point)


@dataclass(frozen=True, eq=False)
class Entry:
    """Where the needle may go in: on a structure's surface, or through given points.

    Parameters
    ----------
    points : (n, 3) array
        Entry points, mm LPS (the holes of a template, or a list). Empty: drawn from the structure's surface.
    structure : str or None
        The structure that is entered: its surface is crossed once, inwards, and not left again before the tip.
    count : int
        How many points to draw from the surface (spread evenly).
    near, within_mm : (3,) array or None, float
        Allowed region: only entries within this distance of a point.
    max_angle_deg : float
        Largest angle between the path and the surface's inward normal (surface entries only).
    """

    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    structure: str | None = None
    count: int = 1500
    near: Array | None = None
    within_mm: float = np.inf
    max_angle_deg: float = 80.0

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise SceneError("entry points must be finite numbers in mm")
        if not len(points) and self.structure is None:
            raise SceneError("entry: give `structure`, `points` or a `template`")
        if not 1 <= self.count <= 100_000:
            raise SceneError(f"entry count is {self.count!r}; expected 1 to 100000")
        if not 0.0 < self.max_angle_deg <= 90.0:
            raise SceneError(f"entry max_angle_deg is {self.max_angle_deg!r}; expected more than 0, up to 90")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)


def shape_hash(shape: Shape) -> str:
    """First 16 hex digits of the SHA-256 of a shape's stored form."""
    return hashlib.sha256(shape.encoded).hexdigest()[:16]
