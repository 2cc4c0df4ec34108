"""Latency and jitter of every path from a tracker to a callback, p50 and p99.

    python benchmarks/bench_devices.py [--frames 600] [--rate 60] [--tools 6]

Device time to callback: the moment at which the device's frame became current, to the moment at which `Stream` hands
the frame to its callback, on the machine's monotonic clock; emulator or sender run in a process of their own. A polled
tracker (NDI) cannot learn of a frame before it asks, so its figure holds the wait until the next question.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

from devices import IgtlServer, IgtlTracker, NdiTracker, SimulatedTracker, Stream, Tracker, TrackerFrame
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import PtyEmulator, TcpEmulator

Born = Callable[[TrackerFrame], float]


def serve_ndi(pipe: Connection, line: str, rate_hz: float, tools: int) -> None:
    device = Device(SimulatedBodies(tools, rate_hz), rate_hz=rate_hz)
    with PtyEmulator(device) if line == "serial" else TcpEmulator(device) as emulator:
        pipe.send(emulator.url)
        while pipe.recv() != "end":
            # monotonic clocks are one clock on one machine
            pipe.send((device._started_s, device.first_frame))


def serve_igtl(pipe: Connection, rate_hz: float, tools: int) -> None:
    with IgtlServer(0) as server:
        pipe.send(server.port)
        while server.clients == 0:
            time.sleep(0.01)
        start_s = time.monotonic()
        names = [f"Tool{tool}ToReference" for tool in range(tools)]
        source = SimulatedTracker({name: [(0.0, np.eye(4)), (3600.0, np.eye(4))] for name in names}, rate_hz=rate_hz)
        for frame in source.frames():
            time.sleep(max(0.0, start_s + frame.number / rate_hz - time.monotonic()))
            now_s = time.monotonic()
            server.send(TrackerFrame(frame.number, now_s, now_s, frame.tools))
            if pipe.poll():
                return


def measure(tracker: Tracker, born: Born, frames: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Latencies, s; intervals between callbacks, s; frames lost."""
    latencies: list[float] = []
    moments: list[float] = []
    enough = threading.Event()

    def take(frame: TrackerFrame) -> None:
        now_s = time.monotonic()
        moments.append(now_s)
        latencies.append(now_s - born(frame))
        if len(latencies) >= frames + 60:
            enough.set()

    with Stream(tracker, on_frame=take) as stream:
        if not enough.wait(30.0 + 3.0 * frames / 20.0):
            raise RuntimeError(f"only {len(latencies)} of {frames} frames came")
        gaps = stream.counters.gaps
    # the first second is set aside: clock lines and kernels warm up
    return np.array(latencies[60 : frames + 60]), np.diff(moments[60 : frames + 60]), gaps


def ndi_path(line: str, mode: str, frames: int, rate_hz: float, tools: int) -> tuple[np.ndarray, np.ndarray, int]:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=serve_ndi, args=(theirs, line, rate_hz, tools), daemon=True)
    process.start()
    tracker = NdiTracker(ours.recv().removeprefix("ndi:"), mode=mode)
    origin: list[tuple[float, int]] = []

    def born(frame: TrackerFrame) -> float:
        if not origin:
            ours.send("when")
            origin.append(ours.recv())
        started_s, first = origin[0]
        return started_s + (frame.number - first) / rate_hz

    result = measure(tracker, born, frames)
    ours.send("end")
    process.join()
    return result


def igtl_path(frames: int, rate_hz: float, tools: int) -> tuple[np.ndarray, np.ndarray, int]:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=serve_igtl, args=(theirs, rate_hz, tools), daemon=True)
    process.start()
    tracker = IgtlTracker("127.0.0.1", ours.recv())
    offset_s = time.time() - time.monotonic()

    def born(frame: TrackerFrame) -> float:
        return tracker.last_stamp_s - offset_s

    result = measure(tracker, born, frames)
    ours.send("end")
    process.join()
    return result


def simulated_path(frames: int, rate_hz: float, tools: int) -> tuple[np.ndarray, np.ndarray, int]:
    still = [(0.0, np.eye(4)), (3600.0, np.eye(4))]
    tracker = SimulatedTracker({f"tool{k}": still for k in range(tools)}, rate_hz=rate_hz)
    return measure(tracker, lambda frame: frame.time_s, frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--tools", type=int, default=6)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    n, rate, tools = options.frames, options.rate, options.tools
    paths: dict[str, Callable[[], tuple[np.ndarray, np.ndarray, int]]] = {
        "serial TX": lambda: ndi_path("serial", "TX", n, rate, tools),
        "serial BX": lambda: ndi_path("serial", "BX", n, rate, tools),
        "serial BX2": lambda: ndi_path("serial", "BX2", n, rate, tools),
        "TCP BX": lambda: ndi_path("tcp", "BX", n, rate, tools),
        "TCP BX2": lambda: ndi_path("tcp", "BX2", n, rate, tools),
        "OpenIGTLink": lambda: igtl_path(n, rate, tools),
        "OpenIGTLink, 30 tools": lambda: igtl_path(n, rate, 30),
        "simulated": lambda: simulated_path(n, rate, tools),
    }
    rows = {}
    if not options.json:
        print(f"{n} frames at {rate:g} Hz, {tools} tools; device time to callback and interval between callbacks, ms")
        print(f"{'path':24}{'p50':>8}{'p99':>8}{'worst':>8}   {'interval p50':>12}{'p99':>8}{'lost':>6}")
    for name, run in paths.items():
        latency, interval, lost = run()
        values = [*np.percentile(1e3 * latency, [50, 99, 100]), *np.percentile(1e3 * interval, [50, 99])]
        rows[name] = {"latency_ms": values[:3], "interval_ms": values[3:], "lost": lost}
        if not options.json:
            p50, p99, worst, i50, i99 = values
            print(f"{name:24}{p50:8.2f}{p99:8.2f}{worst:8.2f}   {i50:12.2f}{i99:8.2f}{lost:6d}", flush=True)
    if options.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
