"""The surface of a voxel mask: smooth, yet never further than half a voxel from where the mask says it is.

Marching cubes on a mask puts every vertex half way between an inside and an outside voxel: right topology, right volume
to a few per cent, and stairs. The truth crosses the same grid edge, somewhere between the two voxels. So the vertices
are moved to where the surface bends least, each within its own box of half a voxel around where it was (a quarter where
the part or the gap is thin, so that nothing that the mask holds can vanish), and then out or in by one common distance
that makes the volume that of the voxels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening
from scipy.sparse import csr_array
from skimage.measure import marching_cubes

from hhsr.model import FloatArray, IntArray

BoolArray = NDArray[np.bool_]

# |Laplacian|² + FIDELITY |x − x0|²: stairs shorter than some 20 voxels are bridged; a sphere of 8 voxels' radius is not
# yet pulled in by more than the volume's correction gives back.
FIDELITY = 1e-3
STEPS = 80
FREE, THIN = 0.5, 0.2


def surface_of_mask(mask: BoolArray) -> tuple[FloatArray, IntArray]:
    """Return vertices in voxel indices (index 0 is the first voxel's centre) and faces outward in index space.

    mask : (i, j, k), not empty; the surface is closed half a voxel beyond the image's border where the mask touches it.
    """
    filled = np.argwhere(mask)
    low, high = filled.min(axis=0), filled.max(axis=0) + 1
    block = np.pad(mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], 2)
    vertices, faces = _stairs(block)
    room = _room(block, vertices)
    smooth = _least_bending(vertices, faces, room)
    smooth = _with_volume(smooth, faces, float(filled.shape[0]))
    return smooth + (low - 2), faces


def _stairs(block: BoolArray) -> tuple[FloatArray, IntArray]:
    """Return marching cubes' vertices and faces, facing outward."""
    values = block.astype(np.float32)
    found = marching_cubes(values, 0.5, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    return found[0].astype(np.float64), found[1].astype(np.int64)


def _room(block: BoolArray, vertices: FloatArray) -> FloatArray:
    """Return (n, 1) how far each vertex may move along each axis, in voxels: less where what it bounds is thin."""
    cube = np.ones((2, 2, 2), dtype=bool)
    thick = np.where(block, binary_opening(block, cube), binary_opening(~block, cube))
    low, high = np.floor(vertices).astype(np.int64), np.ceil(vertices).astype(np.int64)
    free = thick[tuple(low.T)] & thick[tuple(high.T)]
    return np.where(free, FREE, THIN)[:, None]


def _least_bending(start: FloatArray, faces: IntArray, room: FloatArray) -> FloatArray:
    """Return the vertices that minimise |L x|² + FIDELITY |x − start|² within start ± room; L: the umbrella Laplacian.

    Accelerated projected gradient (Beck and Teboulle 2009); |L| ≤ 2, so the step is 1 / (4 + FIDELITY).
    """
    laplacian = _umbrella(faces, len(start))
    transposed = laplacian.T.tocsr()
    offset = np.zeros_like(start)
    ahead, momentum = offset, 1.0
    bent = laplacian @ start
    for _ in range(STEPS):
        gradient = transposed @ (bent + laplacian @ ahead) + FIDELITY * ahead
        moved = np.clip(ahead - gradient / (4.0 + FIDELITY), -room, room)
        faster = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = moved + (momentum - 1.0) / faster * (moved - offset)
        offset, momentum = moved, faster
    return start + offset


def _umbrella(faces: IntArray, count: int) -> csr_array:
    """Return the (count, count) matrix that takes each vertex minus the mean of its neighbours."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    adjacency = csr_array((np.ones(2 * start.size), (np.r_[start, end], np.r_[end, start])), shape=(count, count))
    adjacency.data[:] = 1.0
    degree = np.diff(adjacency.indptr)
    adjacency.data /= np.repeat(degree, degree)
    identity = csr_array((np.ones(count), (np.arange(count), np.arange(count))), shape=(count, count))
    return (identity - adjacency).tocsr()


def _with_volume(vertices: FloatArray, faces: IntArray, wanted: float) -> FloatArray:
    """Return the vertices moved along their normals by one distance, at most a quarter voxel, to enclose `wanted`."""
    for _ in range(3):
        corners = vertices[faces]
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume = float(np.einsum("fi,fi->", corners[:, 0] - vertices[0], doubled)) / 6.0
        area = float(np.linalg.norm(doubled, axis=1).sum()) / 2.0
        normals = np.stack(
            [np.bincount(faces.ravel(), np.repeat(doubled[:, axis], 3), len(vertices)) for axis in range(3)], axis=1
        )
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        shift = float(np.clip((wanted - volume) / area, -0.25, 0.25))
        vertices = vertices + shift * np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return vertices
