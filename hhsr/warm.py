"""The query kernels, compiled ahead: once on a machine, into the compiler's cache, so that no later program waits."""

from __future__ import annotations

import numpy as np

from hhsr.model import Contour, Cut, ModelLeaf, RetainedPart, ScaleField, Superquadric, Tree, frozen
from hhsr.shape import Shape


def warm_up() -> None:
    """Compile every kernel that queries call, or find it compiled: minutes at first, seconds afterwards.

    The same machine code serves every shape: what is asked here is half a ball, a band, and a tetrahedron.
    """
    _every_record().warm_up()


def _every_record() -> Shape:
    """Return a shape of some 10 mm that holds each kind of record there is."""
    ball = ModelLeaf(frozen(np.zeros(3)), frozen([]), Superquadric(frozen(np.full(6, 10.0))), ScaleField.none())
    corners = [[-8.0, -8.0, -2.0], [8.0, -8.0, -2.0], [0.0, 8.0, -2.0], [0.0, 0.0, 10.0]]
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    part = RetainedPart(frozen(corners), frozen(faces, np.int64))
    lobe = Contour(frozen([0.0, 0.0]), frozen(np.full(4, 9.0)))
    upwards = frozen([0.0, np.pi / 2.0])
    return Shape(Tree(Cut(upwards, 0.0, 0.5, (lobe,), ball, part), frozen(np.zeros(6))))
