"""STL, PLY and OBJ files as plain arrays, with what their headers say of the frame."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from hhsr.errors import InputError, SurfaceError
from hhsr.model import FloatArray, IntArray

MESH_SUFFIXES = (".stl", ".ply", ".obj")
_HEAD = 4096
# 3D Slicer writes SPACE=LPS or SPACE=RAS into the header or a comment.
_SPACE = re.compile(rb"SPACE\s*=\s*([LRPASIlrpasi]{3})\b")


class RawMesh(NamedTuple):
    """What a file holds, untouched: vertices (n, 3), faces (m, 3) or None, normals (n, 3) or None, a frame or None."""

    vertices: FloatArray
    faces: IntArray | None
    normals: FloatArray | None
    stated_frame: str | None


def parse_mesh(path: Path) -> RawMesh:
    """Return the contents of a mesh file; SurfaceError where it cannot be read or holds no points."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path.name}: expected a mesh ({', '.join(MESH_SUFFIXES)}) or a label map (.nii, .nii.gz)")
    with path.open("rb") as file:
        stated = _SPACE.search(file.read(_HEAD))
    frame = stated.group(1).decode().upper() if stated else None
    try:
        geometry = trimesh.load_scene(path, process=False, maintain_order=True, skip_materials=True).geometry.values()
        parts = [part for part in geometry if len(getattr(part, "vertices", ()))]
    except Exception as error:  # a parser of foreign files raises whatever the file makes it raise
        raise SurfaceError(f"{path.name}: not a readable mesh ({type(error).__name__}: {error})") from error
    if not parts:
        raise SurfaceError(f"{path.name}: the file holds no points")
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not meshes:
        points = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
        return RawMesh(points, None, _point_normals(parts), frame)
    offsets = np.cumsum([0, *(len(part.vertices) for part in meshes)])
    vertices = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in meshes])
    faces = [np.asarray(part.faces, dtype=np.int64) + at for part, at in zip(meshes, offsets, strict=False)]
    return RawMesh(vertices, np.concatenate(faces), None, frame)


def _point_normals(parts: list[trimesh.Geometry]) -> FloatArray | None:
    """Return the nx, ny, nz of a PLY without faces, which trimesh leaves in the raw columns."""
    columns = []
    for part in parts:
        rows = part.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
        if rows is None:
            return None
        try:
            columns.append(
                np.stack([np.asarray(rows[name], dtype=np.float64).ravel() for name in ("nx", "ny", "nz")], 1)
            )
        except (KeyError, ValueError, IndexError):
            return None
    return np.concatenate(columns)
