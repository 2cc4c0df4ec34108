"""Sources into shapes: fitted once, kept beside the scene as `.hhsr`, reused while source and options are the same."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from guidance.errors import SceneError

if TYPE_CHECKING:
    from hhsr import Shape

RECIPE = 1  # raise when the same options should be fitted anew


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


def fitted_shapes(
    sources: Sequence[ShapeSource], folder: Path, progress: Callable[[str, Any], None] | None = None
) -> dict[str, Shape]:
    """Load or fit every source.

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
    for source in sources:
        shapes[source.name] = _shape(source, folder)
        if progress is not None:
            progress(source.name, shapes[source.name])
    return shapes


def _shape(source: ShapeSource, folder: Path) -> Shape:
    import hhsr

    try:
        if source.ready:
            return hhsr.load(source.file)
        kept = folder / f"{_file_name(source.name)}-{source.digest()}.hhsr"
        if kept.is_file():
            with contextlib.suppress(hhsr.HhsrError):  # a damaged or older file: fit again
                return hhsr.load(kept)
        shape = _fit(source)
    except (hhsr.HhsrError, OSError) as error:
        raise SceneError(f"structure {source.name!r} ({source.file.name}): {error}") from error
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".gitignore").write_text("*\n", encoding="utf-8")
        shape.save(kept)
    return shape


def _fit(source: ShapeSource) -> Shape:
    import hhsr

    options: dict[str, Any] = {}
    if source.retain:
        options["retain"] = True
    if source.max_parameters is not None:
        options["max_parameters"] = source.max_parameters
    reading: dict[str, Any] = {"force": source.force}
    for key in ("frame", "unit", "label"):
        if getattr(source, key) is not None:
            reading[key] = getattr(source, key)
    return hhsr.fit(hhsr.read_surface(source.file, **reading), hhsr.FitOptions(**options))


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
