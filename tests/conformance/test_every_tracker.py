"""One suite for all trackers: whatever `open_tracker` returns behaves like this.

Serial line + emulator and TCP + emulator run through real pyserial and real sockets; OpenIGTLink through real sockets.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from devices import (
    IgtlServer,
    IgtlTracker,
    NdiTracker,
    Recorder,
    ReplayTracker,
    SimulatedTracker,
    Stream,
    ToolPose,
    ToolStatus,
    Tracker,
    TrackerError,
    TrackerFrame,
)
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import Emulator, PtyEmulator, TcpEmulator
from devices.recording import read_recording
from devices.rotation import is_rigid, pose_from_quaternion

RATE_HZ = 100.0
KINDS = ["serial TX", "serial BX", "serial BX2", "tcp TX", "tcp BX2", "igtl", "simulated", "replay"]


@dataclass
class Bench:
    """A tracker, and what is known of the scene it looks at."""

    tracker: Tracker
    tools: tuple[str, ...]
    #: true pose of a tool in a frame, mm; tolerance in mm
    truth: Callable[[TrackerFrame, str], np.ndarray]
    tolerance: float


def orbit() -> dict[str, list[tuple[float, np.ndarray]]]:
    """Three tools that move for a minute; along x by exactly 0.1 mm a frame, so that a pose tells its frame."""
    tools = {}
    for k, name in enumerate(("StylusTipToReference", "Needle", "Probe")):
        start = pose_from_quaternion([0.8, 0.1, 0.1 * k, 0.5], [0.0, 10.0 * k, -900.0])
        end = pose_from_quaternion([0.7, 0.3, 0.2, 0.4], [600.0, 10.0 * k, -900.0])
        tools[name] = [(0.0, start), (60.0, end)]
    return tools


def ndi_bench(emulator: Emulator, mode: str) -> Bench:
    tracker = NdiTracker(emulator.url.removeprefix("ndi:"), mode=mode)

    def truth(frame: TrackerFrame, tool: str) -> np.ndarray:
        pose = emulator.device.truth(0x0A + int(tool.removeprefix("BODY-")), frame.number)
        return pose_from_quaternion(pose.quaternion, pose.position_mm)

    return Bench(tracker, ("BODY-0", "BODY-1", "BODY-2"), truth, 0.006 if mode == "TX" else 1e-5)


def igtl_bench(stack: ExitStack) -> Bench:
    server = stack.enter_context(IgtlServer(0))
    source = SimulatedTracker(orbit(), rate_hz=RATE_HZ)
    done = threading.Event()

    def send() -> None:
        for frame in source.frames():
            if done.wait(1.0 / RATE_HZ):
                return
            now_s = server.clock.now_s()
            server.send(TrackerFrame(frame.number, now_s, now_s, frame.tools))

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    stack.callback(sender.join)
    stack.callback(done.set)

    def truth(frame: TrackerFrame, tool: str) -> np.ndarray:
        x = frame.tools["Needle"].T_tracker_tool[0, 3]
        return source.truth(tool, x / 10.0)

    return Bench(IgtlTracker("127.0.0.1", server.port), tuple(orbit()), truth, 1e-3)


@pytest.fixture(params=KINDS)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    kind = request.param
    with ExitStack() as stack:
        if kind.startswith(("serial", "tcp")):
            line, mode = kind.split()
            device = Device(SimulatedBodies(3, RATE_HZ), rate_hz=RATE_HZ)
            emulator = PtyEmulator(device) if line == "serial" else TcpEmulator(device)
            yield ndi_bench(stack.enter_context(emulator), mode)
        elif kind == "igtl":
            yield igtl_bench(stack)
        else:
            simulated = SimulatedTracker(orbit(), rate_hz=RATE_HZ)
            tracker: Tracker = simulated
            if kind == "replay":
                tracker = ReplayTracker(
                    list(itertools.islice(SimulatedTracker(orbit(), rate_hz=RATE_HZ).frames(), 400))
                )
            yield Bench(tracker, tuple(orbit()), lambda frame, tool: simulated.truth(tool, frame.time_s), 1e-9)


def read_frames(tracker: Tracker, count: int) -> list[TrackerFrame]:
    frames: list[TrackerFrame] = []
    for _ in range(20 * count):
        frame = tracker.read(0.5)
        if frame is not None:
            frames.append(frame)
        if len(frames) == count:
            break
    assert len(frames) == count
    return frames


def test_frames_are_ordered_timed_and_true(bench: Bench) -> None:
    with bench.tracker as tracker:
        frames = read_frames(tracker, 40)
        now_s = tracker.now_s()
    numbers = [frame.number for frame in frames]
    assert numbers == sorted(set(numbers))
    for earlier, later in itertools.pairwise(frames):
        assert earlier.time_s <= later.time_s
        assert earlier.arrival_s <= later.arrival_s
    for frame in frames:
        assert frame.time_s <= frame.arrival_s <= now_s + 1e-9
        for name, pose in frame.tools.items():
            assert name in bench.tools
            assert pose.status is ToolStatus.OK
            assert is_rigid(pose.T_tracker_tool)
            assert not pose.T_tracker_tool.flags.writeable
            miss = np.abs(pose.T_tracker_tool - bench.truth(frame, name))
            assert miss[:3, 3].max() <= bench.tolerance
            assert miss[:3, :3].max() <= max(2.5e-4 if bench.tolerance == 0.006 else 1e-6, 1e-9)
    # a first frame may lack tools whose messages had not come
    assert set(frames[-1].tools) == set(bench.tools)
    assert set(tracker.tool_names) == set(bench.tools)


def test_reading_needs_a_start(bench: Bench) -> None:
    with pytest.raises(TrackerError, match="start"):
        bench.tracker.read(0.1)
    bench.tracker.stop()  # of what never ran: nothing


def test_it_starts_and_stops_as_often_as_wanted(bench: Bench) -> None:
    for _ in range(2):
        bench.tracker.start()
        bench.tracker.start()
        assert bench.tracker.is_running
        read_frames(bench.tracker, 3)
        bench.tracker.stop()
        bench.tracker.stop()
        assert not bench.tracker.is_running
        with pytest.raises(TrackerError):
            bench.tracker.read(0.1)


def test_a_recording_of_it_replays_to_identical_frames(bench: Bench, tmp_path: Path) -> None:
    with bench.tracker as tracker, Recorder(tmp_path / "run.jsonl") as recorder:
        frames = read_frames(tracker, 20)
        for frame in frames:
            recorder.write(frame)
    with ReplayTracker(tmp_path / "run.jsonl", rate=None) as replay:
        again = [replay.read(0.0) for _ in frames]
        assert replay.is_finished
    assert all(a.same(b) for a, b in zip(again, frames, strict=True))
    assert len(read_recording(tmp_path / "run.jsonl")) == 20


def test_a_stream_over_it_misses_nothing_and_ends(bench: Bench) -> None:
    seen: list[int] = []
    enough = threading.Event()

    def take(frame: TrackerFrame) -> None:
        seen.append(frame.number)
        if len(seen) >= 30:
            enough.set()

    stream = Stream(bench.tracker, on_frame=take)
    with stream:
        assert enough.wait(30.0)
        assert stream.latest() is not None
    assert not bench.tracker.is_running
    assert not any(thread.name.startswith("stream of") for thread in threading.enumerate())
    assert seen == sorted(set(seen))
    assert stream.counters.frames >= len(seen)
    assert stream.counters.crc_errors == stream.counters.reconnects == stream.counters.errors == 0


def test_stop_from_another_thread_ends_a_read(bench: Bench) -> None:
    bench.tracker.start()
    outcome: list[object] = []

    def read_on() -> None:
        try:
            for _ in range(100_000):
                bench.tracker.read(30.0)
        except TrackerError:
            outcome.append("stopped")

    reader = threading.Thread(target=read_on, daemon=True)
    reader.start()
    bench.tracker.stop()
    reader.join(10.0)
    assert outcome == ["stopped"]


def test_a_missing_tool_is_data() -> None:
    """NaN and other nonsense is never sent as a pose, and arrives as a tool without one."""
    bad = np.eye(4)
    bad[0, 3] = np.nan
    tools = {
        "nan": ToolPose(ToolStatus.OK, bad),
        "scaled": ToolPose(ToolStatus.OK, 2.0 * np.eye(4)),
        "lost": ToolPose(ToolStatus.MISSING, None),
        "far": ToolPose(ToolStatus.OUT_OF_VOLUME, np.eye(4)),
        "good": ToolPose(ToolStatus.OK, np.eye(4)),
    }
    with IgtlServer(0) as server, IgtlTracker("127.0.0.1", server.port) as tracker:
        while server.clients == 0:
            tracker.read(0.01)
        now_s = server.clock.now_s()
        server.send(TrackerFrame(1, now_s, now_s, tools))
        frames = read_frames(tracker, 1)
    received = frames[0].tools
    assert {name: pose.status for name, pose in received.items()} == {
        "nan": ToolStatus.INVALID,
        "scaled": ToolStatus.INVALID,
        "lost": ToolStatus.MISSING,
        "far": ToolStatus.OUT_OF_VOLUME,
        "good": ToolStatus.OK,
    }
    assert all((pose.T_tracker_tool is None) == (name != "good") for name, pose in received.items())
