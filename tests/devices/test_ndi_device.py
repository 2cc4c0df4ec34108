"""The emulated device keeps the rules of a real one: modes, handles, both spellings, error codes."""

from __future__ import annotations

import struct

import pytest

from devices import DeviceInputError, ManualClock
from devices.ndi.bodies import RecordedBodies, SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.encode import text_reply
from devices.ndi.faults import Faults
from devices.ndi.protocol import command


def rom_bytes() -> bytes:
    content = bytearray(752)
    content[:4] = b"NDI\0"
    struct.pack_into("<I", content, 0x1C, 3)
    struct.pack_into("<9f", content, 0x48, 0, 0, 0, 0, 30, 40, 0, 0, 88)
    content[0x250:0x254] = b"PART"
    struct.pack_into("<H", content, 4, sum(content[6:]) & 0xFFFF)
    return bytes(content)


def test_a_whole_session_reply_by_reply() -> None:
    """What a client sends, and the exact bytes that come back."""
    device = Device(SimulatedBodies(1), ManualClock())
    pieces = [rom_bytes()[start : start + 64].ljust(64, b"\0").hex().upper() for start in range(0, 752, 64)]
    session = [
        ("TX", "0001", "ERROR10"),
        ("INIT", "", "OKAY"),
        ("COMM", "50000", "OKAY"),
        ("PHSR", "02", "010A001"),
        ("PHRQ", "*********1****", "01"),
        ("PINIT", "01", "ERROR0D"),
        ("PVWR", "010000" + pieces[0], "OKAY"),
        ("PINIT", "01", "ERROR13"),
        *[("PVWR", f"01{64 * k:04X}{piece}", "OKAY") for k, piece in enumerate(pieces)],
        ("PENA", "01D", "ERROR0E"),
        ("PINIT", "01", "OKAY"),
        ("PHSR", "03", "0101011"),
        ("PENA", "01X", "ERROR09"),
        ("PENA", "01D", "OKAY"),
        ("PHSR", "04", "0101031"),
        ("PHINF", "010004", "PART                "),
        ("BX", "0001", "ERROR0C"),
        ("TSTART", "", "OKAY"),
        ("PHSR", "00", "ERROR0C"),
        ("BEEP", "1", "1"),
        ("LED", "010S", "OKAY"),
        ("TSTOP", "", "OKAY"),
        ("TSTOP", "", "ERROR0C"),
        ("PDIS", "01", "OKAY"),
        ("PDIS", "01", "ERROR0F"),
        ("PHF", "01", "OKAY"),
        ("PENA", "01D", "ERROR2B"),
        ("PENA", "XYD", "ERROR08"),
        ("NONSENSE", "", "ERROR01"),
        ("COMM", "90000", "ERROR06"),
        ("VER", "9", "ERROR23"),
        ("GET", "No.Such", "ERROR34"),
        ("SET", "Info.Timeout.PINIT=9", "ERROR39"),
        ("SET", "Param.Tracking.Illuminator Rate=2", "OKAY"),
        ("GET", "Param.Tracking.Illum*", "Param.Tracking.Illuminator Rate=2\n"),
        ("RESET", "", "RESET"),
        ("PHSR", "00", "ERROR10"),
    ]
    for name, arguments, reply in session:
        assert device.receive(command(name, arguments)) == [text_reply(reply)], (name, arguments)


def test_both_spellings_and_cuts() -> None:
    device = Device(SimulatedBodies(0), ManualClock())
    assert device.receive(b"IN") == []
    assert device.receive(b"IT:E3A5\rECHO Testing!\rINIT\rINIT \r") == [
        b"OKAYA896\r",
        b"Testing!A81C\r",
        b"OKAYA896\r",
        b"OKAYA896\r",
    ]
    assert device.receive(b"INIT:E3A4\r") == [text_reply("ERROR04")]
    assert device.receive(b"INIT:\r") == [text_reply("ERROR03")]
    assert device.receive(b"APIREV \r") == [text_reply("G.003.001")]
    assert device.receive(b"\r") == [text_reply("ERROR01")]
    assert device.receive(b"x" * 5000) == []
    assert device.receive(b"x\r") == [text_reply("ERROR02")]
    assert device.receive(b"\xff\xfe\r") == [text_reply("ERROR01")]


def test_an_older_device_knows_no_bx2() -> None:
    device = Device(SimulatedBodies(1), ManualClock(), api_revision="G.001.005")
    device.receive(command("INIT") + command("TSTART"))
    assert device.receive(command("BX2", "--6d=tools")) == [text_reply("ERROR01")]


def test_the_frame_number_wraps_and_can_be_reset() -> None:
    clock = ManualClock()
    device = Device(SimulatedBodies(1), clock, first_frame=2**32 - 3)
    device.receive(command("INIT") + command("TSTART"))
    clock.advance(0.1)
    assert device.frame_number(device.frame_index()) == 3
    device.receive(command("TSTOP") + b"TSTART 80\r")
    assert device.frame_number(device.frame_index()) == 0


def test_faults_are_read_and_seeded() -> None:
    faults = Faults.parse(["cut=0.5", "late", "silence=0.7", "wrap"], seed=4)
    assert (faults.cut, faults.late, faults.silence_s, faults.wrap) == (0.5, 0.05, 0.7, True)
    first = [Faults.parse(["corrupt=0.3", "duplicate=0.3"], seed=4).deliver(b"reply", False) for _ in range(3)]
    again = [Faults.parse(["corrupt=0.3", "duplicate=0.3"], seed=4).deliver(b"reply", False) for _ in range(3)]
    assert first == again
    for wrong in ("flood", "cut=much", "late=1.5", "disconnect=0"):
        with pytest.raises(DeviceInputError):
            Faults.parse([wrong])


def test_a_recording_to_emulate_needs_frames() -> None:
    with pytest.raises(DeviceInputError, match="at least one frame"):
        RecordedBodies([])
    with pytest.raises(DeviceInputError, match="rate_hz"):
        Device(SimulatedBodies(1), ManualClock(), rate_hz=0.0)
