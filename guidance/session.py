"""A whole session: scene → plan → a right and a wrong insertion, simulated and watched → files and a picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from guidance.event_log import EventLog, session_header
from guidance.monitor import Monitor
from guidance.picture import draw_session
from guidance.planning import Plans, plan
from guidance.scene import Scene
from guidance.simulation import Insertion, Outcome, Rig, simulate, wrong_path
from guidance.states import Event
from guidance.trajectory import Trajectory

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Session:
    """What a session gave: the plans, the simulated insertions (planned, then wrong), and where the files are."""

    scene: Scene
    plans: Plans
    outcomes: tuple[Outcome, ...]
    folder: Path


def run_session(scene: Scene, folder: Path, seed: int, say: Say, tell: Callable[[str, Event], None]) -> Session:
    """Plan, simulate, write.

    Parameters
    ----------
    scene : Scene
    folder : Path
        Gets `NAME.hhsr` per structure, `plan.json`, `events.jsonl`, `session-RUN.jsonl` and `picture.png`.
    seed : int
        Of the tracker's noise.
    say : callable
        Called with a line of progress.
    tell : callable
        Called with (run, event) as events happen.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for s in scene.structures:
        if s.shape is not None:
            s.shape.save(folder / f"{s.name.replace(' ', '_')}.hhsr")
    started = time.perf_counter()
    plans = plan(scene)
    say(f"planned in {time.perf_counter() - started:.1f} s: {_planned(plans)}")
    rig = Rig.usual(scene.needle)
    plans.save(folder / "plan.json", **_waypoints(plans, rig))
    runs = _runs(scene, plans)
    (folder / "events.jsonl").write_text("", encoding="utf-8")
    outcomes = []
    for name, path, about in runs:
        say(f"{name} insertion: {about}")
        outcomes.append(_insertion(scene, Insertion(path, rig), seed, name, folder, tell))
    draw_session(folder / "picture.png", scene, plans, outcomes)
    return Session(scene, plans, tuple(outcomes), folder)


def _insertion(
    scene: Scene, insertion: Insertion, seed: int, name: str, folder: Path, tell: Callable[[str, Event], None]
) -> Outcome:
    rig = insertion.rig
    monitor = Monitor(scene, insertion.path, rig.tool, rig.T_patient_tracker, rig.T_tool_tip)
    inputs = folder / f"session-{name}.jsonl"
    with EventLog(folder / "events.jsonl", inputs, session_header(monitor), run=name) as log:
        return simulate(scene, insertion, seed, name, monitor, log, lambda event: tell(name, event))


def _runs(scene: Scene, plans: Plans) -> list[tuple[str, Trajectory, str]]:
    """The insertions to simulate: the best plan, and one driven wrong from its entry (or from the least bad one's)."""
    runs = []
    base = plans.best.trajectory if plans.best else None
    if base is not None:
        runs.append(("planned", base, f"{base.depth_mm:.0f} mm along the best path"))
    else:
        base = next((r.trajectory for r in plans.rejected if r.trajectory is not None), None)
    if base is not None:
        wrong = wrong_path(scene, base)
        if wrong is not None:
            runs.append(("wrong", wrong[0], f"from the same entry into {wrong[1]}, on purpose"))
    return runs


def _waypoints(plans: Plans, rig: Rig) -> dict[str, Any]:
    """The best plan as a simulated tracker follows it, so that `sim:plan.json` can be opened as a tracker."""
    frames = {"T_patient_tracker": rig.T_patient_tracker.tolist(), "T_tool_tip": rig.T_tool_tip.tolist()}
    if plans.best is None:
        return frames
    waypoints = Insertion(plans.best.trajectory, rig).waypoints()
    points = [{"time_s": t, "T_tracker_tool": T.tolist()} for t, T in waypoints]
    return {**frames, "waypoints": {rig.tool: points}}


def _planned(plans: Plans) -> str:
    best = plans.best
    if best is None:
        return plans.why_none
    name, surplus = best.tightest
    tight = f", tightest at {name} with {surplus:.1f} mm to spare" if name else ""
    return f"{len(plans)} safe paths of {plans.candidates}, best {best.trajectory.depth_mm:.0f} mm deep{tight}"
