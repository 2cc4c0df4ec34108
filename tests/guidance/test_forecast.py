from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from guidance.forecast import forecast_contact
from guidance.limits import Limits
from guidance.motion import Motion, Track
from guidance.needle import Needle
from tests.guidance.closed_form import Rod, ball

NEEDLE = Needle(100.0, 1.0)
LIMITS = Limits(approach_s=6.0)
Z = np.array([0.0, 0.0, 1.0])


def motion(tip, velocity, direction=Z, spread=0.0, rate_spread=0.0, turn=(0.0, 0.0, 0.0)):
    P = np.diag([spread**2, rate_spread**2])
    return Motion(
        0.0,
        Track(np.asarray(tip, float), np.asarray(velocity, float), P, 0.0),
        Track(np.asarray(direction, float), np.asarray(turn, float), np.zeros((2, 2)), 0.0),
    )


def test_head_on_contact_is_at_gap_over_speed():
    f = forecast_contact(ball([0, 0, 30], 10), NEEDLE, motion([0, 0, 0], [0, 0, 5]), LIMITS, 0.0)
    assert f.seconds == pytest.approx((30 - 10 - 1) / 5, abs=0.02)
    assert f.travel_mm == pytest.approx(19.0, abs=0.1)
    assert f.earliest_s <= f.seconds <= f.latest_s
    assert f.latest_s - f.earliest_s < 0.08


def test_the_age_of_the_pose_counts():
    f = forecast_contact(ball([0, 0, 30], 10), NEEDLE, motion([0, 0, 0], [0, 0, 5]), LIMITS, 0.3)
    assert f.seconds == pytest.approx(3.8 - 0.3, abs=0.02)


def test_moving_away_or_past_meets_nothing():
    for velocity in ([0, 0, -5], [5, 0, 0]):
        f = forecast_contact(ball([0, 0, 30], 10), NEEDLE, motion([0, 0, 0], velocity), LIMITS, 0.0)
        assert f.seconds == np.inf
        assert f.latest_s == np.inf


def test_what_is_far_is_settled_by_the_known_gap():
    """A gap that cannot close soon is not asked about: here the stated gap is wrong on purpose, and believed."""
    near = ball([0, 0, 30], 10)
    assert forecast_contact(near, NEEDLE, motion([0, 0, 0], [0, 0, 5]), LIMITS, 0.0, gap_mm=90.0).seconds == np.inf
    assert forecast_contact(near, NEEDLE, motion([0, 0, 0], [0, 0, 5]), LIMITS, 0.0, gap_mm=19.0).seconds < 4.0


def test_a_possible_graze_has_an_earliest_but_no_latest():
    """The path misses the ball by 0.5 mm; with a spread of 0.5 mm it may touch, and need not."""
    f = forecast_contact(ball([11.5, 0, 30], 10), NEEDLE, motion([0, 0, 0], [0, 0, 5], spread=0.5), LIMITS, 0.0)
    assert f.seconds == np.inf
    assert 3.0 < f.earliest_s < 6.0
    assert f.latest_s == np.inf


def test_the_shaft_counts_too():
    """A needle swept sideways meets a rod half way up its shaft."""
    f = forecast_contact(Rod([20, -50, -50], [20, 50, -50], 3), NEEDLE, motion([0, 0, 0], [4, 0, 0]), LIMITS, 0.0)
    assert f.seconds == pytest.approx((20 - 3 - 1) / 4, abs=0.03)


def test_a_turning_needle_is_followed():
    """The tip stays, the hub swings towards a ball that lies beside it."""
    f = forecast_contact(ball([30, 0, -100], 10), NEEDLE, motion([0, 0, 0], [0, 0, 0], turn=(-0.05, 0, 0)), LIMITS, 0.0)
    assert 3.0 < f.seconds < 5.0


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    spread=st.floats(0.05, 0.5),
    rate_spread=st.floats(0.01, 0.4),
)
def test_the_interval_covers_what_the_uncertainty_allows(seed, spread, rate_spread):
    """Draw the true motion from the stated covariance: its first contact lies in the interval, all but rarely.

    None at all is right only where contact is said not to be certain.
    """
    rng = np.random.default_rng(seed)
    shape = ball(rng.normal(size=3) * 4.0 + [0, 0, 35], rng.uniform(6, 12))
    stated = motion([0, 0, 0], [0, 0, 5], spread=spread, rate_spread=rate_spread)
    f = forecast_contact(shape, NEEDLE, stated, LIMITS, 0.0)
    misses = 0
    for _ in range(20):
        true = motion(spread * rng.normal(size=3), np.array([0, 0, 5]) + rate_spread * rng.normal(size=3))
        t = np.linspace(0.0, LIMITS.horizon_s, 1601)
        gap = shape.clearance(*true.axis(t, NEEDLE.length_mm), NEEDLE.radius_mm)
        hit = np.flatnonzero(gap <= 0.0)
        truth = t[hit[0]] if len(hit) else np.inf
        passes = truth == np.inf and not f.certain
        misses += not (passes or f.earliest_s - 0.02 <= truth <= f.latest_s + 0.02)
    assert misses <= 1
