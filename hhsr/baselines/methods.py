"""The comparators by name, all called and counted the same way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from hhsr.baselines.distances import mesh_error
from hhsr.errors import InputError
from hhsr.model import ErrorFigures, FloatArray, IntArray
from hhsr.read import Surface

METHODS = ("spherical_harmonics", "rbf_isosurface", "decimated_mesh", "draco")
_Fit = Callable[[FloatArray, IntArray, int, int], tuple[FloatArray, IntArray, int]]


@dataclass(frozen=True, eq=False)
class Baseline:
    """A comparator's fit. vertices, faces: its surface, LPS mm. parameters: stored numbers, a mesh's connectivity free.

    bytes: float32 numbers, and two or four bytes an index where there is connectivity; the real file for Draco.
    seconds: of fitting.
    """

    method: str
    vertices: FloatArray
    faces: IntArray
    parameters: int
    bytes: int
    seconds: float

    def error(self, surface: Surface, samples: int = 20_000, seed: int = 0) -> ErrorFigures:
        """Return its two-sided true distance to the source, mm, as a fit's own figures are measured."""
        return mesh_error(self.vertices, self.faces, surface.vertices, surface.faces, samples, seed)


def fit_baseline(
    method: str, surface: Surface, max_parameters: int, max_bytes: int | None = None, seed: int = 0
) -> Baseline:
    """Fit one of METHODS to a surface with at most `max_parameters` numbers.

    max_bytes : size of Draco's file; None: two bytes a parameter.

    Raises
    ------
    InputError : an unknown method. FitError : too small a budget for the method.
    """
    vertices, faces = surface.vertices, surface.faces
    begun = time.perf_counter()
    if method == "draco":
        from hhsr.baselines.draco_mesh import fit_draco

        points, triangles, parameters, size = fit_draco(vertices, faces, max_bytes or 2 * max_parameters, seed)
    else:
        points, triangles, parameters = _fit_of(method)(vertices, faces, max_parameters, seed)
        size = 4 * parameters
        if method == "decimated_mesh":
            size += (2 if len(points) < 65536 else 4) * triangles.size
    return Baseline(method, points, triangles, parameters, size, time.perf_counter() - begun)


def _fit_of(method: str) -> _Fit:
    """Return a comparator's function; imported when asked for, as they are extras."""
    if method == "spherical_harmonics":
        from hhsr.baselines.spherical_harmonics import fit_spherical_harmonics

        return fit_spherical_harmonics
    if method == "rbf_isosurface":
        from hhsr.baselines.rbf_isosurface import fit_rbf_isosurface

        return fit_rbf_isosurface
    if method == "decimated_mesh":
        from hhsr.baselines.decimated_mesh import fit_decimated_mesh

        return fit_decimated_mesh
    raise InputError(f"method: got {method!r}, expected one of {', '.join(METHODS)}")
