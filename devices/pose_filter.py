"""Poses between and beyond frames: interpolation, a constant-velocity Kalman filter, and a guard against jumps.

Times are those of `TrackerFrame.time_s`: when poses were valid. To show where a tool is *now*, ask for the present;
what is returned states how far it was extrapolated and how uncertain it has become.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.errors import DeviceInputError
from devices.frame import ToolStatus, TrackerFrame
from devices.rotation import interpolate, is_rigid, rotation_from_vector, vector_from_rotation

__all__ = ["JumpGuard", "PoseBuffer", "PoseFilter", "Prediction"]

Array = NDArray[np.float64]


class JumpGuard:
    """Tell poses that no hand could have reached since the last good one.

    A tool that was out of sight may be anywhere after a while: what is allowed grows with the time since the last pose
    that was believed, so the guard comes back by itself.

    Parameters
    ----------
    fastest_mm_s, fastest_rad_s : float
        Fastest motion that is believed. A surgeon's hand stays below 1 m/s.
    noise_mm, noise_rad : float
        Allowed on top, however short the time.
    """

    def __init__(
        self,
        fastest_mm_s: float = 2000.0,
        fastest_rad_s: float = 20.0,
        noise_mm: float = 3.0,
        noise_rad: float = 0.05,
    ) -> None:
        if not (fastest_mm_s > 0.0 and fastest_rad_s > 0.0 and noise_mm >= 0.0 and noise_rad >= 0.0):
            raise DeviceInputError("JumpGuard: speeds must be > 0 and noise ≥ 0")
        self._fastest = (fastest_mm_s, fastest_rad_s)
        self._noise = (noise_mm, noise_rad)
        self._believed: tuple[float, Array] | None = None

    def jumps(self, time_s: float, T_tracker_tool: ArrayLike) -> bool:
        """Take the next pose; tell whether it is a jump (or no pose at all), in which case it is not believed.

        Parameters
        ----------
        time_s : float
            Rising, s.
        T_tracker_tool : (4, 4) array_like
        """
        T = np.asarray(T_tracker_tool, dtype=np.float64)
        if not is_rigid(T):
            return True
        if self._believed is not None:
            before_s, before = self._believed
            passed_s = max(0.0, time_s - before_s)
            distance = float(np.linalg.norm(T[:3, 3] - before[:3, 3]))
            angle = float(np.linalg.norm(vector_from_rotation(before[:3, :3].T @ T[:3, :3])))
            for moved, fastest, noise in zip((distance, angle), self._fastest, self._noise, strict=True):
                if moved > fastest * passed_s + noise:
                    return True
        self._believed = (time_s, T.copy())
        return False


class PoseBuffer:
    """The last poses of one tool, to be asked for any time between them.

    Parameters
    ----------
    tool : str
    keep_s : float
        How far back it remembers.
    longest_gap_s : float
        Between poses farther apart nothing is known.
    """

    def __init__(self, tool: str, keep_s: float = 5.0, longest_gap_s: float = 0.2) -> None:
        self.tool, self.keep_s, self.longest_gap_s = tool, keep_s, longest_gap_s
        self._times: deque[float] = deque()
        self._poses: deque[Array] = deque()

    def add(self, frame: TrackerFrame) -> None:
        """Take the next frame; one without a trusted pose of the tool, or with an old time, changes nothing."""
        pose = frame.tools.get(self.tool)
        if pose is None or pose.status is not ToolStatus.OK or pose.T_tracker_tool is None:
            return
        if not is_rigid(pose.T_tracker_tool) or (self._times and frame.time_s <= self._times[-1]):
            return
        self._times.append(frame.time_s)
        self._poses.append(pose.T_tracker_tool)
        while self._times[-1] - self._times[0] > self.keep_s:
            self._times.popleft()
            self._poses.popleft()

    def at(self, time_s: float) -> Array | None:
        """Pose (4, 4), mm, at a time, straight and by slerp between its neighbours; None outside or within a gap."""
        times = list(self._times)
        k = bisect_right(times, time_s)
        if k > 0 and times[k - 1] == time_s:
            return self._poses[k - 1].copy()
        if k == 0 or k == len(times) or times[k] - times[k - 1] > self.longest_gap_s:
            return None
        return interpolate(self._poses[k - 1], self._poses[k], (time_s - times[k - 1]) / (times[k] - times[k - 1]))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where a tool is expected at a time.

    Parameters
    ----------
    T_tracker_tool : (4, 4) array
        mm.
    velocity_mm_s : (3,) array
        In the tracker's frame.
    turn_rad_s : (3,) array
        Angular velocity in the tool's frame.
    position_sigma_mm, rotation_sigma_rad, velocity_sigma_mm_s : float
        Standard deviation per axis.
    ahead_s : float
        How far the last measurement was extrapolated: the latency that the prediction bridges.
    """

    T_tracker_tool: Array
    velocity_mm_s: Array
    turn_rad_s: Array
    position_sigma_mm: float
    rotation_sigma_rad: float
    velocity_sigma_mm_s: float
    ahead_s: float


class _Axis:
    """Covariance of (value, rate) under white noise of the acceleration; equal for all three axes."""

    def __init__(self, noise: float, acceleration: float) -> None:
        self.r = noise**2
        self.q = acceleration**2
        self.P = np.diag([self.r, 0.0])

    def restart(self, fastest: float) -> None:
        self.P = np.diag([self.r, fastest**2])

    def ahead(self, dt: float) -> Array:
        F = np.array([[1.0, dt], [0.0, 1.0]])
        Q = self.q * np.array([[dt**4 / 4.0, dt**3 / 2.0], [dt**3 / 2.0, dt**2]])
        return np.asarray(F @ self.P @ F.T + Q)

    def gain(self, predicted: Array) -> tuple[float, float]:
        k = predicted[:, 0] / (predicted[0, 0] + self.r)
        self.P = predicted - np.outer(k, predicted[0])
        return float(k[0]), float(k[1])


class PoseFilter:
    """Kalman filter of one tool's pose at constant velocity, in position and rotation.

    Parameters
    ----------
    noise_mm, noise_rad : float
        Standard deviation of a measurement per axis.
    acceleration_mm_s2, acceleration_rad_s2 : float
        Typical acceleration of the hand: how quickly the velocity is believed to change.
    longest_s : float
        After so long without a measurement the filter starts anew, and predicts nothing beyond it.

    Examples
    --------
    >>> import numpy as np
    >>> tool, T = PoseFilter(), np.eye(4)
    >>> for k in range(60):
    ...     T[0, 3] = 30.0 * k / 60.0
    ...     tool.add(k / 60.0, T)
    >>> prediction = tool.predict(1.05)
    >>> bool(abs(prediction.T_tracker_tool[0, 3] - 31.5) < 0.05), round(prediction.ahead_s, 4)
    (True, 0.0667)
    """

    def __init__(
        self,
        noise_mm: float = 0.25,
        noise_rad: float = 0.003,
        acceleration_mm_s2: float = 500.0,
        acceleration_rad_s2: float = 5.0,
        longest_s: float = 0.5,
    ) -> None:
        if not (noise_mm > 0.0 and noise_rad > 0.0 and longest_s > 0.0):
            raise DeviceInputError("PoseFilter: noise and longest_s must be > 0")
        self._place = _Axis(noise_mm, acceleration_mm_s2)
        self._turn = _Axis(noise_rad, acceleration_rad_s2)
        self._longest_s = longest_s
        self._time_s = -math.inf
        self._T = np.eye(4)
        self._velocity = np.zeros(3)
        self._rate = np.zeros(3)

    def add(self, time_s: float, T_tracker_tool: ArrayLike) -> None:
        """Take a measurement; an old time is ignored.

        Raises
        ------
        DeviceInputError
            Where the pose is not rigid and finite: only trusted poses belong here.
        """
        T = np.array(T_tracker_tool, dtype=np.float64)
        if not is_rigid(T):
            raise DeviceInputError("PoseFilter: the pose is not rigid or not finite; leave out what is not OK")
        dt = time_s - self._time_s
        if dt <= 0.0:
            return
        self._time_s, expected = time_s, self._ahead(dt)
        if dt > self._longest_s:
            self._T, self._velocity, self._rate = T, np.zeros(3), np.zeros(3)
            self._place.restart(1000.0)
            self._turn.restart(10.0)
            return
        miss = T[:3, 3] - expected[:3, 3]
        k0, k1 = self._place.gain(self._place.ahead(dt))
        expected[:3, 3] += k0 * miss
        self._velocity = self._velocity + k1 * miss
        turn = vector_from_rotation(expected[:3, :3].T @ T[:3, :3])
        k0, k1 = self._turn.gain(self._turn.ahead(dt))
        expected[:3, :3] = expected[:3, :3] @ rotation_from_vector(k0 * turn)
        self._rate = self._rate + k1 * turn
        self._T = expected

    def predict(self, time_s: float) -> Prediction | None:
        """Where the tool is expected at a time; None before the first measurement or too long after the last."""
        dt = time_s - self._time_s
        if not 0.0 <= dt <= self._longest_s:
            return None
        place, turn = self._place.ahead(dt), self._turn.ahead(dt)
        return Prediction(
            self._ahead(dt),
            self._velocity.copy(),
            self._rate.copy(),
            math.sqrt(place[0, 0]),
            math.sqrt(turn[0, 0]),
            math.sqrt(place[1, 1]),
            dt,
        )

    def _ahead(self, dt: float) -> Array:
        if not math.isfinite(dt):
            return self._T
        T = self._T.copy()
        T[:3, 3] += dt * self._velocity
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(dt * self._rate)
        return T
