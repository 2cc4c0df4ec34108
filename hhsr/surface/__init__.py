"""Rebuild the surface of a tree as one closed mesh (PAPER Algorithm 2)."""

from __future__ import annotations

from hhsr.surface.assembly import reconstruct
from hhsr.surface.sources import Patch, Retained, Source, Step, Strip

__all__ = ["Patch", "Retained", "Source", "Step", "Strip", "reconstruct"]
