from __future__ import annotations

import numpy as np
import pytest

from guidance.motion import MotionFilter

RATE = 30.0


def follow(filter_, times, tips, noise, rng):
    motion = None
    for t, p in zip(times, tips, strict=True):
        motion = filter_.update(t, p + noise * rng.normal(size=3), np.array([0.0, 0.0, 1.0]))
    return motion


def steady(n, velocity):
    times = np.arange(n) / RATE
    return times, times[:, None] * velocity


def test_a_steady_motion_without_noise_is_found_exactly():
    velocity = np.array([1.0, -2.0, 5.0])
    times, tips = steady(90, velocity)
    motion = follow(MotionFilter(0.3, 0.005, 0.05), times, tips, 0.0, np.random.default_rng(0))
    np.testing.assert_allclose(motion.tip.rate, velocity, atol=0.02)
    np.testing.assert_allclose(motion.tip.value, tips[-1], atol=0.01)


def wander(n, psd, rng):
    """A true motion whose velocity does a random walk of the stated density; and what it is 2 s later."""
    fine, dt = 4, 1.0 / RATE / 4
    velocity = np.array([0.0, 3.0, 4.0]) + np.cumsum(np.sqrt(psd * dt) * rng.normal(size=((n + 60) * fine, 3)), axis=0)
    tips = np.cumsum(velocity * dt, axis=0)[::fine]
    return np.arange(n) / RATE, tips[:n], tips[n - 1 + 60]


@pytest.mark.parametrize("noise", [0.1, 0.3, 0.8])
def test_the_stated_spread_is_the_spread(noise):
    """Predictions 2 s ahead, 200 runs of three axes; also where the first guess of the noise (0.3 mm) is wrong."""
    normalised = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        times, tips, later = wander(90, 0.05, rng)
        motion = follow(MotionFilter(0.3, 0.005, 0.05), times, tips, noise, rng)
        normalised.append((motion.tip.value + 2.0 * motion.tip.rate - later) / motion.tip.spread(2.0))
    assert 0.85 < np.sqrt(np.mean(np.square(normalised))) < 1.15
    assert np.mean(np.abs(normalised) < 3.0) > 0.99


def test_a_change_of_speed_is_noticed_within_half_a_second():
    rng = np.random.default_rng(3)
    times = np.arange(150) / RATE
    along = np.where(times < 3.0, 0.0, (times - 3.0) * 8.0)
    tips = along[:, None] * np.array([0.0, 0.0, 1.0])
    filter_ = MotionFilter(0.3, 0.005, 0.05)
    for t, p in zip(times, tips, strict=True):
        motion = filter_.update(t, p + 0.2 * rng.normal(size=3), np.array([0.0, 0.0, 1.0]))
        if t > 3.6:
            assert abs(motion.tip.rate[2] - 8.0) < 3.0 * np.sqrt(motion.tip.covariance[1, 1]) + 0.2


def test_a_gap_in_time_widens_the_spread():
    times, tips = steady(60, np.array([0.0, 0.0, 5.0]))
    steady_filter, gap_filter = MotionFilter(0.3, 0.005, 0.05), MotionFilter(0.3, 0.005, 0.05)
    follow(steady_filter, times, tips, 0.0, np.random.default_rng(0))
    a = follow(gap_filter, times[:-10], tips[:-10], 0.0, np.random.default_rng(0))
    assert a.tip.spread(0.5) > a.tip.spread(0.1)


def test_predicted_axes_have_the_needles_length():
    times, tips = steady(40, np.array([0.0, 0.0, 5.0]))
    motion = follow(MotionFilter(0.3, 0.005, 0.05), times, tips, 0.1, np.random.default_rng(1))
    hubs, ends = motion.axis(np.array([0.0, 1.0, 4.0]), 150.0)
    np.testing.assert_allclose(np.linalg.norm(ends - hubs, axis=1), 150.0, atol=1e-9)
