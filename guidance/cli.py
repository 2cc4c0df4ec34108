"""The command line: `guidance demo`, `guidance run SCENE.toml`, and the tracker's commands."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from guidance.track import track
from guidance.tracker_emulator import tracker_emulator

if TYPE_CHECKING:
    from guidance.scene import Scene
    from guidance.session import Session
    from guidance.states import Event

app = typer.Typer(
    help="Plan needle paths among organ shapes, follow a tracked needle, and warn before contact.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_BAD_INPUT = 2

OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; made if need be.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of everything random; the same seed, the same files.")]


@app.command()
def demo(out: OutOption = Path("demo"), seed: SeedOption = 0) -> None:
    """Make a synthetic patient, fit it, plan, and simulate a right and a wrong insertion with warnings."""
    from guidance.demo import write_demo

    console = Console()
    with _bad_input_ends():
        out.mkdir(parents=True, exist_ok=True)
        with console.status("making a synthetic patient"):
            scene_file = write_demo(out / "phantom", seed)
        _run(console, scene_file, out, seed)


@app.command()
def run(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML); see docs/scene.md.")],
    out: OutOption = Path("out"),
    seed: SeedOption = 0,
) -> None:
    """Fit a scene's structures, plan, and simulate a right and a wrong insertion with warnings.

    Ends with 0 also where no path is safe (plan.json says which constraint forbids them), with 2 on bad input.
    """
    console = Console()
    with _bad_input_ends():
        _run(console, scene, out, seed)


@contextmanager
def _bad_input_ends() -> Iterator[None]:
    """Turn what the user can mend into one line on the error stream and exit code 2."""
    from devices.errors import DeviceError
    from guidance.errors import GuidanceError
    from hhsr.errors import HhsrError

    try:
        yield
    except (GuidanceError, HhsrError, DeviceError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True)
        raise typer.Exit(_BAD_INPUT) from None


def _run(console: Console, scene_file: Path, out: Path, seed: int) -> None:
    from guidance.scene import Scene

    with console.status(f"fitting the structures of {scene_file}"):
        scene = Scene.load(scene_file, progress=lambda name, shape: console.print(_fitted(name, shape)))
    _session(console, scene, out, seed)


def _session(console: Console, scene: Scene, out: Path, seed: int) -> None:
    from guidance.session import run_session

    with console.status("planning and simulating"):
        session = run_session(
            scene,
            out,
            seed,
            lambda line: console.print(escape(line), highlight=False),
            lambda name, event: console.print(_event(event), highlight=False),
        )
    for line in _summary(session):
        console.print(line, highlight=False)


def _fitted(name: str, shape: Any) -> str:
    mean, _, largest = shape.fit_error
    size = f"{shape.parameters} numbers, {shape.bytes / 1024:.1f} kB"
    return f"  {escape(name)}: {size}, error mean {mean:.2f} mm, largest {largest:.1f} mm"


_COLOURS = {"CLEAR": "green", "APPROACHING": "yellow", "CONTACT": "red", "INSIDE": "bold red", "UNKNOWN": "magenta"}


def _event(event: Event) -> str:
    colour = _COLOURS[event.after.value] if event.alarm or event.after.value == "CLEAR" else "cyan"
    said = f"{escape(event.structure)}: {escape(event.reason)}"
    return f"  {event.time_s:7.2f} s  [{colour}]{event.after.value:<11}[/] {said}"


def _summary(session: Session) -> list[str]:
    lines = []
    for outcome in session.outcomes:
        touched = [w for w in outcome.warnings if w.role == "avoid" and w.truth_s < float("inf")]
        if not touched:
            lines.append(f"{outcome.name} insertion: touched nothing that is to be avoided")
        for w in touched:
            warned = f"warned {w.lead_s:.1f} s before" if w.raised_s <= w.truth_s else "not warned of"
            stated = f"stated {w.stated[0]:.1f} to {w.stated[1]:.1f} s, true {w.truth_s:.1f} s"
            lines.append(f"{outcome.name} insertion: {warned} contact with {escape(w.structure)} ({stated})")
    lines.append(f"results in [bold]{escape(str(session.folder))}[/]: plan.json, events.jsonl, picture.png, *.hhsr")
    return lines


app.command("track")(track)
app.command("tracker-emulator")(tracker_emulator)
