"""A tracker made of physics, without a wire: timed waypoints, noise, jitter, latency, occlusion, loss; all seeded."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.clock import Clock
from devices.errors import DeviceInputError
from devices.frame import ToolPose, ToolStatus, TrackerFrame
from devices.rotation import interpolate, is_rigid, rotation_from_vector
from devices.tracker import Tracker

__all__ = ["SimulatedTracker", "Waypoints", "checked_waypoints"]

Waypoints = Mapping[str, Sequence[tuple[float, ArrayLike]]]


def checked_waypoints(waypoints: Waypoints) -> dict[str, tuple[list[float], list[NDArray[np.float64]]]]:
    """Return times (s, rising) and rigid poses per tool, or raise `DeviceInputError` that names the waypoint."""
    if not waypoints:
        raise DeviceInputError("waypoints: expected at least one tool, got none")
    checked = {}
    for tool, points in waypoints.items():
        if len(points) == 0:
            raise DeviceInputError(f"waypoints of {tool!r}: expected at least one (time_s, T_tracker_tool)")
        times = [float(time_s) for time_s, _ in points]
        poses = [np.array(T, dtype=np.float64) for _, T in points]
        for k, (time_s, T) in enumerate(zip(times, poses, strict=True)):
            if not math.isfinite(time_s) or (k > 0 and time_s <= times[k - 1]):
                raise DeviceInputError(f"waypoint {k} of {tool!r}: times must be finite and rise, got {time_s!r} s")
            if not is_rigid(T):
                raise DeviceInputError(f"waypoint {k} of {tool!r}: T_tracker_tool is no rigid 4 × 4 transform:\n{T}")
        checked[tool] = (times, poses)
    return checked


class SimulatedTracker(Tracker):
    """A tracker that follows timed waypoints, straight and by slerp in between, and measures them with errors.

    Every frame's randomness depends on `seed` and the frame's index alone, so `read` and `frames` give the same
    measurements, on any clock. The same arguments give the same frames, bit for bit (read times apart).

    Parameters
    ----------
    waypoints : mapping of str to sequence of (time_s, (4, 4) array)
        Per tool, rising times in s and `T_tracker_tool` in mm; before the first and after the last a tool rests.
    rate_hz : float
        Frames per second, > 0.
    noise_mm, noise_deg : float
        Standard deviation per axis of the measured position and rotation vector.
    jitter_s : float
        Standard deviation of the delay on top of `latency_s`; frames never overtake one another.
    latency_s : float
        From the moment of measurement to arrival.
    dropout : float
        Share of frames that are lost; their numbers are missing in the sequence.
    occlusions : sequence of (tool, start_s, end_s)
        Intervals, in the waypoints' time, in which a tool is MISSING.
    outlier_share, outlier_mm : float
        Share of poses that are displaced by `outlier_mm` in a random direction and say nothing about it.
    seed : int
    clock : Clock or None
        `read` waits on it; a `ManualClock` is moved forward instead, so simulations run as fast as they can.
    timestamps : bool
        Whether the device tells the time of measurement; if not, `time_s` is arrival less `latency_s`, jitter included.

    Examples
    --------
    >>> import numpy as np
    >>> end = np.eye(4); end[2, 3] = 60.0
    >>> tracker = SimulatedTracker({"needle": [(0.0, np.eye(4)), (2.0, end)]}, rate_hz=10)
    >>> frames = list(tracker.frames())
    >>> len(frames), float(frames[5].tools["needle"].T_tracker_tool[2, 3])
    (21, 15.0)
    """

    def __init__(
        self,
        waypoints: Waypoints,
        rate_hz: float = 60.0,
        noise_mm: float = 0.0,
        noise_deg: float = 0.0,
        jitter_s: float = 0.0,
        latency_s: float = 0.0,
        dropout: float = 0.0,
        occlusions: Sequence[tuple[str, float, float]] = (),
        outlier_share: float = 0.0,
        outlier_mm: float = 50.0,
        seed: int = 0,
        clock: Clock | None = None,
        timestamps: bool = True,
    ) -> None:
        super().__init__(clock)
        self._waypoints = checked_waypoints(waypoints)
        for name, value in (("noise_mm", noise_mm), ("noise_deg", noise_deg), ("jitter_s", jitter_s)):
            if not 0.0 <= value < math.inf:
                raise DeviceInputError(f"{name}: expected a finite number ≥ 0, got {value!r}")
        if not 0.0 <= latency_s < math.inf or not 0.0 < rate_hz < math.inf:
            raise DeviceInputError(f"expected rate_hz > 0 and latency_s ≥ 0, got {rate_hz!r} and {latency_s!r}")
        if not (0.0 <= dropout <= 1.0 and 0.0 <= outlier_share <= 1.0):
            raise DeviceInputError(
                f"dropout and outlier_share are shares in [0, 1], got {dropout!r}, {outlier_share!r}"
            )
        for tool, start_s, end_s in occlusions:
            if tool not in self._waypoints or not start_s <= end_s:
                raise DeviceInputError(f"occlusion {(tool, start_s, end_s)}: unknown tool, or it ends before it begins")
        self.rate_hz = float(rate_hz)
        self.latency_s = float(latency_s)
        self.noise_mm, self.noise_rad = float(noise_mm), math.radians(noise_deg)
        self.jitter_s, self.dropout = float(jitter_s), float(dropout)
        self.occlusions = tuple(occlusions)
        self.outlier_share, self.outlier_mm = float(outlier_share), float(outlier_mm)
        self.seed, self.timestamps = int(seed), bool(timestamps)
        self.first_s = min(times[0] for times, _ in self._waypoints.values())
        self.last_s = max(times[-1] for times, _ in self._waypoints.values())
        #: clock reading at the waypoints' time 0; set by `start`, 0 before, so that frames then carry waypoint time
        self.origin_s = 0.0
        self._queue: Iterator[TrackerFrame] = iter(())
        self._next: TrackerFrame | None = None

    @property
    def tool_names(self) -> tuple[str, ...]:
        """Names of the tools, in the order given."""
        return tuple(self._waypoints)

    @property
    def is_finished(self) -> bool:
        """Whether the last waypoint has been delivered."""
        return self._running and self._next is None

    def truth(self, tool: str, time_s: float) -> NDArray[np.float64]:
        """Noise-free pose of a tool at a time.

        Parameters
        ----------
        tool : str
        time_s : float
            On the clock of the frames (`TrackerFrame.time_s`); before `start` that is the waypoints' own time.

        Returns
        -------
        (4, 4) ndarray
            T_tracker_tool, mm.
        """
        times, poses = self._waypoints[tool]
        t = time_s - self.origin_s
        k = bisect_right(times, t) - 1
        if k < 0:
            return poses[0].copy()
        if k >= len(times) - 1:
            return poses[-1].copy()
        return interpolate(poses[k], poses[k + 1], (t - times[k]) / (times[k + 1] - times[k]))

    def frames(self) -> Iterator[TrackerFrame]:
        """Iterate over all frames that are not lost, on simulated time, without waiting for any clock."""
        count = math.floor((self.last_s - self.first_s) * self.rate_hz + 1e-9) + 1
        arrival_s = -math.inf
        for k in range(count):
            frame = self._measure(k, arrival_s)
            if frame is not None:
                arrival_s = frame.arrival_s
                yield frame

    def _measure(self, k: int, previous_arrival_s: float) -> TrackerFrame | None:
        draws = np.random.default_rng([self.seed, k])
        plan_s = self.first_s + k / self.rate_hz
        lost = draws.random() < self.dropout
        delay_s = max(0.0, self.latency_s + self.jitter_s * draws.standard_normal())
        valid_s = plan_s + self.origin_s
        arrival_s = max(previous_arrival_s, valid_s + delay_s)
        tools = {}
        for tool in self._waypoints:
            # drawn for every tool in every frame, so that an occlusion changes no other number
            shift, turn, stray = draws.standard_normal((3, 3))
            displaced = draws.random() < self.outlier_share
            if any(name == tool and start <= plan_s <= end for name, start, end in self.occlusions):
                tools[tool] = ToolPose(ToolStatus.MISSING, None)
                continue
            T = self.truth(tool, valid_s)
            T[:3, 3] += self.noise_mm * shift
            if self.noise_rad > 0.0:
                T[:3, :3] = T[:3, :3] @ rotation_from_vector(self.noise_rad * turn)
            if displaced:
                T[:3, 3] += self.outlier_mm * stray / np.linalg.norm(stray)
            error_mm = self.noise_mm * float(np.linalg.norm(shift)) / math.sqrt(3.0)
            tools[tool] = ToolPose(ToolStatus.OK, T, error_mm)
        if lost:
            return None
        time_s = valid_s if self.timestamps else arrival_s - self.latency_s
        return TrackerFrame(k, time_s, arrival_s, tools)

    def _start(self) -> None:
        self.origin_s = self.clock.now_s() - self.first_s
        self._queue = self.frames()
        self._next = next(self._queue, None)

    def _read(self, timeout_s: float) -> TrackerFrame | None:
        limit_s = self.clock.now_s() + timeout_s
        if self._next is None or self._next.arrival_s > limit_s:
            if self._next is not None:
                self.clock.wait_until(limit_s, self._stopping)
            return None
        self.clock.wait_until(self._next.arrival_s, self._stopping)
        if self._stopping.is_set():
            return None
        frame, self._next = self._next, next(self._queue, None)
        return frame
