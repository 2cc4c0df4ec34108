"""The result of planning: ranked paths, and an account of those that were refused."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

from guidance.budget import ErrorBudget
from guidance.trajectory import Trajectory


@dataclass(frozen=True)
class PathClearance:
    """One structure seen from one path, mm: capsule clearance, what was needed of it, the fit error in that, where."""

    clearance_mm: float
    needed_mm: float
    fit_error_mm: float
    at_depth_mm: float
    touch_probability: float

    @property
    def surplus_mm(self) -> float:
        """What is left over the need."""
        return self.clearance_mm - self.needed_mm


@dataclass(frozen=True, eq=False)
class Plan:
    """One safe path: rank 1 is best. `clearances` by structure; `costs` by term (weighted they sum to `cost`)."""

    rank: int
    trajectory: Trajectory
    clearances: Mapping[str, PathClearance]
    costs: Mapping[str, float]
    cost: float
    pareto: bool
    target_miss_mm: float

    @property
    def tightest(self) -> tuple[str, float]:
        """The structure with the least surplus, and that surplus in mm ("" and inf without structures)."""
        if not self.clearances:
            return "", float("inf")
        name = min(self.clearances, key=lambda n: self.clearances[n].surplus_mm)
        return name, self.clearances[name].surplus_mm

    def to_record(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        clearances = {n: {**vars(c), "surplus_mm": c.surplus_mm} for n, c in self.clearances.items()}
        return {
            "rank": self.rank,
            **self.trajectory.to_record(),
            "target_miss_mm": self.target_miss_mm,
            "clearances": clearances,
            "costs": dict(self.costs),
            "cost": self.cost,
            "pareto": self.pareto,
        }


@dataclass(frozen=True, eq=False)
class Rejection:
    """A refused path and every reason found against it, in words with numbers."""

    trajectory: Trajectory | None
    reasons: tuple[str, ...]
    details: tuple[str, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        path = {} if self.trajectory is None else self.trajectory.to_record()
        return {**path, "reasons": list(self.reasons), "details": list(self.details)}


@dataclass(frozen=True, eq=False)
class Plans(Sequence[Plan]):
    """Ranked safe paths (a sequence, best first) and why the others are not among them.

    `rejections` counts candidates per reason (one candidate may fail for several); `only` counts those for which that
    reason was the only one: what would become feasible if just that constraint were lifted.
    """

    scene: str
    scene_hash: str
    errors: ErrorBudget
    needed_without_fit_mm: Mapping[str, float]
    candidates: int
    ranked: tuple[Plan, ...]
    rejected: tuple[Rejection, ...]
    rejections: Mapping[str, int]
    only: Mapping[str, int]
    weights: Mapping[str, float] = field(default_factory=dict)

    @overload
    def __getitem__(self, index: int) -> Plan: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Plan]: ...
    def __getitem__(self, index: int | slice) -> Plan | Sequence[Plan]:
        """The plan of that place, best first."""
        return self.ranked[index]

    def __len__(self) -> int:
        return len(self.ranked)

    def __iter__(self) -> Iterator[Plan]:
        return iter(self.ranked)

    @property
    def best(self) -> Plan | None:
        """The first plan, or None where no path is safe."""
        return self.ranked[0] if self.ranked else None

    @property
    def why_none(self) -> str:
        """In one sentence, which constraints forbid every candidate; "" where there is a plan."""
        if self.ranked:
            return ""
        if not self.candidates:
            return "there is no candidate: no entry point is given or allowed"
        counts = ", ".join(f"{reason} {n}" for reason, n in self.rejections.items())
        universal = [reason for reason, n in self.rejections.items() if n == self.candidates]
        said = f"no safe path among {self.candidates} candidates; ruled out by: {counts}"
        if universal:
            return f"{said}; {' and '.join(repr(u) for u in universal)} forbids every one"
        if self.only:
            helps = max(self.only, key=lambda reason: self.only[reason])
            return f"{said}; without {helps!r} alone, {self.only[helps]} would be safe"
        return f"{said}; no single constraint forbids all, and lifting one alone frees none"

    def to_record(self, plans: int = 20, rejected: int = 200) -> dict[str, Any]:
        """Plain numbers for JSON: the best plans, and the refused paths that came closest to being safe."""
        return {
            "scene": self.scene,
            "scene_hash": self.scene_hash,
            "feasible": len(self.ranked),
            "candidates": self.candidates,
            "why_none": self.why_none,
            "error_budget": {
                **self.errors.to_record(),
                "needed_without_fit_mm": dict(self.needed_without_fit_mm),
                "rule": "capsule clearance >= margin + registration + tracker + bending + fit error "
                f"({self.errors.fit} of the leaf nearest to the path)",
            },
            "rejections": dict(self.rejections),
            "rejections_for_this_reason_only": dict(self.only),
            "cost_weights": dict(self.weights),
            "plans": [p.to_record() for p in self.ranked[:plans]],
            "rejected": [r.to_record() for r in self.rejected[:rejected]],
        }

    def save(self, path: str | Path, **extra: Any) -> None:
        """Write `to_record` and further keys as JSON."""
        text = json.dumps({**self.to_record(), **extra}, indent=1, allow_nan=False)
        Path(path).write_text(text + "\n", encoding="utf-8")
