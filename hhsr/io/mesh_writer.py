"""A shape's mesh as a PLY, STL or OBJ file that says its frame, as 3D Slicer reads and writes it (SPACE=LPS)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hhsr.errors import InputError
from hhsr.model import FloatArray, IntArray

WRITABLE = (".ply", ".stl", ".obj")


def write_mesh(path: str | Path, vertices: FloatArray, faces: IntArray) -> None:
    """Write (n, 3) LPS mm and (m, 3) as binary PLY (float64), binary STL (float32) or OBJ; InputError otherwise."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix == ".ply":
        file.write_bytes(_ply(vertices, faces))
    elif suffix == ".stl":
        file.write_bytes(_stl(vertices, faces))
    elif suffix == ".obj":
        file.write_text(_obj(vertices, faces), encoding="ascii")
    else:
        raise InputError(f"{file.name}: expected a name that ends in {', '.join(WRITABLE)}")


def _ply(vertices: FloatArray, faces: IntArray) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment SPACE=LPS\ncomment millimetres\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode() + np.asarray(vertices, dtype="<f8").tobytes() + rows.tobytes()


def _stl(vertices: FloatArray, faces: IntArray) -> bytes:
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    rows["corners"] = corners
    return b"SPACE=LPS millimetres".ljust(80) + len(faces).to_bytes(4, "little") + rows.tobytes()


def _obj(vertices: FloatArray, faces: IntArray) -> str:
    lines = ["# SPACE=LPS", "# millimetres"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, dtype=np.float64).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
    return "\n".join(lines) + "\n"
