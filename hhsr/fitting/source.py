"""The shape that a fit has to follow: its triangles on their own axes, a tree over them, samples by area."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from hhsr.fitting.options import FitOptions
from hhsr.fitting.samples import Samples, area_samples, face_areas
from hhsr.fitting.split import Part
from hhsr.model import FloatArray, IntArray
from hhsr.triangle_tree import TriangleTree

FIT_SAMPLES = 30_000
CAP_SAMPLES = 400


class Source:
    """A closed surface on its own axes (see `normalise`), with what every step of a fit asks of it.

    Parameters
    ----------
    vertices, faces : (n, 3) mm, (m, 3) closed outward triangles.
    seed : of the samples.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray, seed: int = 0, samples: int = FIT_SAMPLES) -> None:
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        self.tree = TriangleTree(self.vertices, self.faces)
        self.samples: Samples = area_samples(self.vertices, self.faces, samples, seed)
        self._inside: dict[int, tuple[Part, IntArray]] = {}
        self._caps: dict[int, tuple[Part, FloatArray, float]] = {}

    @cached_property
    def area_mm2(self) -> float:
        return float(face_areas(self.vertices, self.faces).sum())

    @cached_property
    def extent_mm(self) -> float:
        """Longest side of the bounding box."""
        return float(np.ptp(self.vertices[np.unique(self.faces)], axis=0).max())

    @property
    def root(self) -> Part:
        """The whole as a part without planes."""
        return Part(self.vertices, self.faces)

    def inside(self, part: Part) -> IntArray:
        """Return the indices of the samples in the part's region; kept, as many steps ask for the same part."""
        known = self._inside.get(id(part))
        if known is None or known[0] is not part:
            known = part, np.flatnonzero(part.holds(self.samples.points))
            self._inside[id(part)] = known
        return known[1]

    def cap_samples(self, part: Part) -> tuple[FloatArray, float]:
        """Return points (n, 3) spread over the solid's sections that bound a part, and the mm² that each stands for."""
        known = self._caps.get(id(part))
        if known is None or known[0] is not part:
            faces = part.faces[part.capped()] if part.planes else part.faces[:0]
            area = float(face_areas(part.vertices, faces).sum())
            points = area_samples(part.vertices, faces, CAP_SAMPLES).points if area > 0.0 else np.zeros((0, 3))
            known = part, points, area / CAP_SAMPLES
            self._caps[id(part)] = known
        return known[1], known[2]


def threshold_mm(source: Source, options: FitOptions) -> float:
    """Return t in mm: as asked, or 1/40 of the longest side."""
    return options.t_mm if options.t_mm is not None else source.extent_mm / 40.0
