"""The NDI protocol layer: golden strings, cuts anywhere, noise, and one truth through TX, BX and BX2."""

from __future__ import annotations

import ast
import math
import random
import struct
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from devices import DeviceInputError, ManualClock, ProtocolError, ToolStatus
from devices.ndi.binary_replies import decode_bx, decode_bx2
from devices.ndi.bodies import SimulatedBodies
from devices.ndi.crc import crc16
from devices.ndi.device import Device
from devices.ndi.encode import binary_reply, text_reply
from devices.ndi.protocol import BinaryReply, CrcError, ErrorReply, ReplyReader, TextReply, command, refusal
from devices.ndi.replies import HandleState, Option, PoseReport, tool_pose
from devices.ndi.rom import read_rom
from devices.ndi.text_replies import decode_handles, decode_tx
from devices.rotation import pose_from_quaternion

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "tracker"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared tracker data are not here")
EVERYTHING = Option.POSES | Option.TOOL_MARKERS | Option.OUT_OF_VOLUME | Option.STRAYS


def golden() -> list[tuple[str, bytes, str, str]]:
    rows = []
    for line in (DATA / "golden_replies.tsv").read_text().splitlines()[1:]:
        direction, text, crc, _source, *note = line.split("\t")
        rows.append((direction, ast.literal_eval(f"b'{text}'"), crc, " ".join(note)))
    return rows


def crc16_bit_by_bit(message: bytes) -> int:
    value = 0
    for byte in message:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
    return value


@given(st.binary(max_size=80))
def test_the_table_is_the_definition(message: bytes) -> None:
    assert crc16(message) == crc16_bit_by_bit(message)


def test_known_checksums() -> None:
    assert crc16(b"123456789") == 0xBB3D  # the catalogue's check value of CRC-16/ARC
    assert command("INIT") == b"INIT:E3A5\r"
    assert text_reply("RESET") == b"RESETBE6F\r"


@needs_data
def test_golden_strings_have_the_checksums_stated() -> None:
    verdicts = {"ok": 0, "BAD": 0}
    for direction, message, crc, _ in golden():
        if direction == "reply-body":
            continue
        replies = ReplyReader().feed(message + b"\r")
        assert len(replies) == 1
        assert isinstance(replies[0], CrcError) == (crc == "BAD"), message
        verdicts[crc] += 1
        if direction == "command":
            name, arguments = message[:-4].decode().split(":", 1)
            assert command(name, arguments) == message + b"\r"
    assert verdicts["BAD"] == 1
    assert verdicts["ok"] >= 37


@needs_data
def test_golden_replies_say_what_their_notes_say() -> None:
    replies = {message: note for direction, message, _, note in golden() if direction.startswith("reply")}
    assert decode_handles("030A0010B0010C001") == [(0x0A, 1), (0x0B, 1), (0x0C, 1)]
    assert decode_handles("040A01F0B01F0C01F0D01F")[3] == (0x0D, 0x1F)
    assert decode_handles("00") == []
    both, missing = (body.decode() for body in replies if body.startswith(b"0201"))
    report = decode_tx(both, Option.POSES | Option.TOOL_MARKERS)
    first, second = report.handles
    assert first.quaternion == (0.7082, -0.4513, -0.1855, -0.5101)
    assert first.position_mm == (415.95, -570.80, -1901.90)
    assert first.error_mm == 0.2477
    assert (first.port_status, first.frame) == (0x31, 0x14D)
    assert len(first.markers_mm) == len(second.markers_mm) == 4
    assert first.markers_mm[0] == (326.81, -292.73, -1968.06)
    assert tool_pose(first).status is ToolStatus.OK
    np.testing.assert_allclose(
        tool_pose(second).T_tracker_tool, pose_from_quaternion(second.quaternion, (330.67, -222.95, -1950.13))
    )
    lost, seen = decode_tx(missing, Option.POSES | Option.TOOL_MARKERS).handles
    assert lost.state is HandleState.MISSING
    assert (lost.port_status, lost.frame, lost.markers_mm) == (0x31, 0x393, ())
    assert tool_pose(lost).status is ToolStatus.MISSING
    assert tool_pose(lost).T_tracker_tool is None
    assert seen.position_mm == (163.51, 61.74, -1946.89)


def test_unoccupied_is_read_both_ways() -> None:
    for body in (
        "0201UNOCCUPIED\n02DISABLED0000000100000005\n0000",
        "0201UNOCCUPIED0000000000000005\n02DISABLED0000000100000005\n0000",
    ):
        first, second = decode_tx(body).handles
        assert first.state is HandleState.UNOCCUPIED
        assert tool_pose(first).status is tool_pose(second).status is ToolStatus.DISABLED


def tracking_device(tools: int, clock: ManualClock, **options: object) -> Device:
    device = Device(SimulatedBodies(tools), clock, **options)
    device.answer(command("INIT")[:-1])
    for handle in device.ports.handles:
        device.answer(command("PINIT", f"{handle:02X}")[:-1])
        device.answer(command("PENA", f"{handle:02X}D")[:-1])
    device.answer(command("TSTART")[:-1])
    return device


def asked(device: Device, name: str, arguments: str) -> TextReply | BinaryReply | ErrorReply:
    (reply,) = ReplyReader().feed(device.answer(command(name, arguments)[:-1]))
    assert not isinstance(reply, ProtocolError)
    return reply


def three_ways(device: Device) -> tuple[PoseReport, PoseReport, PoseReport]:
    options = f"{int(EVERYTHING):04X}"
    tx = decode_tx(asked(device, "TX", options).text, EVERYTHING)
    bx = decode_bx(asked(device, "BX", options).body, EVERYTHING)
    (bx2,) = decode_bx2(asked(device, "BX2", "--6d=tools --3d=all --1d=buttons").body)
    return tx, bx, bx2


@pytest.mark.parametrize("tools", [1, 3, 6, 40])
def test_tx_bx_and_bx2_tell_one_truth(tools: int) -> None:
    clock = ManualClock(3.0)
    device = tracking_device(tools, clock)
    device.ports.handles[0x0A].switches = 0b101
    device.out_of_volume = {1}
    for _ in range(5):
        clock.advance(0.7)
        reports = three_ways(device)
        for report in reports:
            assert [handle.handle for handle in report.handles] == [0x0A + k for k in range(tools)]
            np.testing.assert_allclose(report.strays_mm, reports[0].strays_mm, atol=0.006)
        for handles in zip(*(report.handles for report in reports), strict=True):
            truth = device.truth(handles[0].handle, handles[0].frame)
            poses = [tool_pose(handle) for handle in handles]
            expected = ToolStatus.OUT_OF_VOLUME if handles[0].handle == 0x0B else ToolStatus.OK
            assert {pose.status for pose in poses} == {expected}
            assert len({handle.frame for handle in handles}) == 1
            assert len({pose.switches for pose in poses}) == 1
            T = pose_from_quaternion(truth.quaternion, truth.position_mm)
            for pose, shift, turn in zip(poses, (0.006, 1e-5, 1e-5), (2.5e-4, 1e-6, 1e-6), strict=True):
                assert np.abs(pose.T_tracker_tool - T)[:3, 3].max() <= shift
                assert np.abs(pose.T_tracker_tool - T)[:3, :3].max() <= turn
    assert three_ways_time(device, clock) == pytest.approx(0.5, abs=0.02)


def three_ways_time(device: Device, clock: ManualClock) -> float:
    def stamp() -> float:
        (report,) = decode_bx2(asked(device, "BX2", "").body)
        return report.device_time_s

    clock.advance(0.5)
    before = stamp()
    clock.advance(0.5)
    return stamp() - before


def test_missing_and_disabled_tools_in_all_replies() -> None:
    class Half(SimulatedBodies):
        def pose(self, body: int, frame: int) -> object:
            return None if body == 0 else super().pose(body, frame)

    clock = ManualClock()
    device = tracking_device(3, clock)
    device.bodies = Half(3)
    device.ports.handles[0x0C].enabled = False
    clock.advance(1.0)
    for report in three_ways(device):
        statuses = {handle.handle: tool_pose(handle).status for handle in report.handles}
        assert statuses[0x0A] is ToolStatus.MISSING
        assert statuses[0x0B] is ToolStatus.OK
        # BX2 is free to leave a tool out that is not enabled
        assert statuses.get(0x0C, ToolStatus.DISABLED) is ToolStatus.DISABLED


def test_bx2_never_repeats() -> None:
    clock = ManualClock()
    device = tracking_device(2, clock)
    clock.advance(0.1)
    assert len(decode_bx2(asked(device, "BX2", "").body)) == 1
    assert decode_bx2(asked(device, "BX2", "").body) == []


def test_a_long_binary_reply() -> None:
    body = bytes(range(256)) * 300
    assert ReplyReader().feed(binary_reply(body)) == [BinaryReply(body)]


@given(st.data())
def test_replies_come_whole_however_the_bytes_are_cut(data: st.DataObject) -> None:
    clock = ManualClock()
    device = tracking_device(3, clock)
    clock.advance(2.0)
    stream, expected = b"", []
    for name, arguments in data.draw(
        st.lists(st.sampled_from([("TX", "0801"), ("BX", "1809"), ("BX2", "--3d=all"), ("BEEP", "2"), ("PHSR", "00")]))
    ):
        message = device.answer(command(name, arguments)[:-1])
        stream += message
        expected += ReplyReader().feed(message)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    reader, got = ReplyReader(), []
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        got += reader.feed(stream[start:stop])
    assert got == expected
    assert reader.pending == 0


def test_every_error_code_speaks() -> None:
    (reply,) = ReplyReader().feed(text_reply("ERROR13"))
    assert reply == ErrorReply(0x13)
    error = refusal("PINIT:01", reply)
    assert error.code == 0x13
    assert "PINIT:01" in str(error)
    assert "tool cannot be initialised" in str(error)
    assert ErrorReply(0xEE).meaning == "unknown error code"
    with pytest.raises(DeviceInputError):
        command("ECHO", "a\rb")


def seeds() -> list[bytes]:
    clock = ManualClock()
    device = tracking_device(4, clock)
    clock.advance(1.0)
    wanted = [
        ("TX", "1809"),
        ("BX", "1809"),
        ("BX2", "--6d=tools --3d=all"),
        ("PHSR", "00"),
        ("TX", "0001"),
        ("NO", ""),
    ]
    return [device.answer(command(name, arguments)[:-1]) for name, arguments in wanted]


def chew(stream: bytes) -> None:
    """All that the tracker does with bytes: frame them, decode what comes, make poses."""
    for reply in ReplyReader().feed(stream):
        if isinstance(reply, TextReply):
            decode_all(reply.text, decode_handles)
            for options in (Option.POSES, EVERYTHING, Option(0x1807)):
                decode_all(reply.text, lambda text, options=options: decode_tx(text, options))
        elif isinstance(reply, BinaryReply):
            for options in (Option.POSES, EVERYTHING, Option(0x1807)):
                decode_all(reply.body, lambda body, options=options: decode_bx(body, options))
            decode_all(reply.body, decode_bx2)
        else:
            assert isinstance(reply, ProtocolError | ErrorReply)


def decode_all(payload: object, decode: object) -> None:
    try:
        result = decode(payload)  # type: ignore[operator]
    except ProtocolError:
        return
    reports = [result] if isinstance(result, PoseReport) else result
    for report in reports:
        if isinstance(report, PoseReport):
            for handle in report.handles:
                pose = tool_pose(handle, markers=True)
                if pose.status is ToolStatus.OK:
                    assert np.isfinite(pose.T_tracker_tool).all()


def mutated(source: bytes, generator: random.Random) -> bytes:
    data = bytearray(source)
    for _ in range(generator.randint(1, 4)):
        where = generator.randrange(len(data) + 1)
        kind = generator.randrange(5)
        if kind == 0 and data:
            data[where % len(data)] = generator.randrange(256)
        elif kind == 1:
            data[where:where] = generator.randbytes(generator.randint(1, 9))
        elif kind == 2:
            del data[where : where + generator.randint(1, 30)]
        elif kind == 3:
            del data[where:]
        else:
            data += data[: generator.randint(0, 40)]
    return bytes(data)


def with_right_checksum(payload: bytes, generator: random.Random) -> bytes:
    """Wrap damaged content so that it passes the checksum: the decoders alone stand between it and a pose."""
    if generator.random() < 0.5:
        return binary_reply(payload)
    payload = bytes(byte & 0x7F for byte in payload).replace(b"\r", b"0")
    return payload + b"%04X\r" % crc16(payload)


@pytest.mark.parametrize("part", range(4))
def test_noise_raises_nothing_but_protocol_errors(part: int) -> None:
    """25,000 streams a part: random bytes, damaged replies, and damaged content under a right checksum."""
    generator = random.Random(part)
    sources = seeds()
    bodies = [
        reply.text.encode() if isinstance(reply, TextReply) else getattr(reply, "body", b"")
        for source in sources
        for reply in ReplyReader().feed(source)
    ]
    for k in range(25_000):
        if k % 5 == 0:
            stream = generator.randbytes(generator.randint(0, 60))
        elif k % 5 == 1:
            stream = b"\xc4\xa5" + generator.randbytes(generator.randint(0, 40))
        elif k % 5 == 2:
            stream = mutated(generator.choice(sources), generator)
        else:
            stream = with_right_checksum(mutated(generator.choice(bodies), generator), generator)
        chew(stream)


def test_a_pose_needs_a_unit_quaternion_and_finite_numbers() -> None:
    clock = ManualClock()
    device = tracking_device(1, clock)
    body = bytearray(asked(device, "BX", "0801").body)
    assert tool_pose(decode_bx(bytes(body)).handles[0]).status is ToolStatus.OK
    for value in (math.nan, math.inf, 0.5):
        struct.pack_into("<f", body, 3, value)
        pose = tool_pose(decode_bx(bytes(body)).handles[0])
        assert pose.status is ToolStatus.INVALID
        assert pose.T_tracker_tool is None


def rom_bytes() -> bytes:
    """A definition laid out as the public files are: marker count, positions, normals, maker, part number, sum."""
    content = bytearray(752)
    content[:4] = b"NDI\0"
    struct.pack_into("<I", content, 0x1C, 4)
    struct.pack_into("<12f", content, 0x48, 0, 0, 0, 0, 28.59, 41.02, 0, 0, 88, 0, -44.32, 40.45)
    struct.pack_into("<12f", content, 0x138, *[1, 0, 0] * 4)
    content[0x244:0x247] = b"NDI"
    content[0x250:0x257] = b"8700339"
    struct.pack_into("<H", content, 4, sum(content[6:]) & 0xFFFF)
    return bytes(content)


def test_a_tool_definition_is_read_and_checked() -> None:
    tool = read_rom(rom_bytes())
    assert (tool.manufacturer, tool.part_number) == ("NDI", "8700339")
    np.testing.assert_allclose(tool.markers_mm[3], [0, -44.32, 40.45], atol=1e-5)
    assert len(tool.chunks) == 12
    assert b"".join(piece for _, piece in tool.chunks)[:752] == rom_bytes()
    for spoilt, message in [
        (b"", "begins with"),
        (rom_bytes()[:500], "cut"),
        (rom_bytes()[:100] + b"\x01" + rom_bytes()[101:], "damaged"),
    ]:
        with pytest.raises(DeviceInputError, match=message):
            read_rom(spoilt)
    with pytest.raises(DeviceInputError, match="cannot be read"):
        read_rom("nowhere.rom")


@needs_data
def test_the_public_tool_definitions_are_whole() -> None:
    parts = {read_rom(path).part_number for path in (DATA / "roms").glob("*.rom")}
    assert parts == {"8700339", "8700340"}
