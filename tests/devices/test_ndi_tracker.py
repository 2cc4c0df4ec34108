"""`NdiTracker` through real pyserial and real sockets, against the emulator and each of its faults."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from devices import (
    DeviceInputError,
    ManualClock,
    NdiTracker,
    ProtocolError,
    Stream,
    ToolStatus,
    TrackerError,
    TrackerFrame,
    TransportError,
    open_tracker,
)
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import Emulator, PtyEmulator, TcpEmulator
from devices.ndi.faults import Faults
from devices.ndi.ports import Port
from devices.rotation import pose_from_quaternion

LINES = {"pty": PtyEmulator, "tcp": TcpEmulator}


def rom_bytes() -> bytes:
    content = bytearray(752)
    content[:4] = b"NDI\0"
    struct.pack_into("<I", content, 0x1C, 3)
    struct.pack_into("<9f", content, 0x48, 0, 0, 0, 0, 30, 40, 0, 0, 88)
    content[0x250:0x254] = b"PART"
    struct.pack_into("<H", content, 4, sum(content[6:]) & 0xFFFF)
    return bytes(content)


def place(emulator: Emulator) -> str:
    return emulator.url.removeprefix("ndi:")


def check_true(emulator: Emulator, tracker: NdiTracker, frame: TrackerFrame) -> None:
    """Every pose that is OK is the emulator's truth of that very frame: nothing damaged gets through."""
    raw = tracker._last_raw  # the device's own number: ours goes on where a reconnected device counts anew
    for handle, name in tracker._tools.items():
        pose = frame.tools.get(name)
        if pose is None or pose.status is not ToolStatus.OK:
            continue
        truth = emulator.device.truth(handle, raw)
        T = pose_from_quaternion(truth.quaternion, truth.position_mm)
        assert np.abs(pose.T_tracker_tool - T)[:3, 3].max() <= 0.006
        assert np.abs(pose.T_tracker_tool - T)[:3, :3].max() <= 2.5e-4


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("mode", ["TX", "BX", "BX2", "auto"])
def test_passive_and_wired_tools_with_markers_and_strays(line: str, mode: str, tmp_path: Path) -> None:
    (tmp_path / "drill.rom").write_bytes(rom_bytes())
    with LINES[line](Device(SimulatedBodies(2))) as emulator:
        url = f"{emulator.url}?rom={tmp_path / 'drill.rom'}&rom={tmp_path / 'drill.rom'}&name=probe&mode={mode}"
        tracker = open_tracker(url + "&markers=1&strays=1")
        assert isinstance(tracker, NdiTracker)
        assert tracker.tool_names == ("probe", "drill")
        with tracker:
            assert tracker.mode == ("BX2" if mode == "auto" else mode)
            assert tracker.tool_names == ("probe", "drill", "BODY-0", "BODY-1")
            for _ in range(10):
                frame = tracker.read(2.0)
                check_true(emulator, tracker, frame)
        assert not emulator.device.tracking
        assert emulator.device.baud_rate == 9600
        T = frame.tools["probe"].T_tracker_tool
        expected = np.array([[0, 0, 0], [0, 30, 40], [0, 0, 88]]) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(frame.tools["probe"].markers_mm, expected, atol=0.03)
        assert frame.strays_mm.shape == (1, 3)
        assert frame.tools["BODY-0"].markers_mm.shape == (0, 3)


@pytest.mark.parametrize("line", LINES)
def test_six_tools_and_no_frame_lost(line: str) -> None:
    """6 tools; device and host share a clock that moves only while the host waits, so no load of the machine counts."""
    clock = ManualClock()
    with LINES[line](Device(SimulatedBodies(6), clock)) as emulator:
        tracker = NdiTracker(place(emulator), mode="BX", clock=clock)
        with tracker:
            first = last = tracker.read(1.0).number
            for k in range(1, 500):
                frame = tracker.read(1.0)
                assert frame.number == last + 1
                last = frame.number
                if k % 50 == 0:
                    check_true(emulator, tracker, frame)
        assert last - first == 499
        assert tracker.counters.crc_errors == tracker.counters.malformed == tracker.counters.timeouts == 0


def run_under(
    line: str, faults: Faults, mode: str, frames: int, check: Callable[[Emulator, NdiTracker, TrackerFrame], None]
) -> tuple[NdiTracker, Emulator, list[TrackerFrame], int]:
    """Read frames while faults happen; count the `TransportError`s on the way."""
    with LINES[line](Device(SimulatedBodies(3, 200.0), rate_hz=200.0), faults) as emulator:
        tracker = NdiTracker(place(emulator), mode=mode, reply_timeout_s=0.15, command_timeout_s=0.3)
        got: list[TrackerFrame] = []
        reported = 0
        with tracker:
            for _ in range(50 * frames):
                try:
                    frame = tracker.read(0.5)
                except TransportError:
                    reported += 1
                    continue
                if frame is not None:
                    check(emulator, tracker, frame)
                    got.append(frame)
                if len(got) >= frames:
                    break
    assert len(got) >= frames
    numbers = [frame.number for frame in got]
    assert numbers == sorted(set(numbers))
    return tracker, emulator, got, reported


@pytest.mark.parametrize(("line", "mode"), [("pty", "TX"), ("tcp", "BX2"), ("tcp", "BX")])
@pytest.mark.parametrize("fault", ["cut", "corrupt", "duplicate", "late"])
def test_damaged_replies_are_dropped_and_never_become_poses(line: str, mode: str, fault: str) -> None:
    faults = Faults(**{fault: 0.1}, late_s=0.2, seed=3)
    tracker, emulator, _, _ = run_under(line, faults, mode, 30, check_true)
    assert emulator.faults.happened[fault] > 0
    counters = tracker.counters
    if fault == "corrupt":
        assert counters.crc_errors + counters.malformed + counters.timeouts > 0
    if fault in ("cut", "late"):
        assert counters.timeouts + counters.crc_errors + counters.malformed > 0


@pytest.mark.parametrize("line", LINES)
def test_a_lost_line_is_reported_and_found_again(line: str, tmp_path: Path) -> None:
    faults = Faults(disconnect=True, period=40)
    device = Device(SimulatedBodies(2, 200.0), rate_hz=200.0)
    made = PtyEmulator(device, faults, tmp_path / "tracker") if line == "pty" else TcpEmulator(device, faults)
    back = threading.Event()
    numbers: list[int] = []
    with made as emulator:
        tracker = NdiTracker(place(emulator), mode="BX")

        def take(frame: TrackerFrame) -> None:
            numbers.append(frame.number)
            if tracker.counters.reconnects >= 3:
                back.set()

        with Stream(tracker, on_frame=take) as stream:
            assert back.wait(60.0)
            with pytest.raises(TransportError):
                stream.latest()
        assert stream.counters.reconnects >= 3
        assert stream.counters.errors >= 3
        assert numbers == sorted(set(numbers))
        assert emulator.faults.happened["disconnect"] >= 3


@pytest.mark.parametrize("line", LINES)
def test_silence_is_reported_and_survived(line: str) -> None:
    faults = Faults(silence_s=1.2, period=120)
    tracker, emulator, _, reported = run_under(line, faults, "BX", 60, lambda *_: None)
    assert emulator.faults.happened["silence"] >= 1
    assert reported >= 1
    assert tracker.counters.reconnects >= 1


@pytest.mark.parametrize("mode", ["TX", "BX", "BX2"])
def test_a_tool_out_of_volume_is_told_apart(mode: str) -> None:
    faults = Faults(out_of_volume=True, period=10)
    _, _, frames, _ = run_under("tcp", faults, mode, 60, check_true)
    statuses = {frame.tools["BODY-0"].status for frame in frames}
    assert statuses == {ToolStatus.OK, ToolStatus.OUT_OF_VOLUME}
    assert all(frame.tools["BODY-1"].status is ToolStatus.OK for frame in frames)


@pytest.mark.parametrize("mode", ["TX", "BX", "BX2"])
def test_the_frame_number_wraps_and_ours_does_not(mode: str) -> None:
    clock = ManualClock()
    device = Device(SimulatedBodies(2), clock, first_frame=2**32 - 20)
    with TcpEmulator(device) as emulator, NdiTracker(place(emulator), mode=mode, clock=clock) as tracker:
        numbers = [tracker.read(1.0).number for _ in range(60)]
    assert np.diff(numbers).tolist() == [1] * 59
    assert numbers[-1] > 2**32


@pytest.mark.parametrize("line", LINES)
def test_it_starts_from_any_state(line: str) -> None:
    """A host that died in the middle: the device tracks, at another speed, with half a command in its ear."""
    device = Device(SimulatedBodies(1))
    device.receive(b"INIT \rPINIT 0A\rPENA 0AD\rTSTART \rPHSR:0")
    device.baud_rate = 115200
    with LINES[line](device) as emulator, NdiTracker(place(emulator)) as tracker:
        assert tracker.read(2.0) is not None


def test_a_tracker_reset_in_the_middle_is_noticed() -> None:
    with TcpEmulator(Device(SimulatedBodies(1))) as emulator, NdiTracker(place(emulator), mode="BX") as tracker:
        assert tracker.read(2.0) is not None
        emulator.device.reset()
        with pytest.raises(TransportError, match="no longer tracks"):
            tracker.read(5.0)
        assert tracker.read(5.0) is not None
        assert tracker.counters.reconnects == 1


def test_a_tool_plugged_in_later_joins() -> None:
    with TcpEmulator(Device(SimulatedBodies(1))) as emulator, NdiTracker(place(emulator), mode="TX") as tracker:
        assert tracker.tool_names == ("BODY-0",)
        emulator.device.ports.handles[0x0B] = Port(1, wired=True, part_number="BODY-1")
        emulator.device.system_status = 0x40
        frame = tracker.read(2.0)
        while "BODY-1" not in frame.tools:
            frame = tracker.read(2.0)
        assert tracker.tool_names == ("BODY-0", "BODY-1")
        assert frame.tools["BODY-1"].status is ToolStatus.OK


def test_what_an_earlier_session_loaded_is_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that keeps loaded tools through INIT: they must not come back as tools that nobody asked for."""
    device = Device(SimulatedBodies(1))
    monkeypatch.setattr(type(device.ports), "initialise_all", lambda ports: None)
    with TcpEmulator(device) as emulator:
        for _ in range(2):
            with NdiTracker(place(emulator), roms=[rom_bytes()], names=["drill"]) as tracker:
                assert tracker.tool_names == ("drill", "BODY-0")
                assert tracker.read(2.0) is not None
    assert sorted(device.ports.handles) == [0x01, 0x0A]


def test_an_older_device_falls_back_to_bx() -> None:
    old = Device(SimulatedBodies(1), api_revision="G.001.004")
    with TcpEmulator(old) as emulator, NdiTracker(place(emulator)) as tracker:
        assert tracker.read(2.0) is not None
        assert tracker.mode == "BX"


def test_speed_is_agreed_on_and_falls_back() -> None:
    class Slow(Device):
        """Refuses more than 57600 baud."""

        def _comm(self, arguments: str) -> str:
            return super()._comm("9" if arguments[0] in "56A" else arguments)

    import devices.ndi.device as module

    device = Slow(SimulatedBodies(1))
    original = module._COMMANDS["COMM"]
    module._COMMANDS["COMM"] = lambda self, arguments: type(self)._comm(self, arguments)
    try:
        with PtyEmulator(device) as emulator, NdiTracker(place(emulator), baud_rate=921600) as tracker:
            assert tracker.read(2.0) is not None
            assert device.baud_rate == 57600
            assert tracker._session.speed == 57600
    finally:
        module._COMMANDS["COMM"] = original


def test_no_tools_and_wrong_arguments_are_refused() -> None:
    with TcpEmulator(Device(SimulatedBodies(0))) as emulator, pytest.raises(TrackerError, match="no tools"):
        NdiTracker(place(emulator)).start()
    with pytest.raises(DeviceInputError, match="mode"):
        NdiTracker("/dev/null", mode="GX")
    with pytest.raises(DeviceInputError, match="names"):
        NdiTracker("/dev/null", names=["a"])
    with pytest.raises(DeviceInputError, match="begins with"):
        NdiTracker("/dev/null", roms=[b"not a tool"])
    with pytest.raises(DeviceInputError, match="HOST"):
        NdiTracker("tcp://host:port")
    with pytest.raises(TransportError, match="nowhere"):
        NdiTracker("/dev/nowhere").start()


def test_a_silent_port_is_no_tracker_and_stops_at_once() -> None:
    """A line on which nobody ever answers: `stop` from another thread ends the start."""
    master, slave = os.openpty()
    try:
        tracker = NdiTracker(os.ttyname(slave))
        failures: list[BaseException] = []

        def start() -> None:
            try:
                tracker.start()
            except TransportError as error:
                failures.append(error)

        thread = threading.Thread(target=start, daemon=True)
        thread.start()
        tracker.stop()
        while thread.is_alive():
            tracker._stopping.set()
            thread.join(0.05)
        assert len(failures) == 1
    finally:
        os.close(master)
        os.close(slave)


def test_a_stream_counts_what_the_line_loses() -> None:
    faults = Faults(corrupt=0.1, seed=2)
    with TcpEmulator(Device(SimulatedBodies(2, 200.0), rate_hz=200.0), faults) as emulator:
        enough = threading.Event()
        seen: list[int] = []

        def take(frame: TrackerFrame) -> None:
            seen.append(frame.number)
            if len(seen) >= 60:
                enough.set()

        with Stream(NdiTracker(place(emulator), mode="TX"), on_frame=take) as stream:
            assert enough.wait(60.0)
        counters = stream.counters
    assert counters.crc_errors > 0
    assert counters.gaps == seen[-1] - seen[0] + 1 - len(seen) or counters.frames > len(seen)


def test_replies_of_the_wrong_kind_are_protocol_errors() -> None:
    with TcpEmulator(Device(SimulatedBodies(1))) as emulator, NdiTracker(place(emulator), mode="BX") as tracker:
        tracker.mode = "TX"
        tracker.mode, kept = "BX2", tracker.mode
        assert tracker.read(2.0) is not None
        tracker.mode = kept
        with pytest.raises(ProtocolError, match="BX:0001"):
            tracker._session.ask_text("BX", "0001")
