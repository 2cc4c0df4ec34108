"""A scene: what lies in the patient, where the needle should go, what it must stay away from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from guidance.budget import ErrorBudget
from guidance.errors import SceneError
from guidance.needle import Needle
from guidance.scene_file import read_scene_file
from guidance.scene_parts import AVOID, Entry, Structure, Target

__all__ = ["AVOID", "Entry", "Scene", "Structure", "Target"]


@dataclass(frozen=True, eq=False)
class Scene:
    """Target, structures, entry, needle and error budget; everything in LPS, mm.

    Raises
    ------
    SceneError
        If names repeat, or the target's or entry's structure is not there.
    """

    name: str
    structures: tuple[Structure, ...]
    target: Target
    entry: Entry
    needle: Needle
    errors: ErrorBudget = field(default_factory=ErrorBudget)

    def __post_init__(self) -> None:
        names = [s.name for s in self.structures]
        if not names:
            raise SceneError("a scene needs at least one structure")
        for name in {n for n in names if names.count(n) > 1}:
            raise SceneError(f"two structures are called {name!r}; give each its own name")
        for what, wanted in (("target", self.target.structure), ("entry", self.entry.structure)):
            if wanted is not None and wanted not in names:
                raise SceneError(f"{what}: no structure is called {wanted!r}; there are {', '.join(names)}")

    def structure(self, name: str) -> Structure:
        """The structure of that name; SceneError if there is none."""
        for s in self.structures:
            if s.name == name:
                return s
        raise SceneError(f"no structure is called {name!r}; there are {', '.join(s.name for s in self.structures)}")

    @property
    def avoid(self) -> tuple[Structure, ...]:
        """The structures to stay away from."""
        return tuple(s for s in self.structures if s.role == AVOID)

    @property
    def hash(self) -> str:
        """First 16 hex digits of a SHA-256 over everything that a plan or a warning depends on."""
        record = {
            "structures": [[s.name, s.role, s.margin_mm, s.hash] for s in self.structures],
            "target": [self.target.point.tolist(), self.target.tolerance_mm],
            "needle": [self.needle.length_mm, self.needle.radius_mm],
            "errors": self.errors.to_record(),
        }
        return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()[:16]

    @classmethod
    def load(
        cls, path: str | Path, shapes: str | Path | None = None, progress: Callable[[str, Any], None] | None = None
    ) -> Scene:
        """Read a scene file (TOML, see `docs/scene.md`) and fit what is not yet fitted.

        Parameters
        ----------
        path : str or Path
            The scene file; paths inside it are relative to it.
        shapes : str, Path or None
            Folder of the fitted `.hhsr` files, reused while source and options stay the same; beside the scene
            file by default (`NAME.shapes/`).
        progress : callable, optional
            Called with a structure's name and its shape once that is ready.

        Raises
        ------
        SceneError
            If the file is missing, is not TOML, or says something that cannot be used; the message says what to do.
        """
        return cls(*read_scene_file(Path(path), None if shapes is None else Path(shapes), progress))
