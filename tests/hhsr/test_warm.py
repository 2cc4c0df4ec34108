"""After `hhsr warm-up`, no query of any kind of shape waits for the compiler."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from typing import Any

import numpy as np
from typer.testing import CliRunner

import hhsr
import hhsr.kernels
from hhsr.cli import app
from hhsr.model import RetainedPart, leaves
from tests.strategies import random_tree


def compiled_kernels() -> dict[str, list[Any]]:
    """Return the signatures of every kernel that Python has called in this process, or that was compiled in it."""
    found = {}
    for module in pkgutil.iter_modules(hhsr.kernels.__path__):
        for name, kernel in vars(import_module(f"hhsr.kernels.{module.name}")).items():
            if hasattr(kernel, "signatures"):
                found[f"{module.name}.{name}"] = list(kernel.signatures)
    return found


def test_nothing_is_left_to_compile() -> None:
    result = CliRunner().invoke(app, ["warm-up"])
    assert result.exit_code == 0, result.output
    assert "compiled" in result.output
    before = compiled_kernels()
    assert before["distance.nearest_many"]
    shape = hhsr.Shape(random_tree(7, depth=2, bands=True, parts=True))
    assert any(isinstance(leaf, RetainedPart) for leaf in leaves(shape.tree.root))
    start, end = np.array([-90.0, 3.0, 2.0]), np.array([90.0, -4.0, 5.0])
    for a, b in ((start, end), (start[None], end[None])):
        shape.contains(a)
        shape.field(a)
        shape.signed_distance(a)
        shape.closest_point(a)
        shape.crossings(a, b)
        shape.first_crossing(a, b)
        shape.clearance(a, b, 1.0)
        shape.closest_approach(a, b)
        shape.profile(a, b)
    assert compiled_kernels() == before
