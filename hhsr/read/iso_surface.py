"""The surface of a voxel mask: smooth, yet never further than half a voxel from where the mask says it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from hhsr.model import FloatArray, IntArray

BoolArray = NDArray[np.bool_]


def surface_of_mask(mask: BoolArray, spacing: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return vertices in voxel indices (index 0 is the first voxel's centre) and faces outward in index space."""
    filled = np.argwhere(mask)
    low, high = filled.min(axis=0), filled.max(axis=0) + 1
    block = np.pad(mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], 1)
    vertices, faces, _, _ = marching_cubes(block.astype(np.float32), 0.5, allow_degenerate=False)
    return vertices.astype(np.float64) + (low - 1), faces.astype(np.int64)
