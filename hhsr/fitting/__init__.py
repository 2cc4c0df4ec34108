"""From a surface to a tree of superquadrics, scale fields and cuts (PAPER §2.2, §3, §4; DESIGN §3)."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hhsr.fitting.build import fit
    from hhsr.fitting.options import FitOptions

__all__ = ["FitOptions", "fit"]

_ROOMS = {"FitOptions": "options", "fit": "build"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use: `FitOptions` alone needs none of the fit."""
    if name not in _ROOMS:
        raise AttributeError(f"module 'hhsr.fitting' has no attribute {name!r}")
    value = getattr(import_module(f"hhsr.fitting.{_ROOMS[name]}"), name)
    globals()[name] = value
    return value
