"""The public client library against the emulator, unchanged, on a pseudo-terminal and over TCP.

It runs in a process of its own with a time limit: over TCP it waits for ever for a reply that does not come.
"""

from __future__ import annotations

import importlib.util
import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from devices.ndi.bodies import RecordedBodies, SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import Emulator, PtyEmulator, TcpEmulator
from devices.recording import read_recording

if importlib.util.find_spec("ndicapy") is None:
    pytest.skip("the public client library ndicapi is not installed (a test extra)", allow_module_level=True)

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "tracker"
LIMIT_S = 60

CLIENT = r"""
import json, sys
import ndicapy as ndi

kind, place, port, rom = sys.argv[1:5]
said = {}

def step(name, value):
    said[name] = value if isinstance(value, (int, str)) else repr(value)
    return value

if kind == "pty":
    step("probe", ndi.ndiProbe(place))
    device = ndi.ndiOpen(place)
else:
    device = ndi.ndiOpenNetwork(place, int(port))
assert device is not None
step("INIT", ndi.ndiCommand(device, "INIT:"))
if kind == "pty":
    step("COMM", ndi.ndiCOMM(device, ndi.NDI_115200, ndi.NDI_8N1, ndi.NDI_NOHANDSHAKE))
step("VER", ndi.ndiCommand(device, "VER:0"))
ndi.ndiCommand(device, "PHRQ:*********1****")
handle = step("PHRQ", int(ndi.ndiGetPHRQHandle(device)))
step("PVWR", int(ndi.ndiPVWRFromFile(device, handle, rom)))
ndi.ndiCommand(device, "PINIT:%02X" % handle)
step("PINIT", ndi.ndiGetError(device))
ndi.ndiCommand(device, "PENA:%02XD" % handle)
step("PENA", ndi.ndiGetError(device))
step("PHINF", ndi.ndiCommand(device, "PHINF:%02X0005" % handle))
handles = [handle]
ndi.ndiCommand(device, "PHSR:02")
for k in range(ndi.ndiGetPHSRNumberOfHandles(device)):
    handles.append(int(ndi.ndiGetPHSRHandle(device, k)))
for wired in handles[1:]:
    ndi.ndiCommand(device, "PINIT:%02X" % wired)
    ndi.ndiCommand(device, "PENA:%02XD" % wired)
step("TSTART", ndi.ndiCommand(device, "TSTART:"))
poses = []
for k in range(12):
    for mode, ask in (("TX", ndi.ndiTX), ("BX", ndi.ndiBX)):
        try:
            ask(device, ndi.NDI_XFORMS_AND_STATUS | 0x0800)
        except UnicodeDecodeError:
            pass  # the binding returns the bytes of a BX reply as text; by then it has parsed them
        if ndi.ndiGetError(device):
            said["error"] = ndi.ndiErrorString(ndi.ndiGetError(device))
        transform, frame, status = (
            (ndi.ndiGetTXTransform, ndi.ndiGetTXFrame, ndi.ndiGetTXPortStatus)
            if mode == "TX"
            else (ndi.ndiGetBXTransform, ndi.ndiGetBXFrame, ndi.ndiGetBXPortStatus)
        )
        for h in handles:
            key = bytes([h])
            poses.append([mode, h, int(frame(device, key)), int(status(device, key)), transform(device, key)])
step("TSTOP", ndi.ndiCommand(device, "TSTOP:"))
step("error at the end", ndi.ndiGetError(device))
said["poses"] = poses
print(json.dumps(said))
"""


def rom_file(folder: Path) -> Path:
    content = bytearray(752)
    content[:4] = b"NDI\0"
    struct.pack_into("<I", content, 0x1C, 3)
    struct.pack_into("<9f", content, 0x48, 0, 0, 0, 0, 30, 40, 0, 0, 88)
    content[0x244:0x247], content[0x250:0x254] = b"NDI", b"PART"
    struct.pack_into("<H", content, 4, sum(content[6:]) & 0xFFFF)
    path = folder / "tool.rom"
    path.write_bytes(content)
    return path


def run_client(emulator: Emulator, rom: Path) -> dict[str, object]:
    if isinstance(emulator, PtyEmulator):
        arguments = ["pty", emulator.path, "0"]
    else:
        arguments = ["tcp", "127.0.0.1", str(emulator.port)]
    done = subprocess.run(
        [sys.executable, "-c", CLIENT, *arguments, str(rom)],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("line", ["pty", "tcp"])
@pytest.mark.parametrize("moved_by", ["formula", "recording"])
def test_a_whole_session_with_true_poses(line: str, moved_by: str, tmp_path: Path) -> None:
    bodies = SimulatedBodies(3)
    if moved_by == "recording":
        if not DATA.is_dir():
            pytest.skip("the shared tracker recordings are not here")
        bodies = RecordedBodies(read_recording(DATA / "plus" / "SlidingProbeTrackingData.csv"))
    device = Device(bodies)
    with PtyEmulator(device) if line == "pty" else TcpEmulator(device) as emulator:
        said = run_client(emulator, rom_file(tmp_path))
        for name in ("INIT", "TSTART", "TSTOP"):
            assert "OKAY" in said[name]
        assert said.get("probe", 0) == 0
        assert said.get("COMM", "OKAY") == "OKAY"
        assert said["PHRQ"] == 1
        assert said["PVWR"] == said["PINIT"] == said["PENA"] == said["error at the end"] == 0
        assert "PART" in said["PHINF"]
        assert "error" not in said
        assert len(said["poses"]) == 12 * 2 * 4
        for mode, handle, frame, status, transform in said["poses"]:
            truth = device.truth(handle, frame)
            assert status == 0x31
            assert np.abs(np.subtract(transform[4:7], truth.position_mm)).max() <= (0.006 if mode == "TX" else 1e-5)
            assert np.abs(np.subtract(transform[:4], truth.quaternion)).max() <= (1e-4 if mode == "TX" else 1e-5)
    if line == "pty":
        assert device.baud_rate == 115200


def test_tools_that_are_not_seen_are_missing_to_it(tmp_path: Path) -> None:
    class Nothing(SimulatedBodies):
        def pose(self, body: int, frame: int) -> None:
            return None

    with TcpEmulator(Device(Nothing(1))) as emulator:
        said = run_client(emulator, rom_file(tmp_path))
    assert {pose[4] for pose in said["poses"]} == {"MISSING"}


RESET = r"""
import sys
import ndicapy as ndi
device = ndi.ndiOpen(sys.argv[1])
ndi.ndiCommand(device, "INIT:")
print(ndi.ndiRESET(device), ndi.ndiGetError(device))
"""


def test_its_reset_by_a_break_works_on_a_pseudo_terminal() -> None:
    with PtyEmulator(Device(SimulatedBodies(1))) as emulator:
        done = subprocess.run(
            [sys.executable, "-c", RESET, emulator.path], capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "RESET" in done.stdout
        assert done.stdout.split()[-1] == "0"
        assert not emulator.device.initialised
