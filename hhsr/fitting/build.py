"""From a surface to a shape: normalise, fit by a recipe, round to what is stored, measure (DESIGN §3)."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from hhsr.errors import InputError
from hhsr.fitting.normalise import normalise
from hhsr.fitting.options import FitOptions
from hhsr.fitting.paper import fit_paper
from hhsr.fitting.recipe import fit_default
from hhsr.fitting.report import leaf_figures, measure
from hhsr.fitting.retain import retained_part
from hhsr.fitting.source import Source
from hhsr.model import FloatArray, IntArray, Node, Provenance, Tree, frozen
from hhsr.read import Surface
from hhsr.shape import Shape


def fit(surface: Surface, options: FitOptions | None = None) -> Shape:
    """Fit a compact shape to an organ's surface, and measure how well it fits.

    Parameters
    ----------
    surface : closed triangles in LPS mm (`hhsr.read_surface`).
    options : what it may cost and how it is made; None: `FitOptions()`.

    Returns
    -------
    Shape : `fit_error`, `leaf_errors` and `report` say how far it is from the source, by two-sided true distance.

    Raises
    ------
    InputError : `surface` is no `Surface`.
    FitError : `max_parameters` cannot hold the least that a tree takes, or what has to be retained.

    The same surface and options give the same shape, on any number of threads.
    """
    if not isinstance(surface, Surface):
        raise InputError(
            f"surface: got {type(surface).__name__}, expected a Surface: hhsr.read_surface(path) or "
            "hhsr.Surface.from_mesh(vertices, faces)"
        )
    options = options if options is not None else FitOptions()
    vertices = np.asarray(surface.vertices, dtype=np.float64)
    faces = np.asarray(surface.faces, dtype=np.int64)
    tree = _kept_whole(vertices, faces) if options.retain else _fitted(vertices, faces, options)
    provenance = Provenance(
        source_hash=surface.source_hash,
        frame=surface.frame,
        label=surface.label,
        options=options.to_json(),
        software=software(),
    )
    shape = Shape(tree, provenance)
    measured = measure(shape, vertices, faces, options.samples, options.seed)
    report = {**measured.report, "leaves": leaf_figures(tree)}
    return Shape(tree, replace(provenance, fit_error=measured.error, leaf_errors=measured.leaf_errors, report=report))


def _kept_whole(vertices: FloatArray, faces: IntArray) -> Tree:
    """Return the tree of one retained part, where it was."""
    return Tree(retained_part(vertices, faces), frozen(np.zeros(6)))


def _fitted(vertices: FloatArray, faces: IntArray, options: FitOptions) -> Tree:
    """Return the fitted tree, its numbers rounded as they are stored."""
    local, pose = normalise(vertices, faces)
    root: Node
    if options.recipe == "paper":
        root = fit_paper(Source(local, faces, options.seed), options)
    else:
        root = fit_default(local, faces, options)
    return Tree(root, frozen(pose))


def software() -> str:
    """Return the software's name and version, as a file keeps it."""
    try:
        return f"hhsr-guidance {version('hhsr-guidance')}"
    except PackageNotFoundError:
        return "hhsr-guidance"
