"""`guidance track` and `guidance tracker-emulator` as a user runs them, in processes of their own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from devices import ToolStatus, TransportError, open_tracker
from devices.recording import read_recording
from devices.rotation import quaternion_from_rotation

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "tracker"
ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60


def command(name: str, *arguments: str) -> list[str]:
    module = {"track": "guidance.track", "tracker-emulator": "guidance.tracker_emulator"}[name]
    function = module.rpartition(".")[2]
    code = f"import sys, typer; from {module} import {function}; app = typer.Typer(); app.command()({function}); app()"
    return [sys.executable, "-c", code, *arguments]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(name, *arguments), capture_output=True, text=True, timeout=LIMIT_S, check=False, env=environment()
    )


@contextmanager
def emulator(*arguments: str) -> Iterator[dict[str, object]]:
    process = subprocess.Popen(
        command("tracker-emulator", *arguments), stdout=subprocess.PIPE, text=True, env=environment()
    )
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(LIMIT_S)
        process.stdout.close()


def plan(folder: Path) -> Path:
    end = np.eye(4)
    end[0, 3] = 30.0
    waypoints = {"needle": [{"time_s": t, "T_tracker_tool": T.tolist()} for t, T in ((0.0, np.eye(4)), (0.5, end))]}
    path = folder / "plan.json"
    path.write_text(json.dumps({"waypoints": waypoints}))
    return path


def test_track_shows_a_table_and_records(tmp_path: Path) -> None:
    recording = tmp_path / "run.jsonl"
    done = run("track", f"sim:{plan(tmp_path)}?rate=40&noise_mm=0.1", "--record", str(recording))
    assert done.returncode == 0, done.stderr
    for word in ("tool", "status", "needle", "ok", "21 frames", "age ms"):
        assert word in done.stdout
    frames = read_recording(recording)
    assert [frame.number for frame in frames] == list(range(21))
    again = run("track", f"replay:{recording}?rate=5")
    assert again.returncode == 0
    assert "needle" in again.stdout


def test_track_says_what_is_wrong(tmp_path: Path) -> None:
    for url, message in [("usb:1", "sim:"), (f"replay:{tmp_path}/none", "none"), ("ndi:/dev/nowhere", "nowhere")]:
        done = run("track", url)
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr


def test_the_emulator_is_tracked_over_a_link(tmp_path: Path) -> None:
    link = tmp_path / "tracker"
    with emulator("--pty", "--link", str(link), "--tools", "4") as said:
        assert said["path"] == str(link)
        assert said["handles"] == ["0A", "0B", "0C", "0D"]
        done = run("track", f"ndi:{link}", "--duration", "1")
        assert done.returncode == 0, done.stderr
        assert "BODY-3" in done.stdout
        with open_tracker(str(said["url"])) as tracker:
            frame = tracker.read(5.0)
    assert frame is not None
    assert len(frame.tools) == 4
    assert not link.is_symlink()


def test_the_emulator_survives_a_disconnection(tmp_path: Path) -> None:
    link = tmp_path / "tracker"
    with emulator("--pty", "--link", str(link), "--fault", "disconnect=20") as said:
        with open_tracker(str(said["url"])) as tracker:
            numbers, lost = [], 0
            while tracker.counters.reconnects < 2:
                try:
                    frame = tracker.read(1.0)
                except TransportError:
                    lost += 1
                    continue
                if frame is not None:
                    numbers.append(frame.number)
        assert lost >= 2
        assert numbers == sorted(set(numbers))


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared tracker recordings are not here")
def test_the_emulator_replays_a_recording_over_tcp() -> None:
    source = DATA / "plus" / "SlidingProbeTrackingData.csv"
    recorded = read_recording(source)
    with emulator("--tcp", "0", "--replay", str(source)) as said:
        assert said["tools"] == {"0A": "NeedleToTracker", "0B": "ProbeToTracker", "0C": "ReferenceToTracker"}
        with open_tracker(f"ndi:tcp://127.0.0.1:{said['port']}") as tracker:
            for _ in range(5):
                frame = tracker.read(5.0)
                assert frame is not None
                truth = recorded[(frame.number - 1) % len(recorded)]
                for name in truth.tools:
                    T = frame.tools[name].T_tracker_tool
                    expected = truth.tools[name].T_tracker_tool
                    assert frame.tools[name].status is ToolStatus.OK
                    np.testing.assert_allclose(T[:3, 3], expected[:3, 3], atol=1e-4)
                    q = quaternion_from_rotation(expected[:3, :3])
                    np.testing.assert_allclose(np.abs(quaternion_from_rotation(T[:3, :3]) @ q), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--pty or --tcp"),
        (["--pty", "--tcp", "0"], "--pty or --tcp"),
        (["--pty", "--fault", "flood"], "flood"),
        (["--tcp", "0", "--replay", "nowhere.csv"], "nowhere.csv"),
    ],
)
def test_the_emulator_says_what_is_wrong(arguments: list[str], message: str) -> None:
    done = run("tracker-emulator", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
