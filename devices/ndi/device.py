"""An emulated NDI tracker without its line: commands in, replies out, by the modes and rules of the real one."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from fnmatch import fnmatchcase

from devices.clock import Clock, SystemClock
from devices.errors import DeviceInputError
from devices.ndi.bodies import Bodies, BodyPose, SimulatedBodies
from devices.ndi.crc import crc16
from devices.ndi.encode import SeenTool, binary_reply, bx2_body, bx_body, text_reply, tx_text
from devices.ndi.ports import OKAY, Ports, Refused
from devices.ndi.replies import OUT_OF_VOLUME, Option, Point

__all__ = ["Device"]

_BAUD_RATES = {
    "0": 9600,
    "1": 14400,
    "2": 19200,
    "3": 38400,
    "4": 57600,
    "5": 115200,
    "6": 921600,
    "7": 1228739,
    "A": 230400,
}
#: commands that need no INIT before
_ANY_TIME = {"INIT", "RESET", "COMM", "VER", "ECHO", "APIREV", "BEEP", "GET", "GETINFO", "SFLIST"}
#: commands refused while tracking
_NOT_TRACKING = {"INIT", "COMM", "PHSR", "PHRQ", "PVWR", "PVCLR", "PINIT", "PENA", "PDIS", "PHF", "PHINF", "TSTART"}
_NOT_TRACKING |= {"SSTAT", "VSEL", "DSTART", "DSTOP", "SFLIST", "VER"}
_LONGEST_COMMAND = 4096
_KNOWS_BX2 = "G.003"
#: a tool was plugged in or pulled out; told until the host asks which
_PORTS_CHANGED = 0xC0


class Device:
    """The box: give `receive` what a client sent, and send back what it returns.

    Frame k since the start of tracking shows `bodies.pose(body, k)`; the device's number of that frame is
    ``(first_frame + k) mod 2³²``.

    Parameters
    ----------
    bodies : Bodies or None
        What the cameras see. Each body has a wired tool on a handle of its own, 0A on; the k-th tool loaded with PHRQ
        and PVWR sits on body k, its handle counts from 01.
    clock : Clock or None
    rate_hz : float
        Frames per second.
    first_frame : int
        Device number of the first frame; near 2³² it wraps soon.
    wired : bool
        False: no wired tools, as on a Polaris without cables.
    api_revision : str
        ``G.003.…`` and later know BX2.
    bare_unoccupied : bool
        Layout of UNOCCUPIED in TX: the bare word, as the public client library reads it, or with status and frame.
    """

    def __init__(
        self,
        bodies: Bodies | None = None,
        clock: Clock | None = None,
        rate_hz: float = 60.0,
        first_frame: int = 1,
        wired: bool = True,
        api_revision: str = "G.003.001",
        bare_unoccupied: bool = True,
    ) -> None:
        self.bodies = SimulatedBodies(3, rate_hz) if bodies is None else bodies
        self.clock = SystemClock() if clock is None else clock
        if not rate_hz > 0.0:
            raise DeviceInputError(f"rate_hz: expected > 0, got {rate_hz!r}")
        self.rate_hz, self.first_frame = float(rate_hz), first_frame
        self.api_revision, self.bare_unoccupied = api_revision, bare_unoccupied
        self._wired = wired
        #: bodies that are out of the volume now; a test or a fault adds to it
        self.out_of_volume: set[int] = set()
        self.system_status = 0
        self.baud_rate = 9600
        self.resets = 0
        self.settings = {
            "Param.Tracking.Frame Frequency": f"{rate_hz:g}",
            "Param.Tracking.Track Frequency": "0",
            "Param.Tracking.Selected Volume": "0",
            "Param.Tracking.Illuminator Rate": "0",
            "Param.Data Averaging.Depth": "1",
            "Info.Timeout.INIT": "10",
            "Info.Timeout.PINIT": "5",
            "Info.Status.Alerts": "0",
            "Info.Status.New Alerts": "0",
            "Features.Firmware.API Revision": api_revision,
            "Features.Firmware.Version": "001.000.000",
            "Features.Hardware.Model": "Emulator",
            "Features.Hardware.Serial Number": "E0-00000",
        }
        self._buffer = bytearray()
        self._too_long = False
        self.reset()
        self.resets = 0

    def reset(self) -> None:
        """Return to the state after power-up: 9600 baud, not initialised, wired tools plugged in."""
        self.initialised = self.tracking = False
        self.baud_rate = 9600
        self.ports = Ports([self.bodies.name(k) for k in range(len(self.bodies))] if self._wired else [])
        self._started_s = 0.0
        self._told: int | None = None
        self.forget_input()
        self.resets += 1

    # frames

    def frame_index(self) -> int:
        """Frames since tracking started."""
        return int((self.clock.now_s() - self._started_s) * self.rate_hz + 1e-9)

    def next_frame_s(self) -> float:
        """Time until the next frame, s; infinite where the device does not track."""
        if not self.tracking:
            return math.inf
        return self._started_s + (self.frame_index() + 1) / self.rate_hz - self.clock.now_s()

    def frame_number(self, index: int) -> int:
        """Device number of a frame, 32 bits."""
        return (self.first_frame + index) & 0xFFFFFFFF

    def truth(self, handle: int, number: int) -> BodyPose | None:
        """Pose that the tool of a handle has in the frame of that number (within 2³² frames of the first)."""
        return self.bodies.pose(self.ports.handles[handle].body, (number - self.first_frame) & 0xFFFFFFFF)

    def _seen(self, index: int) -> list[SeenTool]:
        seen = []
        for handle, port in sorted(self.ports.handles.items()):
            pose = self.bodies.pose(port.body, index) if port.enabled and port.occupied else None
            if pose is not None and port.body in self.out_of_volume:
                pose = BodyPose(pose.quaternion, pose.position_mm, pose.error_mm, out_of_volume=True)
            status = port.status | (OUT_OF_VOLUME if pose is not None and pose.out_of_volume else 0)
            markers: tuple[Point, ...] = ()
            if port.definition is not None:
                markers = tuple((float(x), float(y), float(z)) for x, y, z in port.definition.markers_mm)
            seen.append(SeenTool(handle, port.occupied, port.enabled, pose, status, self.frame_number(index), markers))
        return seen

    def _strays(self, index: int) -> tuple[Point, ...]:
        return ((250.0, -200.0 + 0.25 * (index % 400), -1800.0),)

    # commands

    def receive(self, data: bytes) -> list[bytes]:
        """Take bytes of the line; return a reply for every command that they complete."""
        return [reply for _, reply in self.exchanges(data)]

    def exchanges(self, data: bytes) -> list[tuple[bytes, bytes]]:
        """Take bytes of the line, cut anywhere; return (command, reply) for every command that they complete.

        A command may end with a carriage return, or with a line feed behind it. One that is too long is refused once,
        at its end; nothing of it is kept.
        """
        done = []
        *whole, rest = data.split(b"\r")
        for piece in whole:
            message = (bytes(self._buffer) + piece).lstrip(b"\n")
            too_long = self._too_long or len(message) > _LONGEST_COMMAND
            self.forget_input()
            done.append((message, text_reply("ERROR02") if too_long else self.answer(message)))
        self._buffer += rest
        if len(self._buffer) > _LONGEST_COMMAND:
            self.forget_input()
            self._too_long = True
        return done

    def forget_input(self) -> None:
        """Forget a command that is not complete: the line was cut."""
        self._buffer.clear()
        self._too_long = False

    def answer(self, message: bytes) -> bytes:
        """Answer one command, given without its carriage return."""
        try:
            name, arguments = self._parsed(message)
            method = _COMMANDS.get(name)
            if method is None and name not in _PORT_COMMANDS:
                raise Refused(0x01)
            if not self.initialised and name not in _ANY_TIME:
                raise Refused(0x10)
            if self.tracking and name in _NOT_TRACKING:
                raise Refused(0x0C)
            reply = method(self, arguments) if method else _PORT_COMMANDS[name](self.ports, arguments)
            if name == "PHSR":
                self.system_status &= ~_PORTS_CHANGED
        except Refused as refused:
            reply = f"ERROR{refused.code:02X}"
        return reply if isinstance(reply, bytes) else text_reply(reply)

    @staticmethod
    def _parsed(message: bytes) -> tuple[str, str]:
        """Split a command; the colon form ends with a checksum, the form with a space has none."""
        try:
            text = message.decode("ascii")
        except UnicodeDecodeError:
            raise Refused(0x01) from None
        match = re.match(r"[A-Z0-9]+", text)
        if match is None:
            raise Refused(0x01)
        name, rest = match.group(), text[match.end() :]
        if not rest.startswith(":"):
            if rest and not rest.startswith(" "):
                raise Refused(0x01)
            return name, rest[1:].strip(" ") if name != "ECHO" else rest[1:]
        if len(rest) < 5:
            raise Refused(0x03)
        if f"{crc16(message[:-4]):04X}" != rest[-4:].upper():
            raise Refused(0x04)
        return name, rest[1:-4]

    def _init(self, arguments: str) -> str:
        self.initialised = True
        self.ports.initialise_all()
        return OKAY

    def _reset(self, arguments: str) -> str:
        self.reset()
        return "RESET"

    def _comm(self, arguments: str) -> str:
        if not re.fullmatch(r"[0-7A][01][012][01][01]", arguments):
            raise Refused(0x06 if len(arguments) == 5 else 0x07)
        self.baud_rate = _BAUD_RATES[arguments[0]]
        return OKAY

    def _version(self, arguments: str) -> str:
        part = {"0": "Control", "3": "Tool", "4": "Enhanced", "5": "Combined"}.get(arguments.lstrip("0") or "0")
        if part is None:
            raise Refused(0x23)
        # clients choose between TX and BX by this line, so it names a device that is like this one
        like = "Polaris Vega 008" if self.api_revision >= _KNOWS_BX2 else "Polaris Spectra Rev 007"
        lines = [f"Emulated Tracker {part} Firmware", "NDI S/N: E0-00000", f"Freeze Tag: {like}"]
        return "\n".join([*lines, "Freeze Date: 01/01/26", ""])

    def _get(self, arguments: str) -> str:
        # only the star is special; a regular expression of many stars would take for ever
        pattern = arguments.replace("[", "[[]").replace("?", "[?]")
        lines = [f"{name}={value}\n" for name, value in sorted(self.settings.items()) if fnmatchcase(name, pattern)]
        if not lines:
            raise Refused(0x34)
        return "".join(lines)

    def _set(self, arguments: str) -> str:
        name, equals, value = arguments.partition("=")
        if not equals:
            raise Refused(0x07)
        if name not in self.settings:
            raise Refused(0x34)
        if not name.startswith("Param."):
            raise Refused(0x39)
        self.settings[name] = value
        return OKAY

    def _features(self, arguments: str) -> str:
        answers = {"00": "00000001", "01": "9", "02": "9", "03": "1", "04": "0"}
        if arguments not in answers:
            raise Refused(0x23)
        return answers[arguments]

    def _start(self, arguments: str) -> str:
        if arguments not in ("", "40", "80"):
            raise Refused(0x23)
        self.tracking = True
        if arguments == "80":
            self.first_frame = 0
        self._started_s, self._told = self.clock.now_s(), None
        return OKAY

    def _stop(self, arguments: str) -> str:
        self._must_track()
        self.tracking = False
        return OKAY

    def _must_track(self) -> None:
        if not self.tracking:
            raise Refused(0x0C)

    @staticmethod
    def _options(arguments: str) -> Option:
        if not re.fullmatch(r"[0-9A-Fa-f]{4}|", arguments):
            raise Refused(0x14)
        return Option(int(arguments or "1", 16))

    def _tx(self, arguments: str) -> str:
        self._must_track()
        options, index = self._options(arguments), self.frame_index()
        return tx_text(self._seen(index), options, self._strays(index), self.system_status, self.bare_unoccupied)

    def _bx(self, arguments: str) -> bytes:
        self._must_track()
        options, index = self._options(arguments), self.frame_index()
        return binary_reply(bx_body(self._seen(index), options, self._strays(index), self.system_status))

    def _bx2(self, arguments: str) -> bytes:
        if self.api_revision < _KNOWS_BX2:
            raise Refused(0x01)
        self._must_track()
        options = dict(re.findall(r"--(\w+)=(\w+)", arguments))
        index = self.frame_index()
        tools = None
        if index != self._told:
            tools, self._told = self._seen(index), index
        time_s = 1_700_000_000.0 + self._started_s % 1e6 + index / self.rate_hz
        markers, buttons = options.get("3d", "none"), options.get("1d", "buttons") == "buttons"
        if options.get("6d", "tools") == "none" and tools is not None:
            tools = []
        return binary_reply(bx2_body(tools, self.frame_number(index), time_s, markers, buttons, self._strays(index)))

    def _beep(self, arguments: str) -> str:
        if arguments not in set("123456789"):
            raise Refused(0x23)
        return "1"

    def _apirev(self, arguments: str) -> str:
        return self.api_revision

    def _echo(self, arguments: str) -> str:
        return arguments

    def _system_status(self, arguments: str) -> str:
        """SSTAT: two digits for each part that is asked after; nothing is ever broken here."""
        if not re.fullmatch(r"[0-9A-Fa-f]{4}", arguments):
            raise Refused(0x14)
        return "00" * int(arguments, 16).bit_count()

    def _accept(self, arguments: str) -> str:
        return OKAY


_COMMANDS: dict[str, Callable[[Device, str], str | bytes]] = {
    "APIREV": Device._apirev,
    "BEEP": Device._beep,
    "BX": Device._bx,
    "BX2": Device._bx2,
    "COMM": Device._comm,
    "DSTART": Device._accept,
    "DSTOP": Device._accept,
    "ECHO": Device._echo,
    "GET": Device._get,
    "GETINFO": Device._get,
    "INIT": Device._init,
    "IRATE": Device._accept,
    "LED": Device._accept,
    "RESET": Device._reset,
    "SET": Device._set,
    "SFLIST": Device._features,
    "SSTAT": Device._system_status,
    "TSTART": Device._start,
    "TSTOP": Device._stop,
    "TX": Device._tx,
    "VER": Device._version,
    "VSEL": Device._accept,
}

_PORT_COMMANDS: dict[str, Callable[[Ports, str], str]] = {
    "PDIS": Ports.disable,
    "PENA": Ports.enable,
    "PHF": Ports.free,
    "PHINF": Ports.information,
    "PHRQ": Ports.request,
    "PHSR": Ports.listing,
    "PINIT": Ports.initialise,
    "PVCLR": Ports.clear,
    "PVWR": Ports.write,
}
