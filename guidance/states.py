"""What the monitor says: states, one line per structure, events, and the report that holds them."""

from __future__ import annotations

import enum
import hashlib
import json
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any

from guidance.needle import Array


class State(enum.Enum):
    """Where the needle stands to a structure. `UNKNOWN` is never a kind of `CLEAR`: nothing can be said."""

    CLEAR = "CLEAR"
    APPROACHING = "APPROACHING"
    CONTACT = "CONTACT"
    INSIDE = "INSIDE"
    UNKNOWN = "UNKNOWN"


SEVERITY = {State.CLEAR: 0, State.APPROACHING: 1, State.CONTACT: 2, State.INSIDE: 3}


@dataclass(frozen=True)
class Forecast:
    """First contact ahead if the needle goes on as it moves now.

    `seconds` is the likeliest, [`earliest_s`, `latest_s`] what noise, the uncertain velocity and the uncertain time of
    the pose allow at the stated coverage, all counted from the report's time. inf: not within the horizon.
    `certain`: within that uncertainty contact cannot fail to come. Where it can (a thin vessel that the tip may just
    pass), the interval says when contact comes if it comes. `travel_mm` is the tip's way until then.
    """

    seconds: float = inf
    earliest_s: float = inf
    latest_s: float = inf
    travel_mm: float = inf
    certain: bool = False

    def later(self, by_s: float) -> Forecast:
        """The same forecast, counted from `by_s` seconds later."""
        return Forecast(
            max(self.seconds - by_s, 0.0),
            max(self.earliest_s - by_s, 0.0),
            max(self.latest_s - by_s, 0.0),
            self.travel_mm,
            self.certain,
        )


@dataclass(frozen=True)
class StructureReport:
    """One structure at one moment.

    distance_mm: capsule clearance to the shape (≤ 0: touched; NaN: unknown), never more than the truth.
    ahead_mm: along the needle's axis from the tip to the surface; inf where the axis meets none.
    needed_mm: margin plus error budget (with the fit error of the nearest leaf): closer than this is APPROACHING.
    """

    name: str
    role: str
    state: State
    reason: str
    shape_hash: str
    distance_mm: float = nan
    ahead_mm: float = nan
    needed_mm: float = nan
    fit_error_mm: float = nan
    forecast: Forecast = Forecast()


@dataclass(frozen=True)
class Event:
    """A change of state of one structure. `alarm` is True where a structure to avoid is approached, met or lost."""

    time_s: float
    structure: str
    before: State
    after: State
    reason: str
    distance_mm: float
    forecast: Forecast
    frame_number: int
    role: str
    alarm: bool

    def to_record(self) -> dict[str, Any]:
        """Plain values for JSON; numbers that do not exist are null."""
        f = self.forecast
        return {
            "time_s": self.time_s,
            "structure": self.structure,
            "from": self.before.value,
            "to": self.after.value,
            "reason": self.reason,
            "distance_mm": number(self.distance_mm),
            "seconds_to_contact": number(f.seconds),
            "seconds_to_contact_interval": [number(f.earliest_s), number(f.latest_s)],
            "contact_certain": f.certain,
            "frame_number": self.frame_number,
            "role": self.role,
            "alarm": self.alarm,
        }


@dataclass(frozen=True, eq=False)
class Report:
    """Everything the monitor knows at one moment; times in s on the tracker's clock, lengths in mm, LPS.

    tip, direction: of the pose that was last accepted, None where there is none. `pose_age_s` is inf without one.
    deviation: distance of the tip from the planned line (mm) and angle to it (degrees); NaN without a plan.
    """

    time_s: float
    frame_number: int
    pose_age_s: float
    tip: Array | None
    direction: Array | None
    speed_mm_s: float
    depth_mm: float
    deviation_mm: float
    deviation_deg: float
    structures: tuple[StructureReport, ...]
    events: tuple[Event, ...]
    errors: dict[str, Any]
    scene_hash: str

    @property
    def state(self) -> State:
        """The gravest state among the structures to avoid (all, if none is to be avoided): CLEAR only if all are."""
        watched = [s.state for s in self.structures if s.role == "avoid"] or [s.state for s in self.structures]
        known = max((s for s in watched if s is not State.UNKNOWN), key=SEVERITY.__getitem__, default=State.UNKNOWN)
        return State.UNKNOWN if known is State.CLEAR and State.UNKNOWN in watched else known

    def structure(self, name: str) -> StructureReport:
        """The line of that structure; KeyError if there is none."""
        for s in self.structures:
            if s.name == name:
                return s
        raise KeyError(f"no structure is called {name!r}; there are {', '.join(s.name for s in self.structures)}")

    def to_record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "time_s": self.time_s,
            "frame_number": self.frame_number,
            "pose_age_s": number(self.pose_age_s),
            "tip_mm": None if self.tip is None else self.tip.tolist(),
            "direction": None if self.direction is None else self.direction.tolist(),
            "speed_mm_s": number(self.speed_mm_s),
            "depth_mm": number(self.depth_mm),
            "deviation_mm": number(self.deviation_mm),
            "deviation_deg": number(self.deviation_deg),
            "state": self.state.value,
            "structures": [_structure_record(s) for s in self.structures],
            "events": [e.to_record() for e in self.events],
            "errors": self.errors,
            "scene_hash": self.scene_hash,
        }

    @property
    def digest(self) -> str:
        """16 hex digits of the SHA-256 of the whole report: two reports with one digest are the same bit for bit."""
        return hashlib.sha256(json.dumps(self.to_record(), sort_keys=True).encode()).hexdigest()[:16]


def number(value: float) -> float | None:
    """The value, or None where JSON has no number for it."""
    return float(value) if isfinite(value) else None


def _structure_record(s: StructureReport) -> dict[str, Any]:
    f = s.forecast
    return {
        "name": s.name,
        "role": s.role,
        "state": s.state.value,
        "reason": s.reason,
        "shape_hash": s.shape_hash,
        "distance_mm": number(s.distance_mm),
        "ahead_mm": number(s.ahead_mm),
        "needed_mm": number(s.needed_mm),
        "fit_error_mm": number(s.fit_error_mm),
        "seconds_to_contact": number(f.seconds),
        "seconds_to_contact_interval": [number(f.earliest_s), number(f.latest_s)],
        "contact_certain": f.certain,
        "travel_mm": number(f.travel_mm),
    }
