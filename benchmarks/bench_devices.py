"""Frames lost, latency and jitter of every path from a tracker to a callback.

    python benchmarks/bench_devices.py [--frames 600] [--rate 60] [--tools 6] [--only "serial BX"]
    python benchmarks/bench_devices.py --url "ndi:/tmp/tracker?mode=BX" --frames 10000

Latency: device time to callback, from the moment at which the device's frame became current to the moment at which
`Stream` calls back with it, on the machine's monotonic clock; emulator or sender run in a process of their own. A
polled tracker (NDI) cannot learn of a frame before it asks, so its figure holds the wait until the next question.
Lost: frames that the device numbered and that never came; over OpenIGTLink, messages by the number that each pose
carries. "Held up": what the emulator's process was kept from running, ms in all; its frames came late by that.
With --url, any tracker: no latency then, its frames' birth is unknown.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection

import numpy as np

from devices import IgtlServer, IgtlTracker, NdiTracker, SimulatedTracker, Stream, ToolPose, ToolStatus, open_tracker
from devices.frame import TrackerFrame
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import PtyEmulator, TcpEmulator
from devices.ndi.pace import PacedClock
from devices.tracker import Tracker

#: the first second is set aside: clock lines settle, caches fill
WARM = 60


@dataclass
class Row:
    """What one path did."""

    frames: int
    lost: int
    crc_errors: int
    timeouts: int
    scheduling: str
    interval_ms: list[float]
    latency_ms: list[float]
    held_up_ms: float = 0.0


def serve_ndi(pipe: Connection, line: str, rate_hz: float, tools: int) -> None:
    device = Device(SimulatedBodies(tools, rate_hz), rate_hz=rate_hz)
    with PtyEmulator(device) if line == "serial" else TcpEmulator(device) as emulator:
        pipe.send(emulator.url)
        pipe.recv()
        held_up_s = device.clock.held_up_s if isinstance(device.clock, PacedClock) else 0.0
        # monotonic clocks are one clock on one machine
        pipe.send((device._started_s, device.first_frame, held_up_s))


def serve_igtl(pipe: Connection, rate_hz: float, tools: int) -> None:
    """Send frames whose number is the x of every pose, and remember when."""
    names = [f"Tool{tool}ToReference" for tool in range(tools)]
    sent: list[float] = []
    with IgtlServer(0) as server:
        pipe.send(server.port)
        while server.clients == 0:
            time.sleep(0.01)
        start_s = time.monotonic()
        while not pipe.poll():
            time.sleep(max(0.0, start_s + len(sent) / rate_hz - time.monotonic()))
            T = np.eye(4)
            T[0, 3] = len(sent)
            now_s = time.monotonic()
            server.send(TrackerFrame(len(sent), now_s, now_s, {n: ToolPose(ToolStatus.OK, T) for n in names}))
            sent.append(now_s)
        pipe.send(sent)


def measure(tracker: Tracker, frames: int) -> tuple[list[tuple[TrackerFrame, float]], Row]:
    """Every frame with the moment of its callback, s; and the row, its latencies still empty."""
    got: list[tuple[TrackerFrame, float]] = []
    enough = threading.Event()

    def take(frame: TrackerFrame) -> None:
        got.append((frame, time.monotonic()))
        if len(got) >= frames + WARM:
            enough.set()

    with Stream(tracker, on_frame=take) as stream:
        if not enough.wait(30.0 + 3.0 * frames / 20.0):
            raise RuntimeError(f"only {len(got)} of {frames} frames came")
        c = stream.counters
    moments = [moment for _, moment in got[WARM : frames + WARM]]
    interval = np.percentile(1e3 * np.diff(moments), [50, 99]).tolist()
    return got, Row(c.frames, c.gaps, c.crc_errors, c.timeouts, stream.scheduling, interval, [])


def latencies_ms(got: list[tuple[TrackerFrame, float]], born: Callable[[TrackerFrame], float]) -> list[float]:
    """Latency, ms: p50, p99, worst."""
    values = [1e3 * (moment - born(frame)) for frame, moment in got[WARM:]]
    return [float(value) for value in np.percentile(values, [50, 99, 100])]


def ndi_path(line: str, mode: str, frames: int, rate_hz: float, tools: int) -> Row:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=serve_ndi, args=(theirs, line, rate_hz, tools), daemon=True)
    process.start()
    tracker = NdiTracker(ours.recv().removeprefix("ndi:"), mode=mode)
    got, row = measure(tracker, frames)
    ours.send("end")
    started_s, first, held_up_s = ours.recv()
    process.join()
    row.latency_ms = latencies_ms(got, lambda frame: started_s + (frame.number - first) / rate_hz)
    row.held_up_ms = 1e3 * held_up_s
    return row


def igtl_path(frames: int, rate_hz: float, tools: int) -> Row:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=serve_igtl, args=(theirs, rate_hz, tools), daemon=True)
    process.start()
    got, row = measure(IgtlTracker("127.0.0.1", ours.recv()), frames)
    ours.send("end")
    sent = ours.recv()
    process.join()
    # the number that a pose carries tells which message it is; every tool must show every number between first and last
    numbers = [sorted(int(pose.T_tracker_tool[0, 3]) for pose in frame.tools.values()) for frame, _ in got]
    every = [number for group in numbers for number in group]
    first, last = every[0] + 1, every[-1] - 1
    row.lost = sum(tools - every.count(number) for number in range(first, last + 1))
    row.latency_ms = latencies_ms(got, lambda frame: sent[int(next(iter(frame.tools.values())).T_tracker_tool[0, 3])])
    return row


def simulated_path(frames: int, rate_hz: float, tools: int) -> Row:
    still = [(0.0, np.eye(4)), (3600.0, np.eye(4))]
    got, row = measure(SimulatedTracker({f"tool{k}": still for k in range(tools)}, rate_hz=rate_hz), frames)
    row.latency_ms = latencies_ms(got, lambda frame: frame.time_s)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--tools", type=int, default=6)
    parser.add_argument("--only", help="one path, by its name in the table")
    parser.add_argument("--url", help="any tracker, as for `guidance track`")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    n, rate, tools = options.frames, options.rate, options.tools
    paths: dict[str, Callable[[], Row]] = {
        "serial TX": lambda: ndi_path("serial", "TX", n, rate, tools),
        "serial BX": lambda: ndi_path("serial", "BX", n, rate, tools),
        "serial BX2": lambda: ndi_path("serial", "BX2", n, rate, tools),
        "TCP BX": lambda: ndi_path("tcp", "BX", n, rate, tools),
        "TCP BX2": lambda: ndi_path("tcp", "BX2", n, rate, tools),
        "OpenIGTLink": lambda: igtl_path(n, rate, tools),
        "OpenIGTLink, 30 tools": lambda: igtl_path(n, rate, 30),
        "simulated": lambda: simulated_path(n, rate, tools),
    }
    if options.url:
        paths = {options.url: lambda: measure(open_tracker(options.url), n)[1]}
    elif options.only:
        paths = {options.only: paths[options.only]}
    rows = {}
    if not options.json:
        about = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
        print(f"{n} frames at {rate:g} Hz, {tools} tools; {about}; times in ms")
        print(f"{'':24}{'— latency —':^24}  {'— interval —':^16}{'':8}{'':6}{'crc':>7}{'time':>6}{'held':>6}")
        heads = f"{'path':24}{'p50':>8}{'p99':>8}{'worst':>8}  {'p50':>8}{'p99':>8}{'frames':>8}{'lost':>6}"
        print(f"{heads}{'errors':>7}{'outs':>6}{'up':>6}  reader thread")
    for name, run in paths.items():
        row = run()
        rows[name] = asdict(row)
        if not options.json:
            latency = row.latency_ms or [math.nan] * 3
            print(f"{name:24}" + "".join(f"{value:8.2f}" for value in latency), end="  ")
            print("".join(f"{value:8.2f}" for value in row.interval_ms), end="")
            print(f"{row.frames:8d}{row.lost:6d}{row.crc_errors:7d}{row.timeouts:6d}{row.held_up_ms:6.0f}", end="  ")
            print(row.scheduling, flush=True)
    if options.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
