"""Recordings: what goes in comes out, bit for bit; public CSV files read as their README says."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from devices import (
    DeviceInputError,
    ManualClock,
    Recorder,
    ReplayTracker,
    SimulatedTracker,
    ToolPose,
    ToolStatus,
    TrackerFrame,
)
from devices.recording import read_recording

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "tracker"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared tracker recordings are not here")

numbers = st.floats(width=64)
matrices = hnp.arrays(np.float64, (4, 4), elements=numbers)
poses = st.builds(
    ToolPose,
    st.sampled_from(ToolStatus),
    matrices,
    numbers,
    st.none() | hnp.arrays(np.float64, st.tuples(st.integers(0, 4), st.just(3)), elements=numbers),
    st.integers(0, 7),
)
frames = st.builds(
    TrackerFrame,
    st.integers(0, 2**40),
    numbers.filter(lambda x: not math.isnan(x)),
    numbers.filter(lambda x: not math.isnan(x)),
    st.dictionaries(st.text(max_size=8), poses | st.just(ToolPose(ToolStatus.MISSING, None)), max_size=3),
    st.none() | hnp.arrays(np.float64, st.tuples(st.integers(0, 3), st.just(3)), elements=numbers),
)


@given(recorded=st.lists(frames, max_size=4))
def test_any_frame_comes_back_bit_for_bit(
    recorded: list[TrackerFrame], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("recording") / "frames.jsonl"
    with Recorder(path) as recorder:
        for frame in recorded:
            recorder.write(frame)
    replayed = read_recording(path)
    assert len(replayed) == len(recorded)
    assert all(a.same(b) for a, b in zip(replayed, recorded, strict=True))
    for line in path.read_text().splitlines():
        json.loads(line, parse_constant=pytest.fail)  # strict JSON: no bare NaN


def some_frames() -> list[TrackerFrame]:
    end = np.eye(4)
    end[0, 3] = 10.0
    tracker = SimulatedTracker({"needle": [(0.0, np.eye(4)), (1.0, end)]}, rate_hz=20, noise_mm=0.1, latency_s=0.02)
    return list(tracker.frames())


def test_every_frame_is_on_disk_at_once_and_a_cut_line_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    recorder = Recorder(path)
    for k, frame in enumerate(some_frames()):
        recorder.write(frame)
        assert len(read_recording(path)) == k + 1
    recorder.close()
    text = path.read_text()
    path.write_text(text[:-40])
    assert len(read_recording(path)) == len(some_frames()) - 1
    lines = text.splitlines()
    path.write_text("\n".join([*lines[:5], lines[5][:-30], *lines[6:]]))
    with pytest.raises(DeviceInputError, match="line 6"):
        read_recording(path)


def test_replay_keeps_time_at_any_rate() -> None:
    recorded = some_frames()
    clock = ManualClock(100.0)
    with ReplayTracker(recorded, rate=4.0, clock=clock) as tracker:
        assert tracker.tool_names == ("needle",)
        for frame in recorded:
            assert tracker.read(1.0) is frame
            assert clock.now_s() == pytest.approx(100.0 + (frame.arrival_s - recorded[0].arrival_s) / 4.0)
            assert tracker.now_s() == pytest.approx(frame.arrival_s)
        assert tracker.is_finished
        assert tracker.read(1.0) is None


def test_replay_steps_without_a_clock_and_starts_again() -> None:
    recorded = some_frames()
    clock = ManualClock()
    tracker = ReplayTracker(recorded, rate=None, clock=clock)
    for _ in range(2):
        with tracker:
            read = [tracker.read(0.0) for _ in recorded]
        assert all(a is b for a, b in zip(read, recorded, strict=True))
    assert clock.now_s() == 0.0


def test_replay_waits_no_longer_than_told() -> None:
    recorded = [TrackerFrame(0, 0.0, 0.0), TrackerFrame(1, 5.0, 5.0)]
    clock = ManualClock()
    with ReplayTracker(recorded, clock=clock) as tracker:
        assert tracker.read(1.0) is recorded[0]
        assert tracker.read(1.0) is None
        assert clock.now_s() == 1.0
        assert tracker.read(4.0) is recorded[1]


@pytest.mark.parametrize(
    "text", ["", "hello\n", "{}\n", '{"format": "tracker-recording", "version": 9}\n', "a,b\n1,2\n"]
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file.txt"
    path.write_text(text)
    with pytest.raises(DeviceInputError, match="first line"):
        read_recording(path)
    with pytest.raises(DeviceInputError, match="rate"):
        ReplayTracker([], rate=0.0)


def test_a_spoilt_csv_names_its_line(tmp_path: Path) -> None:
    header = "frame,timestamp,unfiltered_timestamp,frame_number,name,status," + ",".join(
        f"m{row}{column}" for row in range(3) for column in range(4)
    )
    path = tmp_path / "poses.csv"
    path.write_text(header + "\n0,0.5,,,ToolToTracker,OK,1,0,0,x,0,1,0,0,0,0,1,0\n")
    with pytest.raises(DeviceInputError, match="line 2"):
        read_recording(path)
    # no pose, a scaled matrix that calls itself OK, and a status nobody knows
    path.write_text(
        header
        + "\n0,0.5,,,A,OK,,,,,,,,,,,,\n0,0.5,,,B,OK,2,0,0,1,0,2,0,0,0,0,2,0\n0,0.5,,,C,ODD,1,0,0,1,0,1,0,0,0,0,1,0\n"
    )
    (frame,) = read_recording(path)
    assert [pose.status for pose in frame.tools.values()] == [
        ToolStatus.MISSING,
        ToolStatus.INVALID,
        ToolStatus.INVALID,
    ]


@needs_data
def test_the_public_recordings_read_as_described() -> None:
    dwells = read_recording(DATA / "plus" / "EightLandmarkPointsTrackedForPhantomRegistration.csv")
    assert len(dwells) == 1000
    assert set(dwells[0].tools) == {"ReferenceToTracker", "StylusToTracker"}
    assert dwells[0].tools["StylusToTracker"].T_tracker_tool[:3, 3] == pytest.approx(
        [315.553, 9.823, -36.054], abs=1e-3
    )
    tank = read_recording(DATA / "plus" / "WaterTankBottomTranslationTrackerBuffer-trimmed.csv")
    assert len(tank) == 801
    assert tank[0].number == 332203
    assert {b.number - a.number for a, b in itertools.pairwise(tank)} == {1, 2, 3}
    jump = read_recording(DATA / "plus" / "TransformInterpolationTest.csv")
    assert sum(frame.tools["ProbeToTracker"].status is ToolStatus.INVALID for frame in jump) == 1
    # this file states no status for the reference: not known to be good, so never OK
    assert all(frame.tools["ReferenceToTracker"].status is ToolStatus.INVALID for frame in jump)
    wires = read_recording(DATA / "plus" / "NwirePhantomFreehand.csv")
    assert all(frame.tools["StylusToTracker"].status is ToolStatus.INVALID for frame in wires)


@needs_data
def test_aurora_zeros_are_missing() -> None:
    samples = read_recording(DATA / "aurora" / "NDIdata_snakeravenTest_2_2_21.csv")
    assert len(samples) == 158
    assert list(samples[0].tools) == ["a", "b", "c", "d"]
    assert all(pose.status is ToolStatus.MISSING for pose in samples[0].tools.values())
    first = {name: next(f.number for f in samples if f.tools[name].status is ToolStatus.OK) for name in "abcd"}
    assert first["d"] == 2
    assert first["a"] == 3
    assert first["b"] == 5
    for sample in samples:
        for pose in sample.tools.values():
            assert pose.T_tracker_tool is None or np.linalg.norm(pose.T_tracker_tool[:3, 3]) > 100.0
    steps = np.diff([sample.time_s for sample in samples])
    assert np.median(steps) == pytest.approx(0.04, abs=0.01)


@needs_data
def test_a_csv_recorded_again_replays_identically(tmp_path: Path) -> None:
    source = DATA / "plus" / "SlidingProbeTrackingData.csv"
    with Recorder(tmp_path / "again.jsonl") as recorder, ReplayTracker(source, rate=None) as tracker:
        while not tracker.is_finished:
            recorder.write(tracker.read(0.0))
    again = read_recording(tmp_path / "again.jsonl")
    assert all(a.same(b) for a, b in zip(again, read_recording(source), strict=True))
