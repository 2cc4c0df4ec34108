"""The emulator and clients of every manner: what public ones send word for word, and what none should."""

from __future__ import annotations

import os
import random
import socket

import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from devices import ManualClock
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.crc import crc16
from devices.ndi.device import Device
from devices.ndi.emulator import PtyEmulator, TcpEmulator
from devices.ndi.encode import text_reply
from devices.ndi.protocol import BinaryReply, ErrorReply, ReplyReader, TextReply, command

OKAY = TextReply("OKAY")


def asked(device: Device, sent: bytes) -> list[object]:
    """The replies, read by the reader of the other side."""
    return ReplyReader().feed(b"".join(device.receive(sent)))


def with_checksum(text: str) -> bytes:
    return text.encode() + b"%04X\r" % crc16(text.encode())


def test_scikit_surgerynditracker_with_wired_tools() -> None:
    device = Device(SimulatedBodies(2), ManualClock())
    for sent, wanted in [
        ("INIT:", OKAY),
        ("COMM:50000", OKAY),
        ("PHSR:02", TextReply("020A0010B001")),
        ("PINIT:0A", OKAY),
        ("PINIT:0B", OKAY),
        ("PHSR:02", TextReply("00")),
        ("PHSR:03", TextReply("020A0110B011")),
        ("PHINF:0A0001", TextReply("02000000EMULATOR    0010000000A11")),
        ("PENA:0AD", OKAY),
        ("PENA:0BD", OKAY),
        ("TSTART:", OKAY),
    ]:
        assert asked(device, with_checksum(sent)) == [wanted], sent
    (poses,) = asked(device, with_checksum("TX:0801"))
    assert isinstance(poses, TextReply)
    assert poses.text.startswith("020A+")
    assert asked(device, with_checksum("TSTOP:")) == [OKAY]
    (version,) = asked(device, with_checksum("VER:0"))
    # it takes TX where the third word of this line is one that it knows
    assert "Freeze Tag: Polaris Vega 008\n" in version.text


def test_the_plus_toolkit() -> None:
    """INIT bare, some commands with a blank and no checksum, the speed tried from above, and the speed set back."""
    device = Device(SimulatedBodies(1), ManualClock())
    for sent, wanted in [
        (b"INIT\r", OKAY),
        (with_checksum("COMM:50000"), OKAY),
        (b"APIREV \r", TextReply("G.003.001")),
        (with_checksum("GET:Features.Firmware.API Revision"), TextReply("Features.Firmware.API Revision=G.003.001\n")),
        (with_checksum("SET:Param.Tracking.Selected Volume=0"), OKAY),
        (with_checksum("PHSR:01"), TextReply("00")),
        (with_checksum("PHSR:02"), TextReply("010A001")),
        (with_checksum("PINIT:0A"), OKAY),
        (with_checksum("PENA:0AD"), OKAY),
        (with_checksum("BEEP:2"), TextReply("1")),
        (b"TSTART 80\r", OKAY),
        (with_checksum("TSTOP:"), OKAY),
        (with_checksum("COMM:00000"), OKAY),
    ]:
        assert asked(device, sent) == [wanted], sent


def test_the_saw_component() -> None:
    """Blanks, no checksums at all, empty arguments with the blank kept."""
    device = Device(SimulatedBodies(1), ManualClock())
    for sent, wanted in [
        ("RESET ", TextReply("RESET")),
        ("INIT ", OKAY),
        ("BEEP 2", TextReply("1")),
        ("PHSR 01", TextReply("00")),
        ("PHRQ *********1****", TextReply("01")),
        ("PHF 01", OKAY),
        ("PHSR 02", TextReply("010A001")),
        ("PINIT 0A", OKAY),
        # kind 33, part number 20, place 14 characters
        ("PHINF 0A0025", TextReply("02000000EMULATOR    0010000000A11" + "BODY-0".ljust(20) + "0000000000" + "0A00")),
        ("PENA 0AD", OKAY),
        ("SSTAT 0007", TextReply("000000")),
        ("TSTART ", OKAY),
        ("TX 0801", None),
        ("TSTOP ", OKAY),
    ]:
        (reply,) = asked(device, sent.encode() + b"\r")
        assert wanted in (reply, None), sent


@pytest.mark.parametrize("spelling", ["INIT ", "INIT", "INIT:e3a5", "INIT:E3A5", "\nINIT:E3A5", "INIT   "])
def test_spellings_of_one_command(spelling: str) -> None:
    assert asked(Device(SimulatedBodies(0), ManualClock()), spelling.encode() + b"\r") == [OKAY]


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (b"\r", 0x01),
        (b":\r", 0x01),
        (b"\0\r", 0x01),
        (b"\xff\xfe\r", 0x01),
        (b"INIT:\r", 0x03),
        (b"INIT:0000\r", 0x04),
        (b"INIT" + b" " * 5000 + b"\r", 0x02),
        (b"x" * 5000 + b"\r", 0x02),
        (b"x" * 3000 + b"\r", 0x01),
        (b"PINIT -1\r", 0x08),
        (b"PINIT \r", 0x08),
        (b"PVWR 0A-001" + b"0" * 128 + b"\r", 0x14),
        (b"PHINF 0A-1\r", 0x14),
        (b"TX ZZZZ\r", 0x0C),
        (b"GET " + b"*" * 3000 + b"x\r", 0x34),
        (b"SET a\r", 0x07),
        (b"COMM \r", 0x07),
        (b"SSTAT \r", 0x14),
    ],
)
def test_nonsense_is_refused_once_and_forgotten(sent: bytes, code: int) -> None:
    device = Device(SimulatedBodies(1), ManualClock())
    device.receive(b"INIT\r")
    assert asked(device, sent) == [ErrorReply(code)]
    assert asked(device, b"ECHO still here\r") == [TextReply("still here")]


WORDS = [b"INIT ", b"TSTART ", b"TSTOP ", b"TX 1809", b"BX 1809", b"BX2 --6d=tools --3d=all", b"PHSR 00", b"PINIT 0A"]
WORDS += [b"PENA 0AD", b"PHRQ *********1****", b"PVWR 010000", b"GET *", b"RESET ", b"\n", b":", b"", b"PHINF 0AFFFF"]


@settings(deadline=None, max_examples=200)
@given(
    st.lists(st.one_of(st.sampled_from(WORDS), st.binary(max_size=12)), max_size=20),
    st.lists(st.integers(0, 200), max_size=10),
)
def test_any_bytes_cut_anywhere_get_whole_replies(words: list[bytes], cuts: list[int]) -> None:
    """However commands are cut or joined, the replies are the same, and each can be read."""
    stream = b"\r".join([b"INIT ", *words, b""])
    whole = Device(SimulatedBodies(2), ManualClock()).receive(stream)
    assert len(whole) == stream.count(b"\r")
    device, piecewise, start = Device(SimulatedBodies(2), ManualClock()), [], 0
    for cut in [*sorted(cuts), len(stream)]:
        piecewise += device.receive(stream[start:cut])
        start = max(start, cut)
    assert piecewise == whole
    read = ReplyReader().feed(b"".join(whole))
    assert len(read) == len(whole)
    assert all(isinstance(reply, TextReply | ErrorReply | BinaryReply) for reply in read)


def read_replies(connection: socket.socket, count: int) -> list[object]:
    reader, replies = ReplyReader(), []
    while len(replies) < count:
        data = connection.recv(4096)
        assert data, "the emulator hung up"
        replies += reader.feed(data)
    return replies


def test_pauses_floods_and_clients_that_leave() -> None:
    generator = random.Random(5)
    with TcpEmulator(Device(SimulatedBodies(2))) as emulator:
        with socket.create_connection((emulator.host, emulator.port), 20.0) as rude:
            rude.sendall(b"PHSR:0")  # gone in the middle of a command
        with socket.create_connection((emulator.host, emulator.port), 20.0) as client:
            for byte in command("INIT"):
                client.sendall(bytes([byte]))
            assert read_replies(client, 1) == [OKAY]
            client.sendall(b"ECHO a\rECHO b\r\nECHO c\r")
            assert read_replies(client, 3) == [TextReply("a"), TextReply("b"), TextReply("c")]
            client.sendall(bytes(generator.randrange(14, 256) for _ in range(1 << 18)))  # no carriage return among them
            client.sendall(b"\rECHO after\r")
            assert read_replies(client, 2) == [ErrorReply(0x02), TextReply("after")]
            # a new client takes the place of the old
            with socket.create_connection((emulator.host, emulator.port), 20.0) as second:
                second.sendall(b"ECHO second\r")
                assert read_replies(second, 1) == [TextReply("second")]
                assert client.recv(1) == b""


def test_a_serial_client_that_never_reads_its_replies() -> None:
    """Replies pile up in the terminal until it is full; the emulator waits, and serves the next client."""
    with PtyEmulator(Device(SimulatedBodies(2))) as emulator:
        with serial.Serial(emulator.path, 9600, timeout=20.0, write_timeout=0.2) as port:
            try:
                for _ in range(10):
                    port.write(b"GET *\r" * 20)
            except serial.SerialTimeoutException:
                pass
            port.reset_output_buffer()
            port.reset_input_buffer()
        with serial.Serial(emulator.path, 9600, timeout=20.0) as port:
            port.write(b"\rECHO next\r")
            assert port.read_until(text_reply("next")).endswith(text_reply("next"))
        assert os.path.exists(emulator.path)
