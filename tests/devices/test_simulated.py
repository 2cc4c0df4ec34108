"""The simulated tracker: its frames against its own truth and the laws asked for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from devices import DeviceInputError, ManualClock, SimulatedTracker, ToolPose, ToolStatus, TrackerError, open_tracker
from devices.rotation import pose_from_quaternion

START = pose_from_quaternion([1, 0, 0, 0], [0, 0, -1000])
END = pose_from_quaternion([0.9, 0.1, -0.3, 0.2], [100, -50, -900])
WAYPOINTS = {"needle": [(0.0, START), (10.0, END)], "reference": [(2.0, END)]}


def test_without_errors_it_is_the_truth() -> None:
    tracker = SimulatedTracker(WAYPOINTS, rate_hz=50)
    frames = list(tracker.frames())
    assert [frame.number for frame in frames] == list(range(501))
    for frame in frames[::50]:
        for tool, pose in frame.tools.items():
            assert pose.status is ToolStatus.OK
            assert np.array_equal(pose.T_tracker_tool, tracker.truth(tool, frame.time_s))
    assert np.array_equal(frames[-1].tools["needle"].T_tracker_tool, END)
    assert np.array_equal(frames[0].tools["reference"].T_tracker_tool, END)


def test_noise_has_the_stated_size() -> None:
    tracker = SimulatedTracker(WAYPOINTS, rate_hz=200, noise_mm=0.3, noise_deg=0.2, seed=4)
    shifts, turns = [], []
    for frame in tracker.frames():
        T = np.linalg.inv(tracker.truth("needle", frame.time_s)) @ frame.tools["needle"].T_tracker_tool
        shifts.append(T[:3, 3])
        turns.append([T[2, 1], T[0, 2], T[1, 0]])
    n = len(shifts)
    assert np.std(shifts) == pytest.approx(0.3, rel=4 / np.sqrt(6 * n))
    assert np.rad2deg(np.std(turns)) == pytest.approx(0.2, rel=4 / np.sqrt(6 * n))
    assert np.abs(np.mean(shifts, axis=0)).max() < 4 * 0.3 / np.sqrt(n)


def test_time_jitter_and_latency() -> None:
    tracker = SimulatedTracker(WAYPOINTS, rate_hz=100, latency_s=0.05, jitter_s=0.004, seed=1)
    frames = list(tracker.frames())
    delays = np.array([frame.arrival_s - frame.time_s for frame in frames])
    assert delays.mean() == pytest.approx(0.05, abs=0.001)
    assert delays.std() == pytest.approx(0.004, rel=0.2)
    arrivals = [frame.arrival_s for frame in frames]
    assert arrivals == sorted(arrivals)
    blind = SimulatedTracker(WAYPOINTS, rate_hz=100, latency_s=0.05, jitter_s=0.004, seed=1, timestamps=False)
    for stamped, guessed in zip(frames, blind.frames(), strict=True):
        assert guessed.time_s == pytest.approx(stamped.arrival_s - 0.05, abs=1e-12)


def test_dropout_leaves_holes_in_the_numbers() -> None:
    tracker = SimulatedTracker(WAYPOINTS, rate_hz=100, dropout=0.25, seed=2)
    numbers = [frame.number for frame in tracker.frames()]
    assert len(numbers) == pytest.approx(750, abs=4 * np.sqrt(1001 * 0.25 * 0.75))
    assert numbers == sorted(set(numbers))


def test_occlusion_and_outliers_touch_only_their_own() -> None:
    plain = SimulatedTracker(WAYPOINTS, rate_hz=20, noise_mm=0.1, seed=3)
    marred = SimulatedTracker(
        WAYPOINTS, rate_hz=20, noise_mm=0.1, seed=3, occlusions=[("needle", 4.0, 5.0)], outlier_share=0.1, outlier_mm=70
    )
    displaced = 0
    for clean, bad in zip(plain.frames(), marred.frames(), strict=True):
        pose = bad.tools["needle"]
        if 4.0 <= bad.time_s <= 5.0:
            assert pose.status is ToolStatus.MISSING
            assert pose.T_tracker_tool is None
            continue
        miss = np.linalg.norm((pose.T_tracker_tool - clean.tools["needle"].T_tracker_tool)[:3, 3])
        assert miss == 0.0 or miss == pytest.approx(70.0)
        displaced += miss > 0.0
    assert 5 <= displaced <= 35


def test_reading_and_iterating_give_the_same_frames() -> None:
    kwargs = {"noise_mm": 0.2, "noise_deg": 0.1, "jitter_s": 0.002, "latency_s": 0.01, "dropout": 0.1, "seed": 9}
    clock = ManualClock()
    read = []
    with SimulatedTracker(WAYPOINTS, clock=clock, **kwargs) as tracker:
        while not tracker.is_finished:
            frame = tracker.read(1.0)
            assert frame is not None
            assert frame.arrival_s <= clock.now_s()
            read.append(frame)
    iterated = list(SimulatedTracker(WAYPOINTS, **kwargs).frames())
    assert len(read) == len(iterated)
    assert all(a.same(b) for a, b in zip(read, iterated, strict=True))
    other = next(iter(SimulatedTracker(WAYPOINTS, **{**kwargs, "seed": 10}).frames()))
    assert not other.same(iterated[0])


def test_truth_follows_the_clock_of_the_frames() -> None:
    tracker = SimulatedTracker(WAYPOINTS, clock=ManualClock(500.0))
    with tracker:
        frame = tracker.read(1.0)
        assert frame is not None
        assert frame.time_s == 500.0
        assert np.array_equal(tracker.truth("needle", frame.time_s), START)


def test_read_returns_none_after_its_timeout() -> None:
    clock = ManualClock()
    tracker = SimulatedTracker(WAYPOINTS, rate_hz=1.0, latency_s=0.5, clock=clock)
    with pytest.raises(TrackerError, match="start"):
        tracker.read(0.1)
    with tracker:
        assert tracker.read(0.1) is None
        assert clock.now_s() == 0.1
        frame = tracker.read(1.0)
        assert frame is not None
        assert frame.arrival_s == 0.5
        with pytest.raises(DeviceInputError, match="timeout"):
            tracker.read(-1.0)


@pytest.mark.parametrize(
    ("waypoints", "options", "message"),
    [
        ({}, {}, "at least one tool"),
        ({"a": []}, {}, "at least one"),
        ({"a": [(0.0, START), (0.0, END)]}, {}, "waypoint 1 of 'a'"),
        ({"a": [(0.0, np.zeros((4, 4)))]}, {}, "waypoint 0 of 'a'"),
        ({"a": [(np.nan, START)]}, {}, "finite"),
        (WAYPOINTS, {"dropout": 1.5}, "share"),
        (WAYPOINTS, {"noise_mm": -1}, "noise_mm"),
        (WAYPOINTS, {"rate_hz": 0}, "rate_hz"),
        (WAYPOINTS, {"occlusions": [("drill", 0, 1)]}, "drill"),
    ],
)
def test_nonsense_is_refused(waypoints: dict, options: dict, message: str) -> None:
    with pytest.raises(DeviceInputError, match=message):
        SimulatedTracker(waypoints, **options)


def test_a_pose_must_not_be_ok_and_absent() -> None:
    with pytest.raises(DeviceInputError, match="OK needs a pose"):
        ToolPose(ToolStatus.OK, None)
    with pytest.raises(DeviceInputError, match="shape"):
        ToolPose(ToolStatus.OK, np.eye(3))
    T = np.eye(4)
    pose = ToolPose(ToolStatus.OK, T)
    T[0, 3] = 5.0
    assert pose.T_tracker_tool[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        pose.T_tracker_tool[0, 3] = 1.0


def test_the_url_opens_the_same_tracker(tmp_path: Path) -> None:
    plan = {
        "ranked": [],
        "waypoints": {
            tool: [{"time_s": time_s, "T_tracker_tool": T.tolist()} for time_s, T in points]
            for tool, points in WAYPOINTS.items()
        },
    }
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan))
    url = f"sim:{path}?seed=1&rate=30&noise_mm=0.2&occlusion=needle,1,2"
    direct = SimulatedTracker(WAYPOINTS, rate_hz=30, seed=1, noise_mm=0.2, occlusions=[("needle", 1, 2)])
    opened = open_tracker(url, clock=ManualClock())
    assert isinstance(opened, SimulatedTracker)
    assert all(a.same(b) for a, b in zip(opened.frames(), direct.frames(), strict=True))


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("sim", "tracker URL"),
        ("usb:/dev/x", "sim:"),
        ("sim:", "nothing after"),
        ("sim:nowhere.json", "nowhere.json"),
        ("sim:plan.json?speed=2", "unknown parameter 'speed'"),
        ("sim:plan.json?rate=fast", "rate='fast'"),
        ("sim:plan.json?rate", "name=value"),
        ("sim:plan.json?rate=1&rate=2", "2 times"),
        ("replay:nowhere.jsonl", "nowhere.jsonl"),
    ],
)
def test_a_wrong_url_says_what_is_wrong(url: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text('{"waypoints": {"a": [{"time_s": 0}]}}')
    with pytest.raises(DeviceInputError, match=message):
        open_tracker(url.replace("plan.json", str(tmp_path / "plan.json")))


def test_a_plan_without_poses_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text('{"waypoints": {"a": [{"time_s": 0}]}}')
    with pytest.raises(DeviceInputError, match="T_tracker_tool"):
        open_tracker(f"sim:{path}")
