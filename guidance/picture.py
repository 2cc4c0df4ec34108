"""One picture of a session: two slices through the path, the gaps along it, and the warnings as they came."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from guidance.needle import Array
from guidance.planning.plans import Plans
from guidance.scene import AVOID, Scene, Structure
from guidance.simulation import Outcome
from guidance.states import SEVERITY, State
from guidance.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INK = "#222222"
_PLANNED, _WRONG = "#1a7f37", "#c62828"
_TARGET, _HOST, _SKIN = "#f4a300", "#e3b59a", "#e8dccb"
_AVOID = ("#2b6cb0", "#7b3fa0", "#0f8b8d", "#8a8d91", "#b5541c", "#5c6bc0", "#607d3b", "#ad1457")
_STATE_COLOURS = {
    State.CLEAR: "#dff2e1",
    State.APPROACHING: "#ffe9b0",
    State.CONTACT: "#ffc4bd",
    State.INSIDE: "#f39a9a",
    State.UNKNOWN: "#d9d9d9",
}
_PIXEL_MM = 0.5
#: width of a letter of 8 points as a share of the width of one of the lower graphs
_LETTER = 0.0115


@dataclass(frozen=True, eq=False)
class _Plane:
    """A slice: origin (3,) and its depth along the path, in-plane unit axes right and down (3,), half size; mm."""

    origin: Array
    right: Array
    down: Array
    half_mm: float
    depth_mm: float

    def flat(self, points: Array) -> Array:
        """In-plane coordinates (..., 2), mm."""
        offset = points - self.origin
        return np.stack([offset @ self.right, offset @ self.down], axis=-1)

    def grid(self) -> tuple[Array, Array]:
        """Pixel coordinates (n,) along either axis, and the points (n, n, 3)."""
        n = int(2 * self.half_mm / _PIXEL_MM)
        axis = np.linspace(-self.half_mm, self.half_mm, n)
        points = self.origin + axis[None, :, None] * self.right + axis[:, None, None] * self.down
        return axis, points


def draw_session(path: Path, scene: Scene, plans: Plans, outcomes: Sequence[Outcome]) -> None:
    """Write a PNG of a session.

    Parameters
    ----------
    path : Path
    scene : Scene
    plans : Plans
        The best one is drawn green.
    outcomes : sequence of Outcome
        Simulated insertions; the last one, the wrong one, is drawn red with its warnings.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    colours = _colours(scene)
    planned = plans.best.trajectory if plans.best else None
    wrong = outcomes[-1] if outcomes else None
    main = planned or (wrong.path if wrong else None)
    figure = Figure(figsize=(15.0, 11.0), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.45, 1.0))
    if main is None:
        figure.suptitle(f"{scene.name}: {plans.why_none}", wrap=True)
        figure.savefig(path, dpi=110)
        return
    other = wrong.path.tip if wrong is not None and planned is not None else None
    for column, plane in enumerate(_planes(scene, main, other)):
        axes = figure.add_subplot(grid[0, column])
        _draw_slice(axes, scene, plane, colours)
        if planned is not None:
            _draw_path(axes, plane, planned, _PLANNED, "planned path")
        if wrong is not None and (column == 0 or planned is None):
            _draw_path(axes, plane, wrong.path, _WRONG, "driven wrong")
            _draw_events(axes, plane, wrong)
        axes.set_title(
            "Slice that holds both paths"
            if column == 0 and other is not None
            else "Slice along the path"
            if column == 0
            else "The same path seen from the side (slice turned by 90°)"
        )
    axes = figure.axes[0]
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.08), fontsize=8, ncols=4)
    _draw_gaps(figure.add_subplot(grid[1, 0]), scene, plans, main, colours)
    _draw_warnings(figure.add_subplot(grid[1, 1]), scene, wrong, colours)
    figure.suptitle(_headline(scene, plans), fontsize=13)
    figure.savefig(path, dpi=110)


def _headline(scene: Scene, plans: Plans) -> str:
    best = plans.best
    if best is None:
        return f"{scene.name}: no safe path among {plans.candidates} candidates"
    name, surplus = best.tightest
    said = (
        f"{scene.name}: {len(plans)} safe paths of {plans.candidates}; best is {best.trajectory.depth_mm:.0f} mm deep"
    )
    return (
        f"{said}, {best.clearances[name].clearance_mm:.1f} mm from {name} ({surplus:.1f} more than needed)"
        if name
        else said
    )


def _colours(scene: Scene) -> dict[str, str]:
    colours, k = {}, 0
    for s in scene.structures:
        if s.role == AVOID:
            colours[s.name] = _AVOID[k % len(_AVOID)]
            k += 1
        else:
            colours[s.name] = {"target": _TARGET, "entry": _SKIN}.get(s.role, _HOST)
    return colours


def _planes(scene: Scene, path: Trajectory, other: Array | None) -> tuple[_Plane, _Plane]:
    """The plane through the path and another point (or the tightest gap), and the one across it."""
    down = path.direction
    side = np.zeros(3) if other is None else (other - path.entry) - ((other - path.entry) @ down) * down
    if np.linalg.norm(side) < 1.0:
        side = np.eye(3)[int(np.argmin(np.abs(down)))]
        side = side - (side @ down) * down
    right = side / np.linalg.norm(side)
    depth = 0.5 * path.depth_mm
    origin = path.point(depth)
    reach = 0.0 if other is None else float(np.abs((other - origin) @ np.stack([right, down], axis=1)).max()) + 8.0
    half = float(np.clip(max(depth + 35.0, reach), 50.0, 140.0))
    return _Plane(origin, right, down, half, depth), _Plane(origin, np.cross(down, right), down, half, depth)


def _draw_slice(axes: Axes, scene: Scene, plane: _Plane, colours: dict[str, str]) -> None:
    order = {"entry": 0, "pass": 1, "target": 2, AVOID: 3}
    axis, points = plane.grid()
    for s in sorted(scene.structures, key=lambda s: order[s.role]):
        if s.shape is None:
            continue
        inside = s.shape.contains(points)
        if not inside.any():
            continue
        colour = colours[s.name]
        axes.contourf(axis, axis, inside, levels=[0.5, 1.5], colors=[colour], alpha=0.45 if s.role != "entry" else 0.35)
        axes.contour(axis, axis, inside.astype(float), levels=[0.5], colors=[colour], linewidths=1.4)
        axes.plot([], [], color=colour, linewidth=6, alpha=0.6, label=_role_label(s))
    axes.set_aspect("equal")
    axes.set_xlim(-plane.half_mm, plane.half_mm)
    axes.set_xlabel("mm across the path")
    axes.set_ylabel("depth, mm (the needle comes from above)")
    ticks = np.arange(-200.0, 400.0, 20.0)
    axes.set_yticks(ticks - plane.depth_mm, [f"{t:.0f}" for t in ticks])
    axes.set_ylim(plane.half_mm, -plane.half_mm)
    for position, vector, where in (
        ((0.985, 0.5), plane.right, "right"),
        ((0.015, 0.5), -plane.right, "left"),
        ((0.5, 0.015), plane.down, "center"),
        ((0.5, 0.965), -plane.down, "center"),
    ):
        axes.text(
            *position, _letters(vector), transform=axes.transAxes, ha=where, fontsize=12, color=_INK, weight="bold"
        )


def _role_label(s: Structure) -> str:
    return {"target": f"{s.name} (target)", AVOID: f"{s.name} (avoid)"}.get(s.role, s.name)


def _letters(vector: Array) -> str:
    """The patient's directions that a vector points to, the strongest first: L/R, P/A, S/I."""
    pairs = ("LR", "PA", "SI")
    order = np.argsort(-np.abs(vector))
    return "".join(pairs[k][int(vector[k] < 0.0)] for k in order if abs(vector[k]) > 0.4)


def _draw_path(axes: Axes, plane: _Plane, path: Trajectory, colour: str, label: str) -> None:
    before = path.point(-30.0)
    line = plane.flat(np.stack([before, path.entry, path.tip]))
    axes.plot(line[:, 0], line[:, 1], color="white", linewidth=4.2, solid_capstyle="round")
    axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=2.4, solid_capstyle="round", label=label)
    axes.plot(*line[1], marker="o", color=colour, markersize=6, markeredgecolor="white")
    axes.plot(*line[2], marker="v", color=colour, markersize=9, markeredgecolor="white")


_EVENT_MARKS = {State.APPROACHING: ("D", "#ffb300"), State.CONTACT: ("X", "#d50000"), State.INSIDE: ("s", "#7f0000")}


def _draw_events(axes: Axes, plane: _Plane, outcome: Outcome) -> None:
    """Where the tip was when a structure to avoid was approached or met."""
    drawn: set[State] = set()
    for e in outcome.alarms:
        if e.after not in _EVENT_MARKS or SEVERITY[e.after] < SEVERITY.get(e.before, 0):
            continue
        marker, colour = _EVENT_MARKS[e.after]
        at = plane.flat(outcome.path.point(float(np.interp(e.time_s, outcome.times, outcome.depths))))
        label = None if e.after in drawn else f"tip at {e.after.value}"
        axes.plot(*at, marker=marker, color=colour, markersize=10, markeredgecolor=_INK, linestyle="none", label=label)
        drawn.add(e.after)


def _draw_gaps(axes: Axes, scene: Scene, plans: Plans, path: Trajectory, colours: dict[str, str]) -> None:
    """Gap between the needle's surface and each structure at every depth of the path, with what is needed."""
    depth = np.linspace(-20.0, path.depth_mm, 200)
    points = path.entry + depth[:, None] * path.direction
    top = 0.0
    for s in scene.avoid:
        if s.shape is None:
            continue
        gap = s.shape.signed_distance(points) - scene.needle.radius_mm
        axes.plot(depth, gap, color=colours[s.name], linewidth=2.0, label=s.name)
        needed = plans.needed_without_fit_mm[s.name]
        if plans.best is not None:
            needed = plans.best.clearances[s.name].needed_mm
        axes.axhline(needed, color=colours[s.name], linewidth=1.0, linestyle=(0, (4, 3)))
        top = max(top, needed, float(gap.min()))
    axes.axhline(0.0, color=_INK, linewidth=1.0)
    axes.set_ylim(-2.0, max(25.0, top + 10.0))
    axes.set_xlim(depth[0], depth[-1])
    axes.set_xlabel("depth of the point along the path, mm (0: entry)")
    axes.set_ylabel("gap to the needle, mm")
    axes.set_title("How near the path passes (dashed: margin + error budget)")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4)
    axes.grid(alpha=0.25)


def _draw_warnings(axes: Axes, scene: Scene, outcome: Outcome | None, colours: dict[str, str]) -> None:
    """Reported distances over time of the wrong insertion, the states in the background, stated intervals as bars."""
    if outcome is None:
        axes.text(0.5, 0.5, "no insertion was simulated", ha="center", transform=axes.transAxes)
        return
    met = [w for w in outcome.warnings if w.role == AVOID and (w.raised_s < np.inf or w.truth_s < np.inf)]
    worst = min(met, key=lambda w: (w.truth_s, w.raised_s), default=None)
    if worst is not None:
        _shade(axes, outcome.times, outcome.states[worst.structure])
    for s in scene.avoid:
        axes.plot(outcome.times, outcome.distances[s.name], color=colours[s.name], linewidth=1.8, label=s.name)
    axes.axhline(0.0, color=_INK, linewidth=1.0)
    axes.set_ylim(-7.0 - 1.6 * len(met), 40.0)
    for row, w in enumerate(met):
        height, colour = -2.0 - 1.6 * row, colours[w.structure]
        if w.raised_s < np.inf:
            axes.plot(w.raised_s, height, marker="D", color=colour, markeredgecolor=_INK, markersize=7)
            end = w.stated[1] if isfinite(w.stated[1]) else outcome.times[-1]
            if isfinite(w.stated[0]):
                axes.plot([w.stated[0], end], [height, height], color=colour, linewidth=5, alpha=0.6)
        if w.truth_s < np.inf:
            axes.plot(w.truth_s, height, marker="X", color="#d50000", markeredgecolor=_INK, markersize=9)
    marks: dict[str, Any] = {"linestyle": "none", "markeredgecolor": _INK}
    axes.plot([], [], marker="D", color="#cccccc", label="APPROACHING raised", **marks)
    axes.plot([], [], color="#999999", linewidth=5, alpha=0.6, label="contact expected within")
    axes.plot([], [], marker="X", color="#d50000", label="true first contact", **marks)
    axes.set_xlabel("time, s")
    axes.set_ylabel("reported distance, mm")
    about = f"; background: state to {worst.structure}" if worst is not None else ""
    axes.set_title(f"Warnings while driven wrong{about}" if "wrong" in outcome.name else f"Warnings{about}")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4)
    axes.grid(alpha=0.25)


def _shade(axes: Axes, times: Array, states: Sequence[State]) -> None:
    """Colour the background by state; a word stands in it where it fits, the legend has all that occur."""
    length = float(times[-1] - times[0])
    start = 0
    for k in range(1, len(states) + 1):
        if k == len(states) or states[k] is not states[start]:
            word, end = states[start].value, times[k] if k < len(states) else times[-1]
            axes.axvspan(times[start], end, color=_STATE_COLOURS[states[start]], zorder=0)
            if end - times[start] > (_LETTER * len(word) + 0.01) * length:
                place = axes.get_xaxis_transform()
                axes.text(0.5 * (times[start] + end), 0.015, word, transform=place, ha="center", fontsize=8)
            start = k
    for state in dict.fromkeys(states):
        axes.plot([], [], color=_STATE_COLOURS[state], linewidth=8, label=f"state {state.value}")
