"""OpenIGTLink: the codec against noise and an independent peer; every message to every client, in order."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import random
import socket
import struct
import subprocess
import sys
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices import (
    DeviceInputError,
    IgtlServer,
    IgtlTracker,
    ManualClock,
    ProtocolError,
    ToolPose,
    ToolStatus,
    TrackerFrame,
    TransportError,
    open_tracker,
)
from devices.igtl_messages import (
    Message,
    MessageReader,
    Status,
    crc64,
    decode_poses,
    decode_status,
    encode,
    encode_position,
    encode_status,
    encode_transform,
    encode_transforms,
)
from devices.rotation import pose_from_quaternion

T = pose_from_quaternion([0.8, 0.1, -0.2, 0.5], [101.5, -20.25, 903.125])
needs_pyigtl = pytest.mark.skipif(
    importlib.util.find_spec("pyigtl") is None, reason="the independent peer pyigtl is not installed (a test extra)"
)


def crc64_bit_by_bit(message: bytes) -> int:
    value = 0
    for byte in message:
        value ^= byte << 56
        for _ in range(8):
            value = ((value << 1) ^ (0x42F0E1EBA9EA3693 if value >> 63 else 0)) & (1 << 64) - 1
    return value


@given(st.binary(max_size=100))
def test_the_checksum_is_the_definition(body: bytes) -> None:
    assert crc64(body) == crc64_bit_by_bit(body)


@pytest.mark.parametrize("size", [4095, 4096, 4097, 4103, 4104, 9001])
def test_the_checksum_of_long_bodies(size: int) -> None:
    body = random.Random(size).randbytes(size)
    assert crc64(body) == crc64_bit_by_bit(body)


def test_messages_come_back_however_they_are_cut() -> None:
    name = "StylusTipToReference"
    assert len(name) == 20  # fills the field, no terminator
    stream = encode_transform(name, 1234567890.25, T)
    stream += encode_transforms("all", 5.5, {"a": T, "b": np.eye(4)})
    stream += encode_status("drill", 6.0, Status(13, -2, "MISSING", "not seen"))
    stream += encode("POSITION", "probe", 7.0, struct.pack(">7f", 1, 2, 3, 0.1, -0.5, 0.5, 0.7))
    for step in (1, 7, 58, 59, 1000):
        reader, got = MessageReader(), []
        for start in range(0, len(stream), step):
            got += reader.feed(stream[start : start + step])
        transform, many, status, position = got
        assert (transform.kind, transform.name, transform.time_s) == ("TRANSFORM", name, 1234567890.25)
        np.testing.assert_allclose(decode_poses(transform)[name], T, atol=1e-7 * 1000)
        assert list(decode_poses(many)) == ["a", "b"]
        np.testing.assert_array_equal(decode_poses(many)["b"], np.eye(4))
        assert decode_status(status.content) == Status(13, -2, "MISSING", "not seen")
        expected = pose_from_quaternion([0.7, 0.1, -0.5, 0.5], [1, 2, 3])
        np.testing.assert_allclose(decode_poses(position)["probe"], expected, atol=1e-6)


def test_a_position_without_orientation_is_no_pose() -> None:
    message = Message("POSITION", "p", 0.0, struct.pack(">3f", 1, 2, 3))
    matrix = decode_poses(message)["p"]
    assert np.isnan(matrix[:3, :3]).all()
    assert matrix[:3, 3].tolist() == [1, 2, 3]
    short = Message("POSITION", "p", 0.0, struct.pack(">6f", 1, 2, 3, 0.6, 0.0, 0.0))
    np.testing.assert_allclose(decode_poses(short)["p"], pose_from_quaternion([0.8, 0.6, 0, 0], [1, 2, 3]), atol=1e-6)


def test_version_two_with_metadata_is_read() -> None:
    key, value = b"StylusTransformStatus", b"INVALID"
    index = struct.pack(">HHHI", 1, len(key), 3, len(value))
    content = struct.pack(">12f", *T[:3].T.ravel())
    body = struct.pack(">HHII", 12, len(index), len(key + value), 9) + content + index + key + value
    header = struct.pack(">H12s20sIIQQ", 2, b"TRANSFORM", b"Stylus", 3, 1 << 31, len(body), crc64(body))
    (message,) = MessageReader().feed(header + body)
    assert message.metadata == {"StylusTransformStatus": "INVALID"}
    assert message.time_s == 3.5
    np.testing.assert_allclose(decode_poses(message)["Stylus"], T, atol=1e-4)


def by_hand(version: int, kind: bytes, name: bytes, stamp_s: int, content: bytes, extended: int = 12) -> bytes:
    """A message as the standard lays it out; from version 2 on with an extended header of so many bytes."""
    body = content
    if version >= 2:
        body = struct.pack(">HHII", extended, 0, 0, stamp_s) + bytes(extended - 12) + content
    return struct.pack(">H12s20sIIQQ", version, kind, name, stamp_s, 0, len(body), crc64_bit_by_bit(body)) + body


def test_peers_of_every_manner_on_a_real_socket() -> None:
    """Headers of versions 1 to 3, big images and unknown kinds between, a wrong checksum, joined and cut messages."""

    def transform(version: int, k: int, extended: int = 12) -> bytes:
        moved_by = pose_from_quaternion([1, 0, 0, 0], [k, 0, 0])
        content = struct.pack(">12f", *moved_by[:3].T.ravel())
        return by_hand(version, b"TRANSFORM", b"Tool", 1000 + k, content, extended)

    image_header = struct.pack(">H12s20sIIQQ", 2, b"IMAGE", b"Ultrasound", 5, 0, 3 << 20, 0)  # its checksum is not kept
    spoilt = bytearray(transform(1, 3))
    spoilt[-1] ^= 1
    last = transform(3, 8)
    segments = [
        transform(1, 0) + transform(2, 1),
        transform(3, 2, extended=24) + bytes(spoilt),
        image_header + bytes(3 << 20) + transform(1, 4),
        by_hand(1, b"NEWKIND", b"Tool", 7, b"anything at all") + transform(2, 5),
        by_hand(1, b"TRANSFORM", b"Tool", 7, b"too short") + transform(1, 6),
        by_hand(2, b"STRING", b"Tool", 7, b"") + by_hand(1, b"GET_TRANS", b"", 7, b"") + transform(3, 7),
        last[:20],
        last[20:61],
        last[61:],
    ]
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        IgtlTracker("127.0.0.1", listener.getsockname()[1]) as tracker,
        listener.accept()[0] as connection,
    ):
        sender = threading.Thread(target=lambda: [connection.sendall(segment) for segment in segments])
        sender.start()
        frames = collect(tracker, 8)
        sender.join()
    assert [frame.tools["Tool"].T_tracker_tool[0, 3] for frame in frames] == [0, 1, 2, 4, 5, 6, 7, 8]
    assert tracker.counters.crc_errors == 1
    assert tracker.counters.malformed == 1
    assert tracker.other_messages == 4


def test_what_is_no_pose_is_not_sent() -> None:
    for bad in (np.full((4, 4), np.nan), 2.0 * np.eye(4), np.zeros((4, 4))):
        with pytest.raises(DeviceInputError, match="no rigid"):
            encode_transform("tool", 0.0, bad)
    with pytest.raises(DeviceInputError, match="20 bytes"):
        encode_transform("StylusTipToReferenceX", 0.0, T)


def test_noise_raises_nothing_but_protocol_errors() -> None:
    generator = random.Random(7)
    sources = [
        encode_transform("Tool", 1e9, T),
        encode_transforms("all", 5.5, {"a": T, "b": np.eye(4)}),
        encode_status("drill", 6.0, Status(13, 0, "MISSING", "")),
    ]
    for _ in range(20_000):
        data = bytearray(generator.choice(sources))
        for _ in range(generator.randint(0, 3)):
            data[generator.randrange(len(data))] = generator.randrange(256)
        if generator.random() < 0.3:
            body = data[58:]
            data[50:58] = struct.pack(">Q", crc64(bytes(body)))  # damage that passes the checksum
        if generator.random() < 0.2:
            data = bytearray(generator.randbytes(generator.randint(0, 150)))
        for message in MessageReader().feed(bytes(data)):
            if isinstance(message, ProtocolError):
                continue
            for decode in (decode_poses, lambda m: decode_status(m.content)):
                with contextlib.suppress(ProtocolError):
                    decode(message)


def connected(server: IgtlServer, count: int) -> list[IgtlTracker]:
    trackers = [IgtlTracker("127.0.0.1", server.port) for _ in range(count)]
    for tracker in trackers:
        tracker.start()
    while server.clients < count:
        trackers[0].read(0.01)
    return trackers


def frame(number: int, time_s: float, tools: dict[str, ToolPose]) -> TrackerFrame:
    return TrackerFrame(number, time_s, time_s, tools)


def moved(x: float) -> ToolPose:
    matrix = T.copy()
    matrix[0, 3] = x
    return ToolPose(ToolStatus.OK, matrix)


def collect(tracker: IgtlTracker, count: int) -> list[TrackerFrame]:
    frames = []
    for _ in range(1000):
        received = tracker.read(5.0)
        assert received is not None, f"only {len(frames)} of {count} frames came"
        frames.append(received)
        if len(frames) == count:
            break
    return frames


def test_two_clients_get_every_message_of_thirty_tools_in_order() -> None:
    with IgtlServer(0) as server:
        trackers = connected(server, 2)
        start_s = server.clock.now_s()
        for k in range(150):
            tools = {f"Tool{tool:02d}ToReference": moved(float(k)) for tool in range(30)}
            server.send(frame(k, start_s + k / 60.0, tools))
        for tracker in trackers:
            frames = collect(tracker, 150)
            tracker.stop()
            assert tracker.messages == 150 * 30
            assert tracker.counters.crc_errors == tracker.counters.malformed == 0
            assert [f.number for f in frames] == list(range(150))
            for k, received in enumerate(frames):
                assert len(received.tools) == 30
                assert {pose.T_tracker_tool[0, 3] for pose in received.tools.values()} == {float(k)}
    assert server.dropped == 0


def test_header_timestamps_give_the_times() -> None:
    with IgtlServer(0) as server:
        (tracker,) = connected(server, 1)
        start_s = server.clock.now_s()
        for k in range(60):
            server.send(frame(k, start_s + 0.05 * k, {"tool": moved(float(k))}))
        frames = collect(tracker, 60)
        tracker.stop()
    # sent all at once: only the stamps can tell that they are 50 ms apart (arrival bounds what is believed)
    assert tracker._clock_line.fit is not None
    assert all(f.time_s <= f.arrival_s for f in frames)


def test_a_repeated_stamp_is_old_data() -> None:
    with IgtlServer(0) as server:
        (tracker,) = connected(server, 1)
        now_s = server.clock.now_s()
        for step, x in ((0.0, 1.0), (0.1, 2.0), (0.1, 3.0), (0.2, 4.0)):
            server.send(frame(0, now_s + step, {"tool": moved(x)}))
        numbers = [f.number for f in collect(tracker, 4)]
        tracker.stop()
    assert numbers == [0, 1, 1, 2]
    assert tracker.counters.repeated == 1


def test_tools_of_one_moment_become_one_frame() -> None:
    """Single messages with one stamp: the first group waits for the next, later ones are known and whole at once."""
    with IgtlServer(0) as server:
        (tracker,) = connected(server, 1)
        now_s = server.clock.unix_s(server.clock.now_s())
        for k in range(6):
            for name in ("a", "b", "c"):
                server.send_bytes(encode_transform(name, now_s + 0.02 * k, T))
        frames = [tracker.read(5.0) for _ in range(6)]
        tracker.stop()
    assert [sorted(f.tools) for f in frames] == [["a", "b", "c"]] * 6


def test_a_reset_connection_is_reported_and_made_again() -> None:
    with IgtlServer(0) as server:
        (tracker,) = connected(server, 1)
        port = server.port
    with pytest.raises(TransportError, match="lost"):
        tracker.read(5.0)
    with pytest.raises(TransportError, match="no connection"):
        tracker.read(5.0)
    with IgtlServer(port) as server:
        server_frame = frame(0, server.clock.now_s(), {"tool": moved(1.0)})
        while server.clients == 0:
            assert tracker.read(0.01) is None
        server.send(server_frame)
        assert tracker.read(5.0).tools["tool"].status is ToolStatus.OK
        assert tracker.counters.reconnects == 1
        tracker.stop()


def test_a_stranger_on_the_line_is_given_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        tracker = open_tracker(f"igtl://127.0.0.1:{listener.getsockname()[1]}")
        tracker.start()
        peer, _ = listener.accept()
        with peer:
            peer.sendall(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            with pytest.raises(TransportError, match="not OpenIGTLink"):
                tracker.read(5.0)
        tracker.stop()


def test_a_client_that_does_not_read_holds_nobody_up() -> None:
    with IgtlServer(0) as server:
        server._MOST_WAITING = 1 << 16
        (tracker,) = connected(server, 1)
        with socket.create_connection(("127.0.0.1", server.port)) as deaf:
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            while server.clients < 2:
                tracker.read(0.01)
            filler = encode("STRING", "x", 0.0, bytes(100_000))
            for _ in range(400):
                server.send_bytes(filler)
                while tracker.other_messages < _ + 1:
                    tracker.read(0.02)
                if server.clients == 1:
                    break
            assert server.dropped == 1
            server.send(frame(0, server.clock.now_s(), {"tool": moved(1.0)}))
            assert tracker.read(5.0).tools["tool"].status is ToolStatus.OK
        tracker.stop()


def test_a_client_that_asks_for_tracking_data_gets_them() -> None:
    """One TDATA message a frame, no more often than asked for, beside a client that gets TRANSFORM as before."""
    with IgtlServer(0) as server, socket.create_connection(("127.0.0.1", server.port)) as client:
        tracker = IgtlTracker("127.0.0.1", server.port)
        tracker.start()
        while server.clients < 2:
            tracker.read(0.01)
        client.settimeout(10.0)
        reader, got = MessageReader(), []

        def received(count: int) -> list[Message]:
            while len(got) < count:
                got.extend(reader.feed(client.recv(4096)))
            return got

        client.sendall(encode("STT_TDATA", "Tracker", 0.0, b"too short"))
        client.sendall(encode("STT_TDATA", "Tracker", 0.0, struct.pack(">I32s", 40, b"LPS")))
        assert [(m.kind, m.content) for m in received(2)] == [("RTS_TDATA", b"\1"), ("RTS_TDATA", b"\0")]
        now_s = server.clock.now_s()
        tools = {"a": moved(1.0), "b": moved(2.0), "lost": ToolPose(ToolStatus.MISSING, None)}
        for k in range(5):
            server.send(frame(k, now_s + 0.02 * k, tools))
        kinds = [(m.kind, m.name) for m in received(8)[2:]]
        assert kinds == [("TDATA", "Tracker"), ("STATUS", "lost")] * 3
        poses = decode_poses(got[2])
        assert [poses[name][0, 3] for name in ("a", "b")] == [1.0, 2.0]
        client.sendall(encode("STP_TDATA", "Tracker", 0.0, b""))
        assert received(9)[8].content == b"\0"
        server.send(frame(5, now_s + 1.0, {"a": moved(3.0)}))
        assert received(10)[9].kind == "TRANSFORM"
        assert collect(tracker, 6)[-1].tools["a"].T_tracker_tool[0, 3] == 3.0
        tracker.stop()


def test_simulated_time_is_sent_as_it_is() -> None:
    with IgtlServer(0, clock=ManualClock()) as server:
        (tracker,) = connected(server, 1)
        server.send(frame(0, 12.5, {"tool": moved(1.0)}))
        assert tracker.read(5.0) is not None
        with pytest.raises(DeviceInputError, match="time"):
            server.send(frame(0, -1.0, {"tool": moved(1.0)}))
        tracker.stop()
    with pytest.raises(DeviceInputError, match="65535"):
        IgtlServer(70_000)
    with IgtlServer(0) as server, pytest.raises(TransportError, match="cannot listen"):
        IgtlServer(server.port).start()
    for url in ("igtl://host:port", "igtl://host:0"):
        with pytest.raises(DeviceInputError):
            open_tracker(url)


PEER_CLIENT = r"""
import json, sys, pyigtl
client = pyigtl.OpenIGTLinkClient("127.0.0.1", int(sys.argv[1]))
print("ready", flush=True)
got = []
while len(got) < 5:
    message = client.wait_for_message("StylusTipToReference", timeout=20)
    assert message is not None
    got.append([message.matrix.tolist(), message.timestamp])
    print(json.dumps(got[-1]), flush=True)
client.stop()
"""

PEER_SERVER = r"""
import sys, time, numpy as np, pyigtl
server = pyigtl.OpenIGTLinkServer(port=int(sys.argv[1]))
print("ready", flush=True)
while not server.is_connected():
    time.sleep(0.01)
for k in range(20):
    matrix = np.eye(4)
    matrix[0, 3] = 10.0 * k
    if k == 7:
        matrix[1, 3] = np.nan
    server.send_message(pyigtl.TransformMessage(matrix, timestamp=1000.0 + k, device_name="Needle"), wait=True)
sys.stdin.readline()
server.stop()
"""


@needs_pyigtl
def test_an_independent_client_reads_what_we_send() -> None:
    with IgtlServer(0) as server:
        command = [sys.executable, "-c", PEER_CLIENT, str(server.port)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as peer:
            assert peer.stdout.readline() == "ready\n"
            waiter = threading.Event()
            while server.clients == 0:
                waiter.wait(0.01)
            for k in range(5):
                # it keeps only the newest message of a name: wait until it has told each
                now_s = server.clock.now_s()
                tools = {"StylusTipToReference": moved(float(k)), "lost": ToolPose(ToolStatus.MISSING, None)}
                server.send(frame(k, now_s, tools))
                matrix, stamp_s = json.loads(peer.stdout.readline())
                expected = T.copy()
                expected[0, 3] = k
                np.testing.assert_allclose(matrix, expected, atol=1e-4)
                assert stamp_s == pytest.approx(server.clock.unix_s(now_s), abs=1e-5)
            assert peer.wait(20) == 0


@needs_pyigtl
def test_an_independent_server_is_read_and_its_nan_is_no_pose() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    command = [sys.executable, "-c", PEER_SERVER, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True) as peer:
        assert peer.stdout.readline() == "ready\n"
        with IgtlTracker("127.0.0.1", port) as tracker:
            frames = collect(tracker, 20)
        peer.stdin.write("done\n")
        peer.stdin.flush()
        peer.wait(20)
    for k, received in enumerate(frames):
        pose = received.tools["Needle"]
        if k == 7:
            assert pose.status is ToolStatus.INVALID
            assert pose.T_tracker_tool is None
        else:
            assert pose.T_tracker_tool[0, 3] == 10.0 * k


def test_poses_go_out_as_positions_where_that_is_wanted() -> None:
    with pytest.raises(DeviceInputError, match="expected one of TRANSFORM, POSITION"):
        IgtlServer(0, poses_as="QTRANS")
    with IgtlServer(0, poses_as="POSITION") as server, IgtlTracker("127.0.0.1", server.port) as tracker:
        while not server.clients:
            tracker.read(0.01)
        for k in range(2):
            server.send(frame(k, server.clock.now_s() + 0.1 * k, {"Stylus": ToolPose(ToolStatus.OK, T)}))
        pose = tracker.read(5.0).tools["Stylus"]
    assert pose.status is ToolStatus.OK
    np.testing.assert_allclose(pose.T_tracker_tool, T, atol=1e-4)


def test_a_position_is_position_and_quaternion() -> None:
    reader = MessageReader()
    (message,) = reader.feed(encode_position("Probe", 12.5, T))
    assert isinstance(message, Message)
    assert (message.kind, message.name, len(message.content)) == ("POSITION", "Probe", 28)
    np.testing.assert_allclose(decode_poses(message)["Probe"], T, atol=1e-4)
    with pytest.raises(DeviceInputError):
        encode_position("Probe", 12.5, np.full((4, 4), np.nan))
