"""A peer that sends NaN: from its bytes on a real socket to what the monitor says."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest

from devices import IgtlTracker, Stream, ToolStatus
from guidance.live import watch
from guidance.monitor import Monitor
from guidance.states import Report, State
from tests.guidance.balls_scene import RIG, balls_scene, tip_pose

# 140 mm from the organ's centre, pointing at it: clear of everything
AWAY = RIG.tool_pose(tip_pose(np.array([140.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])))


def crc64(body: bytes) -> int:
    """CRC-64/ECMA-182, bit by bit, as the OpenIGTLink standard prescribes."""
    value = 0
    for byte in body:
        value ^= byte << 56
        for _ in range(8):
            value = ((value << 1) ^ (0x42F0E1EBA9EA3693 if value >> 63 else 0)) & 0xFFFFFFFFFFFFFFFF
    return value


def transform(name: str, time_s: float, T: np.ndarray) -> bytes:
    """A TRANSFORM message by the standard's own table: header of 58 bytes, 12 floats column by column, big-endian."""
    body = b"".join(struct.pack(">f", T[row, column]) for column in range(4) for row in range(3))
    seconds = int(time_s)
    fraction = int((time_s - seconds) * 2**32)
    head = struct.pack(">H", 1) + b"TRANSFORM".ljust(12, b"\0") + name.encode().ljust(20, b"\0")
    return head + struct.pack(">IIQQ", seconds, fraction, len(body), crc64(body)) + body


def spoilt(which: str) -> np.ndarray:
    T = AWAY.copy()
    places = {"rotation": (0, 0), "translation": (1, 3), "infinity": (2, 3)}
    T[places[which]] = np.inf if which == "infinity" else np.nan
    return T


@pytest.mark.parametrize("which", ["rotation", "translation", "infinity", "all"])
@pytest.mark.parametrize("through", ["tracker", "stream"])
def test_a_nan_from_the_wire_makes_everything_unknown(which: str, through: str) -> None:
    bad = np.full((4, 4), np.nan) if which == "all" else spoilt(which)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        tracker = IgtlTracker("127.0.0.1", listener.getsockname()[1])
        monitor = Monitor(
            balls_scene(), tool=RIG.tool, T_patient_tracker=RIG.T_patient_tracker, T_tool_tip=RIG.T_tool_tip
        )
        reports = watch(Stream(tracker) if through == "stream" else tracker, monitor, timeout_s=0.02)
        listener.settimeout(20.0)
        assert next(reports).state is State.UNKNOWN  # connected, and nothing has come
        connection, _ = listener.accept()
        with connection:
            connection.sendall(transform(RIG.tool, time.time(), AWAY))
            assert until(reports, State.CLEAR).state is State.CLEAR
            # together with a good pose of another tool: that one must not vouch for the needle
            moment_s = time.time()
            message = transform(RIG.tool, moment_s, bad)
            connection.sendall(transform("Stylus", moment_s, AWAY)[:30])
            connection.sendall(transform("Stylus", moment_s, AWAY)[30:] + message)
            # not for want of anything: for what came
            report = until(reports, State.UNKNOWN, f"'{RIG.tool}' is invalid")
            assert {s.state for s in report.structures} == {State.UNKNOWN}
            assert all(np.isnan(s.distance_mm) for s in report.structures)
            connection.sendall(transform(RIG.tool, time.time(), AWAY))
            assert until(reports, State.CLEAR).state is State.CLEAR
        reports.close()
    assert tracker.counters.crc_errors == tracker.counters.malformed == 0


def until(reports: Iterator[Report], state: State, reason: str = "") -> Report:
    """The first report of that state, for that reason, among the next thousand."""
    for _, report in zip(range(1000), reports, strict=False):
        if report.state is state and reason in report.structures[0].reason:
            return report
    raise AssertionError(f"no report says {state} because of {reason!r}")


def test_the_pose_itself_is_marked_invalid() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        IgtlTracker("127.0.0.1", listener.getsockname()[1]) as tracker,
        listener.accept()[0] as connection,
    ):
        connection.sendall(transform("Needle", 1000.0, spoilt("rotation")))
        frame = tracker.read(20.0)
    assert frame.tools["Needle"].status is ToolStatus.INVALID
    assert frame.tools["Needle"].T_tracker_tool is None
