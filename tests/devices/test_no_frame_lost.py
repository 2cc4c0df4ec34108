"""Nothing between device and callback may skip a frame: slow callbacks, Python's lock, an emulator that is held up."""

from __future__ import annotations

import gc
import sys
import threading

import pytest

from devices import DeviceInputError, ManualClock, NdiTracker, Stream, SystemClock, Tracker, TrackerFrame
from devices.ndi import emulator as emulator_module
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import PtyEmulator, TcpEmulator
from devices.ndi.pace import PacedClock
from devices.ndi.protocol import command
from devices.scheduling import AS_ANY_OTHER, HASTE, hurry_this_thread

PERIOD_S = 1.0 / 60.0


class Endless(Tracker):
    """Frame after frame, as fast as they are read."""

    def __init__(self, live: bool = False) -> None:
        super().__init__(ManualClock())
        self.live = live
        self.number = 0

    @property
    def tool_names(self) -> tuple[str, ...]:
        return ()

    @property
    def is_live(self) -> bool:
        return self.live

    def _read(self, timeout_s: float) -> TrackerFrame | None:
        self.number += 1
        return TrackerFrame(self.number, 0.0, 0.0)


def test_a_slow_callback_holds_up_neither_the_reader_nor_the_mailbox() -> None:
    seen: list[int] = []
    released, enough = threading.Event(), threading.Event()

    def slow(frame: TrackerFrame) -> None:
        released.wait(20.0)
        seen.append(frame.number)
        if len(seen) >= 500:
            enough.set()

    with Stream(Endless(), on_frame=slow) as stream:
        newest = stream.wait(None, 20.0)
        while newest.number < 258:  # one is with the callback, 256 wait; with the next the reader waits too
            newest = stream.wait(newest, 20.0)
        assert newest.number == 258
        assert stream.wait(newest, 0.1) is None
        assert not seen
        released.set()
        assert enough.wait(20.0)
    assert seen == list(range(1, len(seen) + 1))


def test_a_callback_that_hangs_does_not_keep_the_stream_from_stopping() -> None:
    hanging, let_go = threading.Event(), threading.Event()

    def hang(_: TrackerFrame) -> None:
        hanging.set()
        let_go.wait(60.0)

    stream = Stream(Endless(), on_frame=hang)
    stream.start()
    assert hanging.wait(20.0)
    thread = next(t for t in threading.enumerate() if t.name.endswith("callback"))
    stream.stop()
    assert thread.is_alive()  # it sits in the caller's own code
    assert not stream.tracker.is_running
    let_go.set()
    thread.join(20.0)
    assert not thread.is_alive()


def test_a_callback_may_stop_its_stream() -> None:
    stopped = threading.Event()

    def stop(_: TrackerFrame) -> None:
        stream.stop()
        stopped.set()

    stream = Stream(Endless(), on_frame=stop)
    stream.start()
    assert stopped.wait(20.0)
    assert not stream.tracker.is_running


@pytest.mark.parametrize("live", [True, False])
def test_turns_are_short_and_collections_quick_while_a_live_tracker_is_read(live: bool) -> None:
    usual = sys.getswitchinterval()
    frozen = gc.get_freeze_count()
    during: list[tuple[float, int]] = []
    called = threading.Event()

    def look(_: TrackerFrame) -> None:
        during.append((sys.getswitchinterval(), gc.get_freeze_count()))
        called.set()

    with Stream(Endless(live), on_frame=look) as stream:
        assert called.wait(20.0)
    assert (sys.getswitchinterval(), gc.get_freeze_count()) == (usual, frozen)
    interval_s, count = during[0]
    assert interval_s == (pytest.approx(0.0005) if live else usual)
    assert (count > frozen) == live
    assert (stream.scheduling == AS_ANY_OTHER) or live


def test_two_in_haste_leave_everything_as_it_was() -> None:
    usual = (sys.getswitchinterval(), gc.get_freeze_count())
    for _ in range(2):
        HASTE.begin()
    HASTE.end()
    assert sys.getswitchinterval() == pytest.approx(0.0005)
    kept = [[] for _ in range(1000)]
    before = gc.get_freeze_count()
    HASTE.go_on()
    assert gc.get_freeze_count() >= before + len(kept) // 2  # some of those frozen before may be gone
    HASTE.end()
    assert (sys.getswitchinterval(), gc.get_freeze_count()) == usual


def test_who_froze_on_purpose_stays_frozen() -> None:
    gc.freeze()
    try:
        count = gc.get_freeze_count()
        HASTE.begin()
        HASTE.go_on()
        HASTE.end()
        assert gc.get_freeze_count() == count
    finally:
        gc.unfreeze()


def test_a_thread_may_always_ask_for_haste() -> None:
    said: list[str] = []
    thread = threading.Thread(target=lambda: said.extend([hurry_this_thread(real_time=False), hurry_this_thread()]))
    thread.start()
    thread.join()
    assert len(said) == 2
    assert all(said)


class Served:
    """A device with its paced clock and the loop around it, turn by turn, in a time of the test's making."""

    def __init__(self) -> None:
        self.real = ManualClock(100.0)
        self.clock = PacedClock(self.real)
        self.device = Device(SimulatedBodies(1), self.clock)
        self.device.receive(command("INIT") + command("TSTART"))

    def wait(self, late_s: float = 0.0) -> float:
        """Wait until the next frame is due, and so much longer; return what was meant."""
        meant_s = self.clock.real_s(self.device.next_frame_s())
        self.real.advance(meant_s + late_s)
        return meant_s


def test_an_emulator_that_is_held_up_skips_no_frame() -> None:
    served = Served()
    shown = []
    for k in range(200):
        meant_s = served.wait(late_s=0.060 if k % 10 == 3 else 0.0003)
        shown.append(served.device.frame_index())  # a question came meanwhile; it may be as old as the wait
        served.clock.turn(meant_s)
        shown.append(served.device.frame_index())
    assert set(shown) == set(range(shown[-1] + 1))
    # what it was held up is made good: after a while without trouble it is as late as a frame at most
    assert served.clock.held_up_s == pytest.approx(20 * 0.060, rel=0.1)
    for _ in range(400):
        served.clock.turn(served.wait())
    assert served.device.frame_index() == int((served.real.now_s() - 100.0) * 60.0 + 1e-6)


def test_a_client_that_does_not_ask_loses_frames_all_the_same() -> None:
    served = Served()
    served.clock.turn(served.wait())
    first = served.device.frame_index()
    for _ in range(5):  # the loop runs as it should, nobody asks
        served.clock.turn(served.wait())
    assert served.device.frame_index() == first + 5


def test_a_machine_that_slept_is_not_made_good() -> None:
    served = Served()
    meant_s = served.wait(late_s=3600.0)
    served.clock.turn(meant_s)
    assert served.clock.now_s() == pytest.approx(served.real.now_s(), abs=1e-6)


def test_meant_waits_pass_for_the_device_too() -> None:
    served = Served()
    before_s = served.clock.now_s()
    served.clock.wait_until(before_s + 2.0)
    assert served.clock.now_s() == pytest.approx(before_s + 2.0)
    assert served.clock.held_up_s == 0.0


def test_only_a_device_in_real_time_is_paced() -> None:
    assert isinstance(TcpEmulator(Device(SimulatedBodies(1), SystemClock())).device.clock, PacedClock)
    manual = ManualClock()
    assert TcpEmulator(Device(SimulatedBodies(1), manual)).device.clock is manual


def test_lost_frames_show_as_gaps() -> None:
    """A host that is kept from asking: the counter says how many frames that cost."""
    clock = ManualClock()
    with TcpEmulator(Device(SimulatedBodies(1), clock)) as emulator:
        tracker = NdiTracker(emulator.url.removeprefix("ndi:"), mode="BX", clock=clock)
        read = threading.Event()
        numbers: list[int] = []

        def take(frame: TrackerFrame) -> None:
            numbers.append(frame.number)
            if len(numbers) == 5:
                clock.advance(20 * PERIOD_S)
            if len(numbers) >= 10:
                read.set()

        with Stream(tracker, on_frame=take) as stream:
            assert read.wait(60.0)
        counters = stream.counters
    assert counters.gaps == numbers[-1] - numbers[0] + 1 - len(numbers) or counters.frames > len(numbers)
    assert counters.gaps >= 18


def test_without_pseudo_terminals_the_emulator_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fcntl", None)  # as on Windows: importing it raises
    assert not hasattr(emulator_module, "termios")
    with pytest.raises(DeviceInputError, match="--tcp"):
        PtyEmulator().start()
