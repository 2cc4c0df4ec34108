"""An organ's boundary as closed triangles in LPS millimetres: what a fit starts from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from hhsr.errors import InputError, SurfaceError
from hhsr.model import FloatArray, IntArray, frozen
from hhsr.read.frames import matrix_to_lps, to_lps
from hhsr.read.label_map import LABEL_SUFFIXES, read_label_map, surface_of_labels
from hhsr.read.mesh_file import parse_mesh
from hhsr.read.point_cloud import surface_of_points
from hhsr.read.quality import QualityReport
from hhsr.read.repair import close

UNITS_MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
SHORTEST_MM, LONGEST_MM = 5.0, 2500.0


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface, facing outward, and where it comes from.

    vertices: (n, 3) mm, LPS. faces: (m, 3). frame: of the source as read, an orientation code; "LPS": nothing was
    flipped. label: of a label map. source_hash: SHA-256 (hex) of the file, or of the arrays. quality: what was found
    and repaired. Several bodies are one surface; a point cloud is given as the surface reconstructed from it.
    """

    vertices: FloatArray
    faces: IntArray
    frame: str
    label: int | None
    source_hash: str
    quality: QualityReport

    @staticmethod
    def from_mesh(
        vertices: ArrayLike, faces: ArrayLike, frame: str = "LPS", unit: str | None = None, force: bool = False
    ) -> Surface:
        """Return the surface of a mesh given as arrays.

        Parameters
        ----------
        vertices, faces : (n, 3) in `frame`, and (m, 3) indices.
        frame : orientation code of the vertices' axes (`hhsr.read.frames`).
        unit : "mm", "cm", "m", "um" or "in"; None: mm, if the size is an organ's.
        force : take any size as meant.

        Raises
        ------
        SurfaceError : not a closed surface, and not to be repaired; not of an organ's size.
        """
        points = np.asarray(vertices, dtype=np.float64)
        triangles = np.asarray(faces)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"vertices: got shape {points.shape}, expected (n, 3)")
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not np.issubdtype(triangles.dtype, np.integer):
            raise InputError(f"faces: got shape {triangles.shape} of {triangles.dtype}, expected (m, 3) whole numbers")
        triangles = triangles.astype(np.int64)
        digest = _hash_of_arrays(points, triangles)
        return _closed(points, triangles, frame, None, digest, unit, force, weld=False, warnings=())

    @staticmethod
    def from_labels(
        array: ArrayLike, affine: ArrayLike, label: int | None = None, force: bool = False, unit: str | None = None
    ) -> Surface:
        """Return the surface of one label of a label map.

        Parameters
        ----------
        array : (i, j, k) whole numbers, 0 is background.
        affine : (4, 4) voxel indices to RAS mm, as NIfTI has it; index (0, 0, 0) is the first voxel's centre.
        label : which; None: the only one there is.
        """
        labels, transform = np.asarray(array), np.asarray(affine, dtype=np.float64)
        digest = _hash_of_arrays(labels, transform)
        return _of_labels(labels, transform, label, digest, unit, force, warnings=())


def read_surface(
    path: str | Path,
    frame: str | None = None,
    label: int | None = None,
    unit: str | None = None,
    force: bool = False,
) -> Surface:
    """Return an organ's surface from a file, in LPS mm, closed, with a quality report.

    Parameters
    ----------
    path : a mesh (.stl, .ply, .obj), a point cloud with normals (.ply without faces), or a label map (.nii, .nii.gz).
    frame : orientation code of a mesh's axes ("RAS", "LSA", …); None: what the file's SPACE comment says, else LPS with
        a warning in the report. A label map says its own.
    label : of a label map; needed where it has several.
    unit : of a mesh's numbers: "mm", "cm", "m", "um" or "in"; None: mm, if the size is an organ's.
    force : take any size as meant.

    Raises
    ------
    InputError : no such file, an unknown format, frame or unit. SurfaceError : the file's surface cannot be used.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    if file.name.lower().endswith(LABEL_SUFFIXES):
        if frame is not None and frame.upper() != "RAS":
            raise InputError(
                f"frame: got {frame!r} for {file.name}, but a NIfTI file says its own frame (RAS): leave it out"
            )
        labels, affine, warnings = read_label_map(file)
        return _of_labels(labels, affine, label, digest, unit, force, warnings)
    if label is not None:
        raise InputError(f"label: got {label} for {file.name}, which is no label map: leave it out")
    raw = parse_mesh(file)
    chosen, warnings = _choose_frame(frame, raw.stated_frame)
    vertices, faces = raw.vertices, raw.faces
    if faces is None:
        vertices, faces, words = surface_of_points(vertices, raw.normals)
        warnings += words
    weld = file.suffix.lower() == ".stl"
    return _closed(vertices, faces, chosen, None, digest, unit, force, weld, warnings)


def _choose_frame(frame: str | None, stated: str | None) -> tuple[str, tuple[str, ...]]:
    if frame is not None:
        matrix_to_lps(frame)
        if stated is not None and stated != frame.upper():
            return frame.upper(), (f"the file says SPACE={stated}, taken as {frame.upper()} because it was asked for",)
        return frame.upper(), ()
    if stated is not None:
        return stated, ()
    return "LPS", ("the file does not say how it lies in the patient: taken as LPS; say frame= if that is not so",)


def _of_labels(
    labels: np.ndarray,
    affine: FloatArray,
    label: int | None,
    digest: str,
    unit: str | None,
    force: bool,
    warnings: tuple[str, ...],
) -> Surface:
    vertices, faces, chosen, words = surface_of_labels(labels, affine, label)
    surface = _closed(vertices, faces, "RAS", chosen, digest, unit, force, weld=False, warnings=warnings + words)
    return surface


def _closed(
    vertices: FloatArray,
    faces: IntArray,
    frame: str,
    label: int | None,
    digest: str,
    unit: str | None,
    force: bool,
    weld: bool,
    warnings: tuple[str, ...],
) -> Surface:
    """Return the surface in LPS, closed and checked; the one way in for every kind of source."""
    if unit is not None and unit not in UNITS_MM:
        raise InputError(f"unit: got {unit!r}, expected one of {', '.join(UNITS_MM)}")
    points, triangles = to_lps(vertices * UNITS_MM[unit or "mm"], faces, frame)
    points, triangles, quality = close(points, triangles, weld, warnings)
    longest = max(quality.extent_mm)
    if unit is None and not SHORTEST_MM <= longest <= LONGEST_MM:
        complaint = f"the longest side is {longest:.4g} mm, expected {SHORTEST_MM:g} to {LONGEST_MM:g} mm for an organ"
        if not force:
            raise SurfaceError(f'{complaint}; if it is meant, say unit="mm" (or "m", "cm", …) or --force')
        quality = replace(quality, warnings=(*quality.warnings, f"{complaint}; taken as meant"))
    return Surface(frozen(points), frozen(triangles, np.int64), frame.upper(), label, digest, quality)


def _hash_of_arrays(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
