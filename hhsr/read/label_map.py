"""Label maps: NIfTI files, and the smooth closed surface of one label, in the affine's own frame (RAS mm)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from numpy.typing import NDArray

from hhsr.errors import InputError, SurfaceError
from hhsr.model import FloatArray, IntArray
from hhsr.read.iso_surface import surface_of_mask

LABEL_SUFFIXES = (".nii", ".nii.gz")
_UNIT_MM = {"meter": 1000.0, "mm": 1.0, "micron": 1e-3, "unknown": 1.0}


def read_label_map(path: Path) -> tuple[NDArray[Any], FloatArray, tuple[str, ...]]:
    """Return (i, j, k) labels, the (4, 4) affine to RAS mm, and warnings; SurfaceError where it is no label map."""
    try:
        image: Any = nibabel.load(path)
        values = np.asanyarray(image.dataobj)
        header = image.header
        codes = int(header["qform_code"]), int(header["sform_code"])
        unit = header.get_xyzt_units()[0]
        affine = np.array(image.affine, dtype=np.float64)
    except Exception as error:  # a parser of foreign files raises whatever the file makes it raise
        raise SurfaceError(f"{path.name}: not a readable NIfTI file ({type(error).__name__}: {error})") from error
    affine[:3] *= _UNIT_MM.get(unit, 1.0)
    warnings: tuple[str, ...] = ()
    if codes == (0, 0):
        warnings = ("the file has neither qform nor sform: orientation and place in the patient are a guess",)
    return values, affine, warnings


def surface_of_labels(
    values: NDArray[Any], affine: FloatArray, label: int | None
) -> tuple[FloatArray, IntArray, int, tuple[str, ...]]:
    """Return vertices (RAS mm) and outward faces of one label's surface, the label, and warnings.

    Raises
    ------
    SurfaceError : no such label, several and none chosen, not whole numbers, no volume. InputError : shapes.
    """
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3:
        raise SurfaceError(f"the label map has shape {values.shape}, expected three dimensions")
    if affine.shape != (4, 4) or not np.isfinite(affine).all():
        raise InputError(f"affine: got shape {affine.shape}, expected a finite (4, 4) map of indices to RAS mm")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if abs(np.linalg.det(affine[:3, :3])) < 1e-9 * max(float(spacing.prod()), 1e-300):
        raise SurfaceError("affine: its three axes lie in a plane, expected a map of voxels to space")
    chosen = _choose_label(values, label)
    mask = values == chosen
    warnings: tuple[str, ...] = ()
    edges = [side for axis in range(3) for side in (mask.take(0, axis), mask.take(-1, axis))]
    if any(side.any() for side in edges):
        warnings = (
            "the label touches the image's border, where the surface was closed: the organ may go on beyond it",
        )
    index, faces = surface_of_mask(mask)
    if np.linalg.det(affine[:3, :3]) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return index @ affine[:3, :3].T + affine[:3, 3], faces, chosen, warnings


def _choose_label(values: NDArray[Any], label: int | None) -> int:
    if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise SurfaceError(f"the label map holds {values.dtype}, expected whole numbers")
    if np.issubdtype(values.dtype, np.floating):
        if not np.isfinite(values).all():
            raise SurfaceError("the label map holds values that are not finite, expected whole numbers")
        if (values != np.round(values)).any():
            raise SurfaceError(
                "the image holds fractions (a probability map or a scan?), expected labels: whole numbers"
            )
    found = [int(value) for value in np.unique(values) if value != 0]
    listed = ", ".join(map(str, found[:20])) + (", …" if len(found) > 20 else "")
    if not found:
        raise SurfaceError("the label map is empty: all voxels are 0, expected an organ")
    if label is None:
        if len(found) > 1:
            raise SurfaceError(f"the label map holds {len(found)} labels ({listed}): say which, label=N or --label N")
        return found[0]
    if label not in found:
        raise SurfaceError(f"label {label} is empty: the label map holds {listed}")
    return int(label)
