"""Clock lines, interpolation, prediction and the guard against jumps: against known truth, and real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devices import DeviceInputError, SimulatedTracker, ToolPose, ToolStatus, TrackerFrame
from devices.pose_filter import JumpGuard, PoseBuffer, PoseFilter
from devices.recording import read_recording
from devices.rotation import pose_from_quaternion, rotation_from_vector, vector_from_rotation
from devices.timing import ClockLine, fit_clock

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "tracker" / "plus"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared tracker recordings are not here")


@given(st.floats(1e-3, 0.2), st.floats(-1e6, 1e6), st.integers(0, 10**6))
def test_the_line_is_found_under_jitter_and_late_arrivals(period_s: float, origin_s: float, first: int) -> None:
    generator = np.random.default_rng(first)
    numbers = first + np.cumsum(generator.integers(1, 4, 300))
    delays = np.abs(generator.normal(0.0, 0.05 * period_s, 300))
    delays[generator.choice(300, 15, replace=False)] += 20.0 * period_s
    fit = fit_clock(numbers, origin_s + period_s * numbers + delays)
    assert fit.period_s == pytest.approx(period_s, rel=1e-3)
    assert fit.used < 300
    assert np.abs(fit.time_s(numbers) - (origin_s + period_s * numbers)).max() < 0.2 * period_s + 1e-6


def test_too_little_for_a_line() -> None:
    for counts, times in ([[1, 2], [0.1, 0.2]], [[1, 1, 1], [0, 1, 2]], [[1, 2, 3], [0, np.nan, 1]], [[1, 2, 3], [1]]):
        with pytest.raises(DeviceInputError):
            fit_clock(counts, times)


def test_the_running_line_takes_the_jitter_out() -> None:
    generator = np.random.default_rng(0)
    line = ClockLine()
    misses, raw = [], []
    latest = -np.inf
    for k in range(600):
        truth = 50.0 + k / 60.0
        arrival = max(latest, truth + abs(generator.normal(0.0, 0.003)))
        latest = arrival
        time_s = line.add(1000 + k, arrival)
        assert time_s <= arrival
        if k > 100:
            misses.append(time_s - truth)
            raw.append(arrival - truth)
    assert np.std(misses) < 0.35 * np.std(raw)
    assert abs(np.mean(misses)) < 0.001


@needs_data
def test_a_real_clock_with_a_gap() -> None:
    """A public recording with an arrival gap: the line through frame numbers carries on."""
    frames = read_recording(DATA / "TimestampFilteringTest.csv")
    fit = fit_clock([frame.number for frame in frames], [frame.arrival_s for frame in frames])
    steps = np.diff([frame.arrival_s for frame in frames])
    assert steps.max() > 0.3
    assert fit.period_s == pytest.approx(1 / 56.0, rel=0.01)
    assert fit.jitter_s < 0.012


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_the_rotation_vector_comes_back(vector: list[float]) -> None:
    turn = np.array(vector) / max(1.0, np.linalg.norm(vector) / 3.0)
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(turn)), turn, atol=1e-9)
    np.testing.assert_allclose(Rotation.from_rotvec(turn).as_matrix(), rotation_from_vector(turn), atol=1e-12)


def insertion(noise_mm: float = 0.0, noise_deg: float = 0.0) -> SimulatedTracker:
    start = pose_from_quaternion([1, 0, 0, 0], [0, 0, 0])
    end = pose_from_quaternion([0.9, 0.3, 0.1, 0.2], [40, 20, -90])
    return SimulatedTracker(
        {"needle": [(0.0, start), (4.0, end)]}, rate_hz=60, noise_mm=noise_mm, noise_deg=noise_deg, seed=1
    )


def test_between_frames_the_buffer_interpolates_and_in_gaps_it_does_not() -> None:
    tracker = insertion()
    buffer = PoseBuffer("needle", keep_s=10.0)
    for frame in tracker.frames():
        if not 1.0 < frame.time_s < 1.5:
            buffer.add(frame)
    for time_s in (0.0, 0.123, 0.99, 1.71, 3.999, 4.0):
        np.testing.assert_allclose(buffer.at(time_s), tracker.truth("needle", time_s), atol=1e-9)
    assert buffer.at(1.2) is None
    assert buffer.at(-0.001) is None
    assert buffer.at(4.001) is None
    before = buffer.at(4.0)
    buffer.add(TrackerFrame(999, 5.0, 5.0, {"needle": ToolPose(ToolStatus.OUT_OF_VOLUME, np.eye(4))}))
    buffer.add(TrackerFrame(999, 5.0, 5.0, {"needle": ToolPose(ToolStatus.OK, np.full((4, 4), np.nan))}))
    buffer.add(TrackerFrame(999, 3.0, 3.0, {"needle": ToolPose(ToolStatus.OK, np.eye(4))}))
    assert np.array_equal(buffer.at(4.0), before)
    assert buffer.at(5.0) is None


def test_prediction_bridges_the_latency_and_knows_its_error() -> None:
    tracker = insertion(noise_mm=0.25, noise_deg=0.15)
    tool = PoseFilter(noise_mm=0.25, noise_rad=np.deg2rad(0.15))
    misses, turns, held = [], [], []
    for frame in tracker.frames():
        tool.add(frame.time_s, frame.tools["needle"].T_tracker_tool)
        if 1.0 < frame.time_s < 3.8:
            prediction = tool.predict(frame.time_s + 0.1)
            truth = tracker.truth("needle", frame.time_s + 0.1)
            miss = prediction.T_tracker_tool[:3, 3] - truth[:3, 3]
            misses.append(miss / prediction.position_sigma_mm)
            turns.append(vector_from_rotation(truth[:3, :3].T @ prediction.T_tracker_tool[:3, :3]))
            held.append((frame.tools["needle"].T_tracker_tool - truth)[:3, 3])
            assert prediction.ahead_s == pytest.approx(0.1)
            assert np.linalg.norm(prediction.velocity_mm_s - [10, 5, -22.5]) < 4 * 1.8 * prediction.velocity_sigma_mm_s
    # stated for a hand that accelerates: at constant speed it must not be exceeded
    assert np.std(misses) < 1.0
    assert np.sqrt(np.mean(np.square(misses))) * prediction.position_sigma_mm < np.sqrt(np.mean(np.square(held)))
    assert np.std(turns) < prediction.rotation_sigma_rad


def test_prediction_ends_where_nothing_is_known() -> None:
    tool = PoseFilter()
    assert tool.predict(0.0) is None
    tool.add(1.0, np.eye(4))
    assert tool.predict(0.9) is None
    assert tool.predict(1.4).ahead_s == pytest.approx(0.4)
    assert tool.predict(1.6) is None
    far = np.eye(4)
    far[0, 3] = 500.0
    tool.add(3.0, far)  # long after: a new start, no velocity made up from the gap
    assert np.linalg.norm(tool.predict(3.1).velocity_mm_s) == 0.0
    tool.add(2.0, np.eye(4))
    np.testing.assert_array_equal(tool.predict(3.0).T_tracker_tool, far)
    with pytest.raises(DeviceInputError, match="rigid"):
        tool.add(4.0, np.full((4, 4), np.nan))
    with pytest.raises(DeviceInputError):
        PoseFilter(noise_mm=0.0)


@needs_data
def test_the_jump_and_the_invalid_frame_of_a_public_recording_are_flagged() -> None:
    frames = read_recording(DATA / "TransformInterpolationTest.csv")
    invalid = [k for k, frame in enumerate(frames) if frame.tools["ProbeToTracker"].status is not ToolStatus.OK]
    assert invalid == [7]
    for tool in ("ProbeToTracker", "ReferenceToTracker"):
        guard = JumpGuard()
        jumps = [k for k, frame in enumerate(frames) if guard.jumps(frame.time_s, frame.tools[tool].T_tracker_tool)]
        assert jumps == [7]
    assert (
        np.linalg.norm(np.subtract(*(frames[k].tools["ReferenceToTracker"].T_tracker_tool[:3, 3] for k in (6, 7))))
        > 1500
    )


@needs_data
@pytest.mark.parametrize("name", ["EightLandmarkPointsTrackedForPhantomRegistration", "SlidingProbeTrackingData"])
def test_real_hands_do_not_jump(name: str) -> None:
    frames = read_recording(DATA / f"{name}.csv")
    for tool in frames[0].tools:
        guard = JumpGuard()
        assert not any(guard.jumps(frame.time_s, frame.tools[tool].T_tracker_tool) for frame in frames)


def test_the_guard_comes_back_by_itself() -> None:
    guard = JumpGuard(fastest_mm_s=1000.0)
    far = np.eye(4)
    far[0, 3] = 500.0
    assert not guard.jumps(0.0, np.eye(4))
    assert guard.jumps(0.1, far)
    assert guard.jumps(0.2, np.full((4, 4), np.nan))
    assert not guard.jumps(0.6, far)
    turned = far.copy()
    turned[:3, :3] = rotation_from_vector([0, 0, 2.0])
    assert guard.jumps(0.61, turned)
    with pytest.raises(DeviceInputError):
        JumpGuard(fastest_mm_s=0.0)
