"""The port handles of an emulated tracker: asked for, loaded, initialised, enabled, freed."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from devices.errors import DeviceInputError
from devices.ndi.replies import ENABLED, INITIALISED
from devices.ndi.rom import ToolDefinition, read_rom

__all__ = ["FIRST_WIRED_HANDLE", "OKAY", "Port", "Ports", "Refused"]

FIRST_WIRED_HANDLE = 0x0A
OKAY = "OKAY"


class Refused(Exception):
    """The device answers ERRORxx."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:02X}")
        self.code = code


@dataclass
class Port:
    """A port handle of the emulated device."""

    body: int
    wired: bool
    occupied: bool = True
    initialised: bool = False
    enabled: bool = False
    memory: bytearray = field(default_factory=bytearray)
    definition: ToolDefinition | None = None
    switches: int = 0
    part_number: str = ""

    @property
    def status(self) -> int:
        """Status bits as PHSR, TX and BX tell them."""
        status = (1 if self.occupied else 0) | self.switches << 1
        return status | (INITIALISED if self.initialised else 0) | (ENABLED if self.enabled else 0)


class Ports:
    """All port handles of a device, with the commands that work on them.

    Parameters
    ----------
    wired : sequence of str
        Part numbers of the tools on cables; their handles count from 0A.
    """

    def __init__(self, wired: Sequence[str]) -> None:
        self.handles = {FIRST_WIRED_HANDLE + k: Port(k, True, part_number=name) for k, name in enumerate(wired)}

    def initialise_all(self) -> None:
        """INIT: free what was loaded, and set wired tools back."""
        self.handles = {handle: port for handle, port in self.handles.items() if port.wired}
        for port in self.handles.values():
            port.initialised = port.enabled = False

    def get(self, text: str) -> Port:
        """Port of a handle given in hexadecimal."""
        if not re.fullmatch(r"[0-9A-Fa-f]{2}", text):
            raise Refused(0x08)
        try:
            return self.handles[int(text, 16)]
        except KeyError:
            raise Refused(0x2B) from None

    def listing(self, arguments: str) -> str:
        """PHSR: handles and their status, all or those that wait for a step."""
        wanted: dict[str, Callable[[Port], bool]] = {
            "00": lambda port: True,
            "01": lambda port: not port.occupied,
            "02": lambda port: port.occupied and not port.initialised,
            "03": lambda port: port.initialised and not port.enabled,
            "04": lambda port: port.enabled,
        }
        if (arguments or "00") not in wanted:
            raise Refused(0x23)
        chosen = [(h, p) for h, p in sorted(self.handles.items()) if wanted[arguments or "00"](p)]
        return f"{len(chosen):02X}" + "".join(f"{h:02X}{p.status:03X}" for h, p in chosen)

    def request(self, arguments: str) -> str:
        """PHRQ: a new handle for a tool to be loaded."""
        if not re.fullmatch(r".{8}[*0-9A-F][*01]..(..)?|", arguments):
            raise Refused(0x07)
        wireless = [handle for handle, port in self.handles.items() if not port.wired]
        free = next((handle for handle in range(1, 0x100) if handle not in self.handles), None)
        if free is None:
            raise Refused(0x2D)
        taken = {self.handles[handle].body for handle in wireless}
        body = next(k for k in range(len(taken) + 1) if k not in taken)
        self.handles[free] = Port(body, wired=False)
        return f"{free:02X}"

    def write(self, arguments: str) -> str:
        """PVWR: 64 bytes of a tool definition."""
        port = self.get(arguments[:2])
        if len(arguments) != 2 + 4 + 128:
            raise Refused(0x03 if len(arguments) < 134 else 0x02)
        if not re.fullmatch(r"[0-9A-Fa-f]{132}", arguments[2:]):
            raise Refused(0x14)
        address, piece = int(arguments[2:6], 16), bytes.fromhex(arguments[6:])
        if address + 64 > 1024:
            raise Refused(0x23)
        port.memory.extend(bytes(max(0, address + 64 - len(port.memory))))
        port.memory[address : address + 64] = piece
        port.initialised = port.enabled = False
        return OKAY

    def clear(self, arguments: str) -> str:
        """PVCLR: forget the tool definition."""
        self.get(arguments[:2]).memory.clear()
        return OKAY

    def free(self, arguments: str) -> str:
        """PHF: give a handle back."""
        self.get(arguments)
        del self.handles[int(arguments, 16)]
        return OKAY

    def initialise(self, arguments: str) -> str:
        """PINIT: a loaded tool must have a whole definition."""
        port = self.get(arguments)
        if not port.occupied:
            raise Refused(0x2C)
        if not port.wired:
            if not port.memory:
                raise Refused(0x0D)
            try:
                port.definition = read_rom(bytes(port.memory))
            except DeviceInputError:
                raise Refused(0x13) from None
        port.initialised = True
        return OKAY

    def enable(self, arguments: str) -> str:
        """PENA."""
        port = self.get(arguments[:2])
        if arguments[2:] not in ("S", "D", "B", ""):
            raise Refused(0x09)
        if not port.initialised:
            raise Refused(0x0E)
        port.enabled = True
        return OKAY

    def disable(self, arguments: str) -> str:
        """PDIS."""
        port = self.get(arguments)
        if not port.enabled:
            raise Refused(0x0F)
        port.enabled = False
        return OKAY

    def information(self, arguments: str) -> str:
        """PHINF: fields of fixed width, as many as asked for."""
        port = self.get(arguments[:2])
        if not re.fullmatch(r"[0-9A-Fa-f]{4}|", arguments[2:]):
            raise Refused(0x14)
        wanted = int(arguments[2:] or "1", 16)
        if not port.occupied:
            return "UNOCCUPIED"
        name = port.definition.manufacturer if port.definition else "EMULATOR"
        number = port.definition.part_number if port.definition else port.part_number
        handle, wireless = int(arguments[:2], 16), int(not port.wired)
        parts = {
            # type, switches, LEDs, reserved, subtype, maker, revision, serial number, status
            0x01: f"02000000{name:<12.12}001{handle:08X}{port.status & 0xFF:02X}",
            0x02: "0" * 8,
            0x04: f"{number:<20.20}",
            0x08: "00",
            0x10: "29",
            # device, system, wired or wireless, port, channel
            0x20: f"000000000{wireless}{handle:02X}00",
            0x40: "00",
        }
        return "".join(text for bit, text in parts.items() if wanted & bit)
