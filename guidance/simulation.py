"""Simulated insertions: a path becomes timed waypoints, a simulated tracker follows them, a monitor watches.

The truth is known here: when the noise-free needle first touches a shape is found from the waypoints, and compared
with what the monitor had said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from devices.simulated import SimulatedTracker
from guidance.errors import InputError
from guidance.event_log import EventLog
from guidance.monitor import Monitor
from guidance.needle import Array, Needle
from guidance.rigid import invert
from guidance.scene import Scene, Structure
from guidance.states import Event, Report, State
from guidance.trajectory import Trajectory

_TICK_S = 0.1


@dataclass(frozen=True, eq=False)
class Rig:
    """How the needle is tracked: registration, calibration, tool name, and the tracker's faults."""

    T_patient_tracker: Array
    T_tool_tip: Array
    tool: str = "needle"
    rate_hz: float = 30.0
    noise_mm: float = 0.2
    noise_deg: float = 0.05
    jitter_s: float = 0.003
    latency_s: float = 0.03
    dropout: float = 0.02

    @classmethod
    def usual(cls, needle: Needle) -> Rig:
        """A camera 1.2 m above the patient, markers 30 mm behind the hub."""
        T_patient_tracker = np.array(
            [[0.0, 1.0, 0.0, 120.0], [1.0, 0.0, 0.0, -80.0], [0.0, 0.0, -1.0, 1200.0], [0.0, 0.0, 0.0, 1.0]]
        )
        T_tool_tip = np.eye(4)
        T_tool_tip[2, 3] = needle.length_mm + 30.0
        return cls(T_patient_tracker, T_tool_tip)

    def tool_pose(self, T_patient_tip: Array) -> Array:
        """`T_tracker_tool` (4, 4) of a tip pose."""
        return np.asarray(invert(self.T_patient_tracker) @ T_patient_tip @ invert(self.T_tool_tip))

    def tip_pose(self, T_tracker_tool: Array) -> Array:
        """`T_patient_tip` (4, 4) of a tool pose."""
        return np.asarray(self.T_patient_tracker @ T_tracker_tool @ self.T_tool_tip)


@dataclass(frozen=True, eq=False)
class Insertion:
    """A needle driven along a path at a steady speed: it rests before the entry, goes in, rests at the end."""

    path: Trajectory
    rig: Rig
    speed_mm_s: float = 5.0
    start_mm: float = -20.0
    rest_s: float = 1.0

    def waypoints(self) -> list[tuple[float, Array]]:
        """Times (s) and `T_tracker_tool` (4, 4): what a simulated tracker takes."""
        if not (self.speed_mm_s > 0.0 and self.start_mm < self.path.depth_mm and self.rest_s > 0.0):
            raise InputError("an insertion needs a speed and a rest above 0, and a start before the path's end")
        way = (self.path.depth_mm - self.start_mm) / self.speed_mm_s
        start, end = (self.rig.tool_pose(self.path.tip_pose(d)) for d in (self.start_mm, self.path.depth_mm))
        times = np.cumsum([0.0, self.rest_s, way, self.rest_s]).tolist()
        return list(zip(times, (start, start, end, end), strict=True))

    def tracker(self, seed: int) -> SimulatedTracker:
        """The simulated tracker that follows it."""
        rig = self.rig
        return SimulatedTracker(
            {rig.tool: self.waypoints()},
            rate_hz=rig.rate_hz,
            noise_mm=rig.noise_mm,
            noise_deg=rig.noise_deg,
            jitter_s=rig.jitter_s,
            latency_s=rig.latency_s,
            dropout=rig.dropout,
            seed=seed,
        )


@dataclass(frozen=True)
class ContactWarning:
    """What was said of one structure before it was touched, against the truth; times in s since the start.

    raised_s: of the first APPROACHING. stated: the interval that report gave, as times since the start.
    contact_s: of the first CONTACT or INSIDE reported. truth_s: of the noise-free capsule's first contact.
    inf: never.
    """

    structure: str
    role: str
    raised_s: float = inf
    stated: tuple[float, float] = (inf, inf)
    contact_s: float = inf
    truth_s: float = inf

    @property
    def lead_s(self) -> float:
        """Warning time: from APPROACHING to the true contact (inf without contact, −inf without warning)."""
        return inf if self.truth_s == inf else self.truth_s - self.raised_s

    @property
    def holds(self) -> bool:
        """Whether the true contact lies in the stated interval."""
        return self.stated[0] <= self.truth_s <= self.stated[1] and self.truth_s < inf


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an insertion gave: every event, per structure the warning against the truth, and curves for a picture."""

    name: str
    path: Trajectory
    events: tuple[Event, ...]
    warnings: tuple[ContactWarning, ...]
    times: Array
    depths: Array
    distances: dict[str, Array]
    states: dict[str, list[State]] = field(default_factory=dict)

    def warning(self, structure: str) -> ContactWarning:
        """The line of one structure."""
        return next(w for w in self.warnings if w.structure == structure)

    @property
    def alarms(self) -> tuple[Event, ...]:
        """Events that concern a structure to avoid, being lost included."""
        return tuple(e for e in self.events if e.alarm)


def simulate(
    scene: Scene,
    insertion: Insertion,
    seed: int,
    name: str = "insertion",
    monitor: Monitor | None = None,
    log: EventLog | None = None,
    on_event: Callable[[Event], None] | None = None,
) -> Outcome:
    """Drive a simulated tracked needle along a path on a simulated clock, as fast as the machine can.

    Parameters
    ----------
    scene : Scene
    insertion : Insertion
    seed : int
        Of the tracker's noise.
    name : str
    monitor : Monitor, optional
        By default one with the insertion's own registration, calibration and path.
    log : EventLog, optional
    on_event : callable, optional
        Called with each event as it happens.
    """
    rig = insertion.rig
    if monitor is None:
        monitor = Monitor(scene, insertion.path, rig.tool, rig.T_patient_tracker, rig.T_tool_tip)
    tracker = insertion.tracker(seed)
    reports = []
    for report in reports_of(tracker, monitor, log):
        reports.append(report)
        if on_event is not None:
            for event in report.events:
                on_event(event)
    return _outcome(scene, insertion, tracker, name, reports)


def reports_of(tracker: SimulatedTracker, monitor: Monitor, log: EventLog | None = None) -> Iterator[Report]:
    """Feed all frames of a simulated tracker to a monitor, with a tick for every 0.1 s of silence."""
    now = None
    for frame in tracker.frames():
        while now is not None and frame.arrival_s - now > _TICK_S:
            now += _TICK_S
            report = monitor.tick(now)
            if log is not None:
                log.tick(now, report)
            yield report
        now = frame.arrival_s
        report = monitor.update(frame)
        if log is not None:
            log.frame(frame, report)
        yield report


def wrong_path(scene: Scene, path: Trajectory, overshoot_mm: float = 8.0) -> tuple[Trajectory, str] | None:
    """The path that goes wrong: from the same entry into the structure to avoid that the needle would pass nearest.

    Returns
    -------
    (Trajectory, str) or None
        The wrong path and the structure it is aimed at; None where nothing is to be avoided within the needle's reach.
    """
    best: tuple[float, Trajectory, str] | None = None
    for s in scene.avoid:
        if s.shape is None:
            continue
        aim = _aim_into(s, path)
        if aim is None or not 5.0 < np.linalg.norm(aim - path.entry) < scene.needle.length_mm - overshoot_mm:
            continue
        direction = (aim - path.entry) / np.linalg.norm(aim - path.entry)
        wrong = Trajectory(path.entry, aim + overshoot_mm * direction)
        turn = path.deviation(wrong.tip, direction)[1]
        if turn < 60.0 and (best is None or turn < best[0]):
            best = turn, wrong, s.name
    return None if best is None else (best[1], best[2])


def _aim_into(structure: Structure, path: Trajectory) -> Array | None:
    """A point (3,) inside a structure, near the path: the closest point on its surface, pushed in."""
    shape = structure.shape
    assert shape is not None
    along = path.entry + np.linspace(0.15, 1.0, 40)[:, None] * (path.tip - path.entry)
    distance = shape.signed_distance(along)
    nearest = along[int(np.argmin(distance))]
    surface, gap = shape.closest_point(nearest)
    if float(gap) < 1e-6:
        return np.asarray(surface)
    inward = (surface - nearest) / float(np.linalg.norm(surface - nearest))
    if float(distance.min()) < 0.0:
        inward = -inward
    depths = np.linspace(0.2, 6.0, 30)
    inside = shape.signed_distance(surface + depths[:, None] * inward)
    return np.asarray(surface + depths[int(np.argmin(inside))] * inward)


def true_contact(scene: Scene, structure: Structure, tracker: SimulatedTracker, rig: Rig) -> float:
    """When (s, the tracker's time) the noise-free capsule first touches a shape; inf if it never does."""
    if structure.shape is None:
        return inf
    needle, shape = scene.needle, structure.shape
    speed = _fastest(tracker, rig, needle)
    time, end = tracker.first_s, tracker.last_s
    while time <= end:
        hub, tip = needle.axis(rig.tip_pose(tracker.truth(rig.tool, time)))
        gap = float(shape.clearance(hub, tip, needle.radius_mm))
        if gap <= 0.01:
            return time
        if speed == 0.0:
            return inf
        time += max(gap / speed, 1e-4)
    return inf


def _fastest(tracker: SimulatedTracker, rig: Rig, needle: Needle) -> float:
    """A bound of the speed (mm/s) of any point of the needle, from the truth at small steps, 5 % to the safe side."""
    times = np.linspace(tracker.first_s, tracker.last_s, 400)
    axes = np.array([needle.axis(rig.tip_pose(tracker.truth(rig.tool, t))) for t in times])
    moved = np.linalg.norm(np.diff(axes, axis=0), axis=-1).max(axis=1) / np.diff(times)
    return 1.05 * float(moved.max())


def _outcome(
    scene: Scene, insertion: Insertion, tracker: SimulatedTracker, name: str, reports: list[Report]
) -> Outcome:
    events = tuple(e for r in reports for e in r.events)
    warnings = []
    for s in scene.structures:
        line = ContactWarning(s.name, s.role, truth_s=true_contact(scene, s, tracker, insertion.rig))
        for e in events:
            if e.structure != s.name:
                continue
            if e.after is State.APPROACHING and line.raised_s == inf and line.contact_s == inf:
                stated = (e.time_s + e.forecast.earliest_s, e.time_s + e.forecast.latest_s)
                line = replace(line, raised_s=e.time_s, stated=stated)
            if e.after in (State.CONTACT, State.INSIDE):
                line = replace(line, contact_s=min(line.contact_s, e.time_s))
        warnings.append(line)
    return Outcome(
        name=name,
        path=insertion.path,
        events=events,
        warnings=tuple(warnings),
        times=np.array([r.time_s for r in reports]),
        depths=np.array([r.depth_mm for r in reports]),
        distances={s.name: np.array([r.structure(s.name).distance_mm for r in reports]) for s in scene.structures},
        states={s.name: [r.structure(s.name).state for r in reports] for s in scene.structures},
    )
