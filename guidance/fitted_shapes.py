"""Sources into shapes: fitted once, kept beside the scene as `.hhsr`, reused while source and options are the same."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import TYPE_CHECKING, Any

from guidance.errors import SceneError

if TYPE_CHECKING:
    from hhsr import Shape

RECIPE = 5  # raise when the same options should be fitted anew
_HHSR = "from hhsr.cli import app; app()"  # the command by this interpreter, wherever its script lies
# It imports what this process imports: by itself an interpreter looks into the folder that it is called from first.
_SAME_PATH = "import sys; sys.path[:] = {!r}; "


@dataclass(frozen=True)
class ShapeSource:
    """Where a structure's shape comes from, and how it is to be fitted."""

    name: str
    file: Path
    ready: bool = False
    frame: str | None = None
    unit: str | None = None
    label: int | None = None
    max_parameters: int | None = None
    retain: bool = False
    force: bool = False

    @property
    def key(self) -> str:
        """The scene file's key for the file."""
        return "shape" if self.ready else "labels" if self.label is not None else "mesh"

    def digest(self) -> str:
        """16 hex digits over the file's bytes and every option that changes the fit."""
        options = [self.frame, self.unit, self.label, self.max_parameters, self.retain, self.force, RECIPE]
        state = hashlib.sha256(json.dumps(options).encode())
        state.update(self.file.read_bytes())
        return state.hexdigest()[:16]

    @property
    def kept_name(self) -> str:
        """File name of the fitted shape: readable, and another one when source or options change."""
        plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in self.name)
        return f"{plain}-{self.digest()}.hhsr"


class _Commands:
    """Commands `hhsr …` that run in processes of their own; once stopped, none goes on and none begins."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[str]] = set()
        self._lock = Lock()
        self._stopped = False

    def run(self, *words: str) -> tuple[int, list[str]]:
        """Run a command by this interpreter; return its exit code and the lines of what it said."""
        command = [sys.executable, "-c", _SAME_PATH.format(sys.path) + _HHSR, *words]
        with self._lock:
            if self._stopped:
                return 1, ["stopped before it began"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            self._running.add(process)
        out, errors = process.communicate()
        with self._lock:
            self._running.discard(process)
        return process.returncode, (errors.strip() or out.strip()).splitlines()

    def stop(self) -> None:
        """End what runs: another structure has failed, and nobody will ask for the rest."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.terminate()


def fitted_shapes(
    sources: Sequence[ShapeSource], folder: Path, progress: Callable[[str, Any], None] | None = None
) -> dict[str, Shape]:
    """Load or fit every source; fits of models run side by side in processes of their own.

    Parameters
    ----------
    sources : sequence of ShapeSource
    folder : Path
        Where fitted shapes are kept; a folder that cannot be written costs the reuse, not the result.
    progress : callable, optional
        Called with (name, shape) as each is ready.

    Raises
    ------
    SceneError
        If a source cannot be read or fitted, naming it and the reason.
    """
    shapes: dict[str, Shape] = {}

    def ready(source: ShapeSource, shape: Shape) -> None:
        shapes[source.name] = shape
        if progress is not None:
            progress(source.name, shape)

    to_fit = []
    for source in sources:
        kept = _kept(source, folder)
        if kept is None:
            to_fit.append(source)
        else:
            ready(source, kept)
    models = sorted((s for s in to_fit if not s.retain), key=_effort, reverse=True)
    apart = models if len(models) > 1 and _cores() > 1 else []
    commands = _Commands()
    with ThreadPoolExecutor(_cores()) as pool, TemporaryDirectory() as room:
        fits = {}
        for k, source in enumerate(apart):
            fits[pool.submit(_fit_apart, commands, source, Path(room) / f"{k}.hhsr")] = source
            if k == 0:  # the first fit compiles what fits need; beside it, what the queries afterwards need
                pool.submit(commands.run, "warm-up")
        try:
            for source in (s for s in to_fit if s not in apart):
                ready(source, _keep(source, _fit(source), folder))
            for done in as_completed(fits):
                ready(fits[done], _keep(fits[done], done.result(), folder))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            commands.stop()
            raise
    return {s.name: shapes[s.name] for s in sources}


def _effort(source: ShapeSource) -> float:
    """What a fit will cost, roughly, so that the longest starts first."""
    return float(source.max_parameters or 0) * source.file.stat().st_size


def _cores() -> int:
    return os.cpu_count() or 1


def _kept(source: ShapeSource, folder: Path) -> Shape | None:
    """The shape of a source that needs no fit: given as one, or fitted before."""
    import hhsr

    if source.ready:
        try:
            return hhsr.load(source.file)
        except (hhsr.HhsrError, OSError) as error:
            raise SceneError(f"structure {source.name!r} ({source.file.name}): {error}") from error
    kept = folder / source.kept_name
    if kept.is_file():
        with contextlib.suppress(hhsr.HhsrError):  # a damaged or older file: fit again
            return hhsr.load(kept)
    return None


def _keep(source: ShapeSource, shape: Shape, folder: Path) -> Shape:
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".gitignore").write_text("*\n", encoding="utf-8")
        shape.save(folder / source.kept_name)
    return shape


def _fit(source: ShapeSource) -> Shape:
    """Fit in this process."""
    import hhsr

    options: dict[str, Any] = {"retain": source.retain}
    if source.max_parameters is not None:
        options["max_parameters"] = source.max_parameters
    reading: dict[str, Any] = {"frame": source.frame, "unit": source.unit, "label": source.label}
    try:
        surface = hhsr.read_surface(source.file, force=source.force, **reading)
        return hhsr.fit(surface, hhsr.FitOptions(**options))
    except (hhsr.HhsrError, OSError) as error:
        raise SceneError(f"structure {source.name!r} ({source.file.name}): {error}") from error


def _fit_apart(commands: _Commands, source: ShapeSource, out: Path) -> Shape:
    """Fit by the command `hhsr fit` in a process of its own: fits hold the interpreter, threads would wait."""
    import hhsr

    command = ["fit", str(source.file), "-o", str(out)]
    for flag, value in (
        ("--frame", source.frame),
        ("--unit", source.unit),
        ("--label", source.label),
        ("--max-parameters", source.max_parameters),
    ):
        if value is not None:
            command += [flag, str(value)]
    if source.force:
        command.append("--force")
    code, said = commands.run(*command)
    if code != 0:
        reason = " ".join(line.strip() for line in said[-6:])
        raise SceneError(f"structure {source.name!r} ({source.file.name}): {reason or 'hhsr fit failed'}")
    return hhsr.load(out)
