"""How the needle moves: tip and direction filtered at constant velocity, with an uncertainty that is meant.

Two independent filters of one kind, since noise and motion are the same along every axis: one holds the tip (mm), one
the unit direction (treated as a vector; it turns by fractions of a degree). Each has a 2 × 2 covariance of value and
rate, shared by its three axes. The measurement noise is estimated from the poses themselves.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from guidance.needle import Array

_NOISE_WINDOW = 40  # frames whose roughness estimates the noise
_PRIOR_WEIGHT = 4.0  # frames that the first guess counts for
_BIAS_GAIN = 0.25  # of the running mean of innovations
_BIAS_LIMIT = 25.0  # squared, in units of its variance: a steady miss of five sigma is a change of motion
_START_RATE = 50.0  # in units per second: one sigma of an unknown velocity, mm/s for the tip


@dataclass(frozen=True, eq=False)
class Track:
    """A filtered vector: value, rate (3,), and P (2, 2), the covariance of both per axis; q its process noise."""

    value: Array
    rate: Array
    covariance: Array
    process: float

    def spread(self, ahead_s: float) -> float:
        """Standard deviation per axis of the value predicted `ahead_s` ahead."""
        P, t = self.covariance, ahead_s
        variance = P[0, 0] + 2.0 * t * P[0, 1] + t * t * P[1, 1] + self.process * t**3 / 3.0
        return float(np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class Motion:
    """Tip and direction with their velocities, valid at `time_s`."""

    time_s: float
    tip: Track
    direction: Track

    @property
    def speed_mm_s(self) -> float:
        """Of the tip."""
        return float(np.linalg.norm(self.tip.rate))

    @property
    def rate_spread_mm_s(self) -> float:
        """Standard deviation per axis of the tip's velocity."""
        return float(np.sqrt(self.tip.covariance[1, 1]))

    def axis(self, ahead_s: Array, length_mm: float) -> tuple[Array, Array]:
        """Predicted hubs and tips (n, 3), mm, for times (n,) ahead."""
        t = np.asarray(ahead_s, dtype=np.float64)[:, None]
        tips = self.tip.value + t * self.tip.rate
        directions = self.direction.value + t * self.direction.rate
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return tips - length_mm * directions, tips


class MotionFilter:
    """Feeds on accepted poses in time order; `reset` when the needle is somewhere else than it could have come to."""

    def __init__(self, noise_mm: float, noise_rad: float, acceleration_psd: float) -> None:
        # an angular wander in proportion: a hand that changes the tip's speed turns the needle about its entry
        self._tip = _VectorFilter(noise_mm, acceleration_psd, _START_RATE)
        self._direction = _VectorFilter(noise_rad, acceleration_psd * 1e-4, 0.5)
        self._time_s: float | None = None

    def reset(self) -> None:
        """Forget the motion, keep what is known of the noise."""
        self._tip.restart()
        self._direction.restart()
        self._time_s = None

    def update(self, time_s: float, tip: Array, direction: Array) -> Motion:
        """Take a pose in: tip (3,) mm, unit direction (3,), valid at `time_s`, later than the last."""
        dt = None if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        return Motion(time_s, self._tip.update(dt, tip), self._direction.update(dt, direction))


class _VectorFilter:
    def __init__(self, noise: float, process: float, start_rate: float) -> None:
        self._first_noise = noise
        self._process = process
        self._start_rate = start_rate
        self._roughness: deque[float] = deque(maxlen=_NOISE_WINDOW)
        self.restart()

    def restart(self) -> None:
        self._x = np.zeros(3)
        self._v = np.zeros(3)
        self._P = np.zeros((2, 2))
        self._bias = np.zeros(3)
        self._recent: deque[tuple[float, Array]] = deque(maxlen=3)
        self._started = False

    def update(self, dt: float | None, z: Array) -> Track:
        self._note_roughness(dt, z)
        R = self._noise_variance()
        if dt is None or not self._started:
            self._x, self._v = z.copy(), np.zeros(3)
            self._P = np.array([[R, 0.0], [0.0, self._start_rate**2]])
            self._started = True
        else:
            self._step(dt, z, R)
        return Track(self._x.copy(), self._v.copy(), self._P.copy(), self._process)

    def _step(self, dt: float, z: Array, R: float) -> None:
        q = self._process
        F = np.array([[1.0, dt], [0.0, 1.0]])
        Q = q * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        x, P = self._x + dt * self._v, F @ self._P @ F.T + Q
        innovation = z - x
        S = P[0, 0] + R
        self._bias = (1.0 - _BIAS_GAIN) * self._bias + _BIAS_GAIN * innovation
        if self._bias @ self._bias > _BIAS_LIMIT * S * _BIAS_GAIN / (2.0 - _BIAS_GAIN):
            # the needle does not do what it did: its velocity is off by about this miss over the frames it took to show
            miss = float(self._bias @ self._bias)
            P = P + np.diag([miss, miss * (_BIAS_GAIN / dt) ** 2])
            S = P[0, 0] + R
            self._bias = np.zeros(3)
        gain = P[:, 0] / S
        self._x = x + gain[0] * innovation
        self._v = self._v + gain[1] * innovation
        self._P = P - np.outer(gain, P[0])

    def _note_roughness(self, dt: float | None, z: Array) -> None:
        """Noise shows where a pose lies off the straight line between its two neighbours, whatever the velocity."""
        time = 0.0 if dt is None or not self._recent else self._recent[-1][0] + dt
        self._recent.append((time, z.copy()))
        if len(self._recent) < 3:
            return
        (t0, z0), (t1, z1), (t2, z2) = self._recent
        share = (t1 - t0) / (t2 - t0)
        off = z1 - (1.0 - share) * z0 - share * z2
        variance = float(off @ off) / (3.0 * (1.0 + share**2 + (1.0 - share) ** 2))
        self._roughness.append(min(variance, 16.0 * self._noise_variance()))

    def _noise_variance(self) -> float:
        """Mean of what the recent frames showed and the first guess, which fades as frames come in."""
        total = _PRIOR_WEIGHT * self._first_noise**2 + sum(self._roughness)
        count = _PRIOR_WEIGHT + len(self._roughness)
        return max(total / count, (0.05 * self._first_noise) ** 2)
