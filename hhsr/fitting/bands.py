"""Bands: the blend of two parts across their cut, where it is valid (DESIGN §2)."""

from __future__ import annotations

from typing import Any

from hhsr.fitting.options import FitOptions
from hhsr.fitting.source import Source
from hhsr.model import Node


def band_reserve(root: Any, source: Source, options: FitOptions) -> int:
    """Return how many numbers to keep free for contours."""
    return 0


def add_bands(tree: Node, source: Source, options: FitOptions, room: int | None) -> Node:
    """Return the tree with bands."""
    return tree
