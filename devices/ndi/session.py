"""Talk to an NDI tracker over a line: ask, wake it up, agree on a speed, load its tools."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from threading import Event

from devices.errors import DeviceInputError, ProtocolError, TrackerError, TransportError
from devices.ndi.protocol import BinaryReply, CrcError, ErrorReply, ReplyReader, TextReply, command, refusal
from devices.ndi.rom import ToolDefinition
from devices.ndi.text_replies import decode_handles
from devices.tracker import LineCounters
from devices.transport import Line

__all__ = ["Interrupted", "Session", "SilentLine"]

#: speeds in the order in which they are tried, with the digit that COMM wants
SPEEDS = {921600: "6", 230400: "A", 115200: "5", 57600: "4", 38400: "3", 19200: "2"}
_PAUSE_S = 0.003
_HANDLES = "[0-9A-F]{2}([0-9A-F]{5})*"
_SLOW = ("INIT", "PINIT", "TSTART")
_SLICE_S = 0.05
_RESET_S = 7.0
_BREAK_S = 1.0
_NOT_ALLOWED_NOW = 0x0C
_NOT_ALLOCATED = 0x2B


class SilentLine(TransportError):
    """No reply came in time."""


class Interrupted(TransportError):
    """The tracker was stopped while it waited."""


class Session:
    """One conversation with a tracker.

    Parameters
    ----------
    line : Line
    counters : LineCounters
        Told of bad checksums, bad replies and missing ones.
    interrupt : Event
        Set by `Tracker.stop`; ends every wait within 50 ms.
    patience_s : float
        How long a command may take that does not say otherwise; INIT, PINIT and TSTART get 2.5 times as long.
    """

    def __init__(self, line: Line, counters: LineCounters, interrupt: Event, patience_s: float = 2.0) -> None:
        self.line, self.counters, self._interrupt, self._patience_s = line, counters, interrupt, patience_s
        self._reader = ReplyReader()
        self.speed = 9600

    # asking

    def ask(self, name: str, arguments: str = "", timeout_s: float | None = None, closing: bool = False) -> str | bytes:
        """Send a command and return its reply: text, or the body of a binary reply.

        Parameters
        ----------
        name, arguments : str
        timeout_s : float or None
            Longest wait for the whole reply, s; the session's patience by default.
        closing : bool
            Whether an interrupt is to be ignored: the last words of a session.

        Raises
        ------
        TrackerError
            Where the device refuses.
        ProtocolError
            Where the reply is damaged; the line has fallen silent since, so one may ask again.
        SilentLine, TransportError
            Where nothing came in time, or the line is lost, or the device says that it was reset.
        """
        asked = f"{name}:{arguments}" if len(arguments) <= 24 else f"{name}:{arguments[:24]}…"
        if timeout_s is None:
            timeout_s = self._patience_s * (2.5 if name in _SLOW else 1.0)
        self._reader.clear()
        self.line.drop_input()
        self.line.write(command(name, arguments))
        for _ in range(max(1, round(timeout_s / _SLICE_S))):
            for reply in self._reader.feed(self.line.read(_SLICE_S)):
                return self._opened(asked, reply)
            if self._interrupt.is_set() and not closing:
                raise Interrupted(f"{self.line}: stopped while waiting for the answer to {asked}")
        self.counters.timeouts += 1
        raise SilentLine(f"{self.line}: no answer to {asked} within {timeout_s:g} s")

    def _opened(self, asked: str, reply: TextReply | ErrorReply | BinaryReply | ProtocolError) -> str | bytes:
        if isinstance(reply, TextReply):
            if reply.text == "RESET" and not asked.startswith("RESET"):
                raise TransportError(f"{self.line}: the tracker was reset")
            return reply.text
        if isinstance(reply, BinaryReply):
            return reply.body
        if isinstance(reply, ErrorReply):
            raise refusal(asked, reply)
        if isinstance(reply, CrcError):
            self.counters.crc_errors += 1
        else:
            self.counters.malformed += 1
        self.settle()
        raise reply

    def settle(self) -> None:
        """Read until nothing has come for 50 ms, at most 0.5 s: the rest of a damaged reply must not be an answer."""
        for _ in range(10):
            if not self.line.read(_SLICE_S):
                break
        self._reader.clear()

    def ask_text(self, name: str, arguments: str = "", form: str = ".*", done: int | None = None) -> str:
        """Ask for text of a form (a pattern); damaged, missing and foreign replies are asked for again, thrice in all.

        A refusal is believed the second time only: the first may be the late copy of an answer to something else.
        `done` is the error code by which a device refuses to do again what it has done: the second time it says OKAY.
        """
        failure: ProtocolError | SilentLine | TrackerError | None = None
        for _ in range(3):
            self._interrupt.wait(_PAUSE_S)  # a late copy of the last reply comes now, and is dropped
            try:
                reply = self.ask(name, arguments)
            except (ProtocolError, SilentLine) as error:
                failure = error
                continue
            except TrackerError as error:
                if failure is not None and error.code == done:
                    return "OKAY"
                if isinstance(failure, TrackerError):
                    raise
                failure = error
                self.settle()
                continue
            if isinstance(reply, str) and re.fullmatch(form, reply, re.DOTALL):
                return reply
            failure = ProtocolError(f"{name}:{arguments[:24]}: expected {form}, got {reply[:60]!r}")
            self.settle()
        assert failure is not None
        raise failure

    def order(self, name: str, arguments: str = "", done: int | None = None) -> None:
        """Ask for something to be done; `done` as in `ask_text`."""
        self.ask_text(name, arguments, "OKAY|WARNING.*", done)

    def start_tracking(self) -> None:
        """Start tracking."""
        self.order("TSTART", done=_NOT_ALLOWED_NOW)

    def stop_tracking(self) -> None:
        """Stop tracking, to go on with something else."""
        self.order("TSTOP", done=_NOT_ALLOWED_NOW)

    # waking

    def wake(self) -> None:
        """Bring the device from any state (fresh, tracking, another speed, mid-command) to initialised, 9600 baud."""
        self.line.open()
        self.speed = 9600
        self.settle()
        try:
            self._initialise()
        except (SilentLine, ProtocolError, TrackerError):
            self.reset()
            self._initialise()

    def _initialise(self) -> None:
        try:
            self.order("INIT")
        except TrackerError as error:
            if error.code != _NOT_ALLOWED_NOW:
                raise
            self.stop_tracking()
            self.order("INIT")

    def reset(self) -> None:
        """Reset by a break where the line has one, and by the text RESET where no answer comes.

        A break passes unseen on a pseudo-terminal, so having sent one says nothing.
        """
        self._reader.clear()
        self.line.drop_input()
        if self.line.send_break() and self._was_reset(_BREAK_S):
            return
        for speed in dict.fromkeys((9600, self.speed)) if self.line.has_speed else (9600,):
            if self.line.has_speed:
                self.line.set_speed(speed)
            # the carriage return ends whatever half command lies in the device
            self.line.write(b"\rRESET \r")
            if self._was_reset(_BREAK_S):
                break
        else:
            if not self._was_reset(_RESET_S - 2.0 * _BREAK_S):
                raise SilentLine(
                    f"{self.line}: no sign of a tracker, also after a reset; is it on, is it the right port?"
                )
        if self.line.has_speed:
            self.line.set_speed(9600)
        self.speed = 9600

    def _was_reset(self, timeout_s: float) -> bool:
        for _ in range(round(timeout_s / _SLICE_S)):
            if any(reply == TextReply("RESET") for reply in self._reader.feed(self.line.read(_SLICE_S))):
                return True
            if self._interrupt.is_set():
                raise Interrupted(f"{self.line}: stopped during a reset")
        return False

    # speed

    def agree_on_speed(self, wanted: int, wait: Callable[[float], None]) -> None:
        """Raise the speed to `wanted`, or to the next lower one that both ends can do.

        Parameters
        ----------
        wanted : int
            Baud.
        wait : callable
            Waits so many seconds: devices switch a little after their OKAY.
        """
        if not self.line.has_speed:
            return
        for speed, digit in SPEEDS.items():
            if speed <= wanted and self._switch(speed, digit, wait):
                return

    def _switch(self, speed: int, digit: str, wait: Callable[[float], None]) -> bool:
        previous = self.speed
        try:
            self.line.set_speed(speed)  # first of all: can this machine do it?
            self.line.set_speed(previous)
            self.order("COMM", f"{digit}0000")
        except (DeviceInputError, TrackerError):
            return False
        self.line.set_speed(speed)
        self.speed = speed
        wait(0.1)
        try:
            self.ask_text("VER", "0")
        except TrackerError:
            pass  # it answered, and that at the new speed
        except (SilentLine, ProtocolError):
            self.reset()
            self._initialise()
            return False
        return True

    # tools

    def interface_version(self) -> int:
        """Major version of the device's interface; 0 where it does not tell."""
        for name, arguments in (("APIREV", ""), ("GET", "Features.Firmware.API Revision")):
            try:
                found = re.search(r"[A-Z]\.(\d+)\.", self.ask_text(name, arguments))
            except TrackerError:
                continue
            if found:
                return int(found.group(1))
        return 0

    def free_stale(self) -> None:
        """Free handles of tools that are gone, and of tools that an earlier session loaded."""
        for handle, _ in decode_handles(self.ask_text("PHSR", "01", _HANDLES)):
            self.order("PHF", f"{handle:02X}", done=_NOT_ALLOCATED)
        for handle, _ in decode_handles(self.ask_text("PHSR", "00", _HANDLES)):
            try:
                location = self.ask_text("PHINF", f"{handle:02X}0020", ".{14}|UNOCCUPIED")
            except TrackerError:
                continue
            # device (8), system, 0 on a cable or 1 wireless, port (2), channel (2)
            if len(location) == 14 and location[9] == "1":
                self.order("PHF", f"{handle:02X}", done=_NOT_ALLOCATED)

    def load(self, definition: ToolDefinition) -> int:
        """Load a tool definition into a new port handle, initialise and enable it; return the handle."""
        self.settle()  # asked only once: each request takes another handle
        reply = self.ask("PHRQ", "*********1****")
        if not isinstance(reply, str) or not re.fullmatch(r"[0-9A-F]{2}", reply):
            raise ProtocolError(f"PHRQ: expected a handle, got {reply[:20]!r}")
        for address, piece in definition.chunks:
            self.order("PVWR", f"{reply}{address:04X}{piece.hex().upper()}")
        self.order("PINIT", reply)
        self.order("PENA", f"{reply}D")
        return int(reply, 16)

    def enable_wired(self, known: Sequence[int]) -> dict[int, str]:
        """Initialise and enable what is plugged in; return names (part numbers) of handles that are not `known`.

        Initialising one tool may show another handle (two sensors in one plug), so it is repeated until none waits.
        A tool that cannot be initialised is left out.
        """
        found: dict[int, str] = {}
        failed: set[int] = set()
        for _ in range(8):
            waiting = [
                handle for handle, _ in decode_handles(self.ask_text("PHSR", "02", _HANDLES)) if handle not in failed
            ]
            if not waiting:
                break
            for handle in waiting:
                try:
                    self.order("PINIT", f"{handle:02X}")
                except TrackerError:
                    failed.add(handle)
        for handle, _ in decode_handles(self.ask_text("PHSR", "03", _HANDLES)):
            self.order("PENA", f"{handle:02X}D")
        for handle, _ in decode_handles(self.ask_text("PHSR", "04", _HANDLES)):
            if handle not in known:
                found[handle] = self._part_number(handle)
        return found

    def _part_number(self, handle: int) -> str:
        try:
            name = self.ask_text("PHINF", f"{handle:02X}0004", ".{20}|UNOCCUPIED").strip()
        except TrackerError:
            name = ""
        return name or f"port-{handle:02X}"

    def close(self, tracking: bool) -> None:
        """End tracking, return to 9600 baud and close; a silent line costs at most 0.2 s."""
        if not self.line.is_open:
            return
        try:
            if tracking:
                self.ask("TSTOP", timeout_s=0.15, closing=True)
            if self.speed != 9600:
                self.ask("COMM", "00000", timeout_s=0.15, closing=True)
        except (TransportError, ProtocolError, TrackerError):
            pass  # what does not answer cannot be stopped more cleanly
        finally:
            self.line.close()
