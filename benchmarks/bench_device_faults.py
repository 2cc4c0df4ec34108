"""How soon a lost tracker is reported, and how soon poses come again, over a pseudo-terminal and TCP.

    python benchmarks/bench_device_faults.py [--times 3]

The emulator's line is cut (and is back 0.3 s later, under another name behind its link), or the device is silent for
1.2 s. Times from the moment of the fault; 60 Hz, 6 tools. Every pose that came is compared with the emulator's truth.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from devices import NdiTracker, ToolStatus, TransportError
from devices.frame import TrackerFrame
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import Emulator, PtyEmulator, TcpEmulator
from devices.ndi.faults import Faults
from devices.rotation import pose_from_quaternion


def farthest_mm(emulator: Emulator, frame: TrackerFrame) -> float:
    """Largest error of the positions that are OK, mm."""
    worst = 0.0
    for k, pose in enumerate(frame.tools.values()):
        if pose.status is ToolStatus.OK and pose.T_tracker_tool is not None:
            truth = emulator.device.bodies.pose(k, frame.number - emulator.device.first_frame)
            assert truth is not None
            T = pose_from_quaternion(truth.quaternion, truth.position_mm)
            worst = max(worst, float(np.abs(pose.T_tracker_tool - T)[:3, 3].max()))
    return worst


def one(kind: str, fault: str, folder: Path) -> tuple[float, float, float]:
    """Seconds to the report and to the next frame; largest error before the fault, mm."""
    device, faults = Device(SimulatedBodies(6)), Faults(silence_s=1.2, period=10**9)
    made = PtyEmulator(device, faults, folder / "tracker") if kind == "pty" else TcpEmulator(device, faults)
    with made as emulator, NdiTracker(emulator.url.removeprefix("ndi:"), mode="BX") as tracker:
        error = 0.0
        for _ in range(60):
            frame = tracker.read(5.0)
            assert frame is not None
            error = max(error, farthest_mm(emulator, frame))
        faults.once(fault)
        start_s = time.monotonic()
        reported_s = 0.0
        while True:
            try:
                frame = tracker.read(0.1)
            except TransportError:
                reported_s = reported_s or time.monotonic() - start_s
                continue
            if reported_s and frame is not None:
                return reported_s, time.monotonic() - start_s, error


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=3)
    times = parser.parse_args().times
    print(f"{'line':6}{'fault':12}{'reported after, s':>20}{'poses again after, s':>22}{'worst error, mm':>18}")
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("pty", "tcp"):
            for fault in ("disconnect", "silence"):
                runs = [one(kind, fault, Path(folder)) for _ in range(times)]
                reported, again, error = (max(column) for column in zip(*runs, strict=True))
                print(f"{kind:6}{fault:12}{reported:20.3f}{again:22.3f}{error:18.6f}", flush=True)


if __name__ == "__main__":
    main()
