"""`guidance tracker-emulator`: an NDI tracker without hardware, for any client of a serial port or a socket."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import DeviceError
from devices.ndi.bodies import RecordedBodies, SimulatedBodies
from devices.ndi.device import Device
from devices.ndi.emulator import PtyEmulator, TcpEmulator
from devices.ndi.faults import Faults
from devices.ndi.ports import FIRST_WIRED_HANDLE
from devices.recording import read_recording
from guidance.track import terminated_as_interrupted

__all__ = ["make_emulator", "tracker_emulator"]


def make_emulator(
    pty: bool,
    tcp: int | None,
    link: Path | None,
    tools: int,
    replay: Path | None,
    faults: Faults,
    rate_hz: float,
    wired: bool,
    api_revision: str,
    bare_unoccupied: bool,
    host: str,
) -> tuple[PtyEmulator | TcpEmulator, dict[str, object]]:
    """Make the emulator that the command's options describe, and what the command says of it (path and port follow)."""
    if pty == (tcp is not None):
        raise typer.BadParameter("give either --pty or --tcp PORT")
    bodies = RecordedBodies(read_recording(replay)) if replay is not None else SimulatedBodies(tools, rate_hz)
    device = Device(bodies, None, rate_hz, wired=wired, api_revision=api_revision, bare_unoccupied=bare_unoccupied)
    handles = {f"{FIRST_WIRED_HANDLE + k:02X}": bodies.name(k) for k in range(len(bodies))} if wired else {}
    said: dict[str, object] = {"handles": list(handles), "tools": handles, "rate_hz": rate_hz}
    if tcp is not None:
        return TcpEmulator(device, faults, tcp, host), said
    return PtyEmulator(device, faults, link), said


def tracker_emulator(
    pty: Annotated[bool, typer.Option("--pty", help="Listen on a pseudo-terminal.")] = False,
    tcp: Annotated[int | None, typer.Option(help="Listen on a TCP port; 0 takes a free one.", min=0, max=65535)] = None,
    link: Annotated[Path | None, typer.Option(help="With --pty: keep a symbolic link to the terminal here.")] = None,
    tools: Annotated[int, typer.Option(help="Number of tools on cables; loaded ones come on top.", min=0, max=240)] = 3,
    replay: Annotated[
        Path | None, typer.Option(help="Move the tools as recorded here, one frame after another.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME or NAME=VALUE, any number of times: cut, late, corrupt, duplicate (share of replies), "
            "silence (seconds), disconnect, out-of-volume (every so many tracking replies), wrap."
        ),
    ] = None,
    rate: Annotated[float, typer.Option(help="Frames per second.", min=0.1, max=10_000.0)] = 60.0,
    wired: Annotated[bool, typer.Option(help="Whether tools are plugged in from the start.")] = True,
    api_revision: Annotated[str, typer.Option(help="G.003 and later answer BX2.")] = "G.003.001",
    bare_unoccupied: Annotated[
        bool, typer.Option(help="Layout of UNOCCUPIED in TX: the bare word, or with status and frame behind it.")
    ] = True,
    host: Annotated[str, typer.Option(help="With --tcp: address to listen on.")] = "127.0.0.1",
    seed: Annotated[int, typer.Option(help="Seed of the faults.")] = 0,
) -> None:
    """Emulate an NDI tracker until interrupted; print one JSON line with its path or port once it listens."""
    try:
        with terminated_as_interrupted():
            faults = Faults.parse(fault or [], seed)
            emulator, said = make_emulator(
                pty, tcp, link, tools, replay, faults, rate, wired, api_revision, bare_unoccupied, host
            )
            with emulator:
                where = {"path": emulator.path} if isinstance(emulator, PtyEmulator) else {"port": emulator.port}
                typer.echo(json.dumps(where | {"url": emulator.url} | said))
                threading.Event().wait()
    except KeyboardInterrupt:
        pass
    except DeviceError as error:
        typer.echo(f"tracker-emulator: {error}", err=True)
        raise typer.Exit(2) from None
