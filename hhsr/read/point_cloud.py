"""Point clouds with normals."""

from __future__ import annotations

from hhsr.errors import SurfaceError
from hhsr.model import FloatArray, IntArray


def surface_of_points(points: FloatArray, normals: FloatArray | None) -> tuple[FloatArray, IntArray, tuple[str, ...]]:
    """Return vertices, faces and warnings of the closed surface of an oriented point cloud."""
    raise SurfaceError("point clouds are not read yet: write the surface as a mesh")
