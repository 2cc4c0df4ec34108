"""The monitor: tracker frames in, a report on every structure out. Pure: time and poses are arguments, nothing is read.

The same frames and ticks give the same reports, bit for bit, so a log of the inputs is a log of everything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, nan

import numpy as np
from numpy.typing import ArrayLike

from devices.frame import TrackerFrame
from guidance.budget import fit_error_range_mm, fit_errors_mm
from guidance.forecast import forecast_contact
from guidance.limits import Limits
from guidance.motion import Motion, MotionFilter
from guidance.needle import Array
from guidance.planning.plans import Plan
from guidance.pose_gate import PoseGate
from guidance.rigid import check_rigid
from guidance.scene import AVOID, Scene, Structure
from guidance.states import SEVERITY, Event, Forecast, Report, State, StructureReport
from guidance.trajectory import Trajectory

_AXIS_AHEAD_MM = 200.0
_TOOL_IS_TIP = np.eye(4)
_TOOL_IS_TIP.flags.writeable = False
_FAR_SHARE, _DEEP_SHARE = 0.05, 0.2
_REFRESH_S = 0.1
_SURE_SIGMAS = 5.0  # noise alone looks like a speed of three sigmas in 3 % of all frames, of five in none


@dataclass
class _Watch:
    """One structure and what is remembered of it: its state, and since when a better one has held."""

    structure: Structure
    hash: str
    state: State = State.UNKNOWN
    better_since: float = inf
    last: StructureReport | None = None
    measured: tuple[Array, Array, float] | None = None  # hub, tip, clearance when the shape was last asked
    forecast: tuple[float, Forecast] | None = None  # and the time of the motion it was made for

    def forget(self) -> None:
        """Drop what was measured of a needle that is somewhere else now."""
        self.measured = self.forecast = None


class Monitor:
    """Says of every structure whether the needle is CLEAR of it, APPROACHING, in CONTACT, INSIDE, or UNKNOWN.

    Parameters
    ----------
    scene : Scene
    plan : Plan or Trajectory, optional
        To report the deviation from.
    tool : str
        Name of the needle's tool in the frames.
    T_patient_tracker : (4, 4) array, optional
        Registration, mm. None is unregistered: everything is UNKNOWN.
    T_tool_tip : (4, 4) array, optional
        Calibration: the tip's frame in the tool's, +z along the needle towards the tip. By default the tool is
        the tip itself. None is uncalibrated: everything is UNKNOWN.
    limits : Limits, optional

    Raises
    ------
    InputError
        If a given transform is not rigid.
    """

    def __init__(
        self,
        scene: Scene,
        plan: Plan | Trajectory | None = None,
        tool: str = "needle",
        T_patient_tracker: ArrayLike | None = None,
        T_tool_tip: ArrayLike | None = _TOOL_IS_TIP,
        limits: Limits | None = None,
    ) -> None:
        self.scene = scene
        self.limits = limits or Limits()
        self.path = plan.trajectory if isinstance(plan, Plan) else plan
        registration = None if T_patient_tracker is None else check_rigid(T_patient_tracker, "T_patient_tracker")
        calibration = None if T_tool_tip is None else check_rigid(T_tool_tip, "T_tool_tip")
        self.tool, self.T_patient_tracker, self.T_tool_tip = tool, registration, calibration
        self._gate = PoseGate(tool, registration, calibration, self.limits)
        self._filter = MotionFilter(self.limits.noise_mm, self.limits.noise_rad, self.limits.acceleration_psd)
        self._watches = [_Watch(s, s.hash) for s in scene.structures]
        self._scene_hash = scene.hash
        self._pose: tuple[float, Array] | None = None  # time and T_patient_tip of the last trusted pose
        self._motion: Motion | None = None
        self._distrust = "no pose yet"
        self._number = -1
        self._now_s = -inf

    def update(self, frame: TrackerFrame) -> Report:
        """Take a frame in and report as of its arrival.

        A frame whose pose cannot be trusted makes everything UNKNOWN at once. A repeated or late frame is old data: it
        changes nothing but the time, and what was known ages until it is stale.
        """
        now = frame.arrival_s if np.isfinite(frame.arrival_s) else self._now_s
        gated = self._gate.check(frame)
        if gated.old:
            return self.tick(now)
        self._now_s, self._number = max(now, self._now_s), frame.number
        if gated.T_patient_tip is None:
            self._distrust = gated.reason
            return self._report([self._unknown(w, gated.reason) for w in self._watches])
        if gated.restart or (self._pose is not None and frame.time_s - self._pose[0] > self.limits.stale_s):
            self._filter.reset()
            for w in self._watches:
                w.forget()
        T = gated.T_patient_tip
        self._distrust, self._pose = "", (frame.time_s, T)
        self._motion = self._filter.update(frame.time_s, T[:3, 3].copy(), T[:3, 2].copy())
        return self._report([self._look(w, T) for w in self._watches])

    def tick(self, now: float) -> Report:
        """Report as of `now` (s) without a new frame: what is known ages, and is UNKNOWN once it is stale."""
        elapsed = max(0.0, now - self._now_s) if np.isfinite(self._now_s) else 0.0
        self._now_s = max(now, self._now_s)
        age = self._age_s
        if not self._distrust and age > self.limits.stale_s:
            self._distrust = f"the last pose is {age:.2f} s old"
        if self._distrust:
            return self._report([self._unknown(w, self._distrust) for w in self._watches])
        lines = []
        for w in self._watches:
            assert w.last is not None  # there was a trusted pose
            lines.append(replace(w.last, forecast=w.last.forecast.later(elapsed)))
        return self._report(lines)

    @property
    def _age_s(self) -> float:
        return inf if self._pose is None else self._now_s - self._pose[0]

    def _unknown(self, watch: _Watch, reason: str) -> StructureReport:
        s = watch.structure
        return StructureReport(s.name, s.role, State.UNKNOWN, reason, watch.hash)

    def _look(self, watch: _Watch, T: Array) -> StructureReport:
        """One structure as the newest pose stands to it."""
        s, shape, needle = watch.structure, watch.structure.shape, self.scene.needle
        if shape is None:
            return self._unknown(watch, "no model of this structure")
        assert self._motion is not None
        hub, tip = needle.axis(T)
        distance = self._distance(watch, hub, tip)
        inside = distance <= 0.0 and bool(shape.contains(tip))
        ahead = float(shape.first_crossing(tip, tip + _AXIS_AHEAD_MM * T[:3, 2])) * _AXIS_AHEAD_MM
        forecast = Forecast(0.0, 0.0, 0.0, 0.0) if distance <= 0.0 else self._forecast(watch, distance)
        needed, fit_error = self._needed(s, hub, tip, distance)
        state, reason = self._judge(distance, inside, needed, forecast, relaxed=False)
        line = StructureReport(
            s.name, s.role, state, reason, watch.hash, distance, _or_inf(ahead), needed, fit_error, forecast
        )
        return self._settle(watch, line, inside)

    def _distance(self, watch: _Watch, hub: Array, tip: Array) -> float:
        """A lower bound of the capsule clearance, mm, at most a few per cent below it.

        A clearance changes no faster than the needle's ends move: the shape is asked again only once they have moved by
        a twentieth of the gap (a fifth of the depth inside). The sign is always that of the clearance.
        """
        if watch.measured is not None:
            hub0, tip0, distance = watch.measured
            moved = max(float(np.linalg.norm(hub - hub0)), float(np.linalg.norm(tip - tip0)))
            if moved <= (_FAR_SHARE if distance > 0.0 else _DEEP_SHARE) * abs(distance):
                return distance - moved
        assert watch.structure.shape is not None
        distance = float(watch.structure.shape.clearance(hub, tip, self.scene.needle.radius_mm))
        watch.measured = hub, tip, distance
        return distance

    def _forecast(self, watch: _Watch, distance: float) -> Forecast:
        """First contact ahead, made anew every 0.1 s (where no alarm hangs on it every 0.3 s), aged in between."""
        m = self._motion
        assert m is not None
        assert watch.structure.shape is not None
        if not self._is_moving():
            return Forecast()
        if watch.forecast is not None:
            made, forecast = watch.forecast
            if m.time_s - made < (_REFRESH_S if watch.structure.role == AVOID else 3.0 * _REFRESH_S):
                return forecast.later(m.time_s - made)
        forecast = forecast_contact(watch.structure.shape, self.scene.needle, m, self.limits, self._age_s, distance)
        watch.forecast = m.time_s, forecast
        return forecast

    def _needed(self, s: Structure, hub: Array, tip: Array, distance: float) -> tuple[float, float]:
        """Margin plus budget, mm, and the fit error in it: the nearest leaf's where that matters, else the largest.

        What is not to be avoided needs no room for the error of its fit: nothing hangs on being warned of it early.
        """
        assert s.shape is not None
        fixed = s.margin_mm + self.scene.errors.without_fit_mm
        if s.role != AVOID:
            return fixed, 0.0
        statistic = self.scene.errors.fit
        fit_error = fit_error_range_mm(s.shape, statistic)[1]
        if 0.0 < distance <= fixed + fit_error + self.limits.hysteresis_mm:
            nearest = s.shape.closest_approach(hub, tip).on_surface
            fit_error = float(fit_errors_mm(s.shape, nearest[None], statistic)[0])
        return fixed + fit_error, fit_error

    def _judge(
        self, distance: float, inside: bool, needed: float, forecast: Forecast, relaxed: bool
    ) -> tuple[State, str]:
        """The state by the thresholds alone; `relaxed` widens them, for leaving a graver state."""
        limits = self.limits
        touch = limits.contact_hysteresis_mm if relaxed else 0.0
        near = needed + (limits.hysteresis_mm if relaxed else 0.0)
        soon = limits.approach_s * (1.0 + limits.hysteresis_share if relaxed else 1.0)
        if inside:
            return State.INSIDE, "the tip is inside"
        if distance <= touch:
            return State.CONTACT, f"the needle touches it ({distance:.2f} mm)"
        if forecast.seconds <= soon:
            span = f"{forecast.earliest_s:.1f} to {_text(forecast.latest_s)}"
            span += "" if forecast.certain else ", or a near miss"
            return State.APPROACHING, (
                f"contact in {forecast.seconds:.1f} s ({span}), {forecast.travel_mm:.1f} mm ahead at the present motion"
            )
        if distance <= near:
            return State.APPROACHING, f"{distance:.1f} mm away, nearer than margin and errors need ({needed:.1f} mm)"
        return State.CLEAR, f"{distance:.1f} mm away"

    def _is_moving(self) -> bool:
        """Whether the speed is known well enough to forecast by it."""
        m = self._motion
        assert m is not None
        return m.speed_mm_s > max(self.limits.min_speed_mm_s, _SURE_SIGMAS * m.rate_spread_mm_s)

    def _settle(self, watch: _Watch, line: StructureReport, inside: bool) -> StructureReport:
        """Graver at once; better only when clearly better, for `hold_s` on end."""
        before = watch.state
        if before is State.UNKNOWN or SEVERITY[line.state] >= SEVERITY[before]:
            watch.better_since = inf
            return line
        relaxed, reason = self._judge(line.distance_mm, inside, line.needed_mm, line.forecast, relaxed=True)
        if SEVERITY[relaxed] >= SEVERITY[before]:
            watch.better_since = inf
            return replace(line, state=before, reason=reason)
        watch.better_since = min(watch.better_since, self._now_s)
        if self._now_s - watch.better_since < self.limits.hold_s:
            return replace(line, state=before, reason=f"{reason}, not yet for {self.limits.hold_s:g} s")
        watch.better_since = inf
        return replace(line, state=relaxed, reason=reason)

    def _report(self, lines: list[StructureReport]) -> Report:
        events = []
        for watch, line in zip(self._watches, lines, strict=True):
            if line.state is not watch.state:
                events.append(self._event(watch, line))
            watch.state, watch.last = line.state, line
        tip = direction = None
        deviation, depth = (nan, nan), nan
        if self._pose is not None:
            tip, direction = self._pose[1][:3, 3].copy(), self._pose[1][:3, 2].copy()
            if self.path is not None:
                deviation = self.path.deviation(tip, direction)
                depth = float((tip - self.path.entry) @ self.path.direction)
        return Report(
            time_s=self._now_s,
            frame_number=self._number,
            pose_age_s=self._age_s,
            tip=tip,
            direction=direction,
            speed_mm_s=nan if self._motion is None else self._motion.speed_mm_s,
            depth_mm=depth,
            deviation_mm=deviation[0],
            deviation_deg=deviation[1],
            structures=tuple(lines),
            events=tuple(events),
            errors={**self.scene.errors.to_record(), "tip_noise_mm": self._noise_mm},
            scene_hash=self._scene_hash,
        )

    @property
    def _noise_mm(self) -> float | None:
        return None if self._motion is None else float(np.sqrt(self._motion.tip.covariance[0, 0]))

    def _event(self, watch: _Watch, line: StructureReport) -> Event:
        return Event(
            time_s=self._now_s,
            structure=line.name,
            before=watch.state,
            after=line.state,
            reason=line.reason,
            distance_mm=line.distance_mm,
            forecast=line.forecast if line.state is not State.UNKNOWN else Forecast(nan, nan, nan, nan),
            frame_number=self._number,
            role=line.role,
            alarm=line.role == AVOID and line.state is not State.CLEAR,
        )


def _or_inf(value: float) -> float:
    return inf if np.isnan(value) else value


def _text(seconds: float) -> str:
    return f"{seconds:.1f} s" if np.isfinite(seconds) else "never"
