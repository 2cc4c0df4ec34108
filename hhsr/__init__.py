"""Where is the organ? Fit, store and query compact organ shapes (HHSR). LPS, millimetres."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hhsr.answers import Crossings
    from hhsr.errors import FileFormatError, FitError, HhsrError, InputError, SurfaceError
    from hhsr.fitting import FitOptions, fit
    from hhsr.read import Surface, read_surface
    from hhsr.shape import Shape, load
    from hhsr.shape_set import ShapeSet

_DOOR = {
    "Crossings": "answers",
    "FileFormatError": "errors",
    "FitError": "errors",
    "FitOptions": "fitting",
    "HhsrError": "errors",
    "InputError": "errors",
    "Shape": "shape",
    "ShapeSet": "shape_set",
    "Surface": "read",
    "SurfaceError": "errors",
    "fit": "fitting",
    "load": "shape",
    "read_surface": "read",
}

__all__ = [
    "Crossings",
    "FileFormatError",
    "FitError",
    "FitOptions",
    "HhsrError",
    "InputError",
    "Shape",
    "ShapeSet",
    "Surface",
    "SurfaceError",
    "fit",
    "load",
    "read_surface",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `import hhsr` costs nothing."""
    if name not in _DOOR:
        raise AttributeError(f"module 'hhsr' has no attribute {name!r}")
    value = getattr(import_module(f"hhsr.{_DOOR[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
