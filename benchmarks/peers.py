"""The peers of `bench_queries.py`: what each engine is asked, on the source mesh, by the names of our queries.

All but the grid answer exactly on the mesh. Batches go through each engine's own batch call where it has one; fcpw's
answers are left in its own lists, which costs more to read than to fill.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

Query = Callable[[], Any]
Cases = dict[str, tuple[np.ndarray, ...]]

GRID_SIDE = 96


def open3d_queries(vertices: np.ndarray, faces: np.ndarray, given: Cases, threads: int) -> dict[str, Query]:
    """Return Open3D's queries (embree)."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(open3d.core.Tensor(vertices.astype(np.float32)), open3d.core.Tensor(faces.astype(np.uint32)))
    as_tensor = open3d.core.Tensor
    uniform, near = (as_tensor(given[k][0].astype(np.float32)) for k in ("uniform", "near"))
    starts, ends = given["segments"]
    rays = as_tensor(np.concatenate([starts, ends - starts], axis=1).astype(np.float32))
    few = 4 * (len(starts) // 20)
    part_u, part_n = uniform[:few], near[:few]
    options = {"nthreads": threads}
    return {
        "contains, uniform": lambda: scene.compute_occupancy(uniform, **options),
        "contains, ±2 mm": lambda: scene.compute_occupancy(near, **options),
        "all crossings": lambda: scene.list_intersections(rays, **options),
        "first crossing": lambda: scene.cast_rays(rays, **options),
        "signed distance, uniform": lambda: scene.compute_signed_distance(part_u, **options),
        "signed distance, ±2 mm": lambda: scene.compute_signed_distance(part_n, **options),
    }


def embreex_queries(vertices: np.ndarray, faces: np.ndarray, given: Cases, threads: int) -> dict[str, Query]:
    """Return embreex's queries, through trimesh."""
    import embreex  # noqa: F401
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    starts, ends = given["segments"]
    return {
        "contains, uniform": lambda: mesh.ray.contains_points(given["uniform"][0]),
        "contains, ±2 mm": lambda: mesh.ray.contains_points(given["near"][0]),
        "all crossings": lambda: mesh.ray.intersects_id(starts, ends - starts, multiple_hits=True),
        "first crossing": lambda: mesh.ray.intersects_first(starts, ends - starts),
    }


def libigl_queries(vertices: np.ndarray, faces: np.ndarray, given: Cases, threads: int) -> dict[str, Query]:
    """Return libigl's signed distance (pseudonormals)."""
    import igl

    few = 4 * (len(given["uniform"][0]) // 20)
    kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    return {
        "signed distance, uniform": lambda: igl.signed_distance(given["uniform"][0][:few], vertices, faces, kind),
        "signed distance, ±2 mm": lambda: igl.signed_distance(given["near"][0][:few], vertices, faces, kind),
    }


def fcpw_queries(vertices: np.ndarray, faces: np.ndarray, given: Cases, threads: int) -> dict[str, Query]:
    """Return fcpw's queries: parity of rays inside, closest triangle, first hit; all hits one ray at a time."""
    import fcpw

    def rows(array: np.ndarray) -> np.ndarray:
        return np.asfortranarray(array.astype(np.float32))

    scene = fcpw.scene_3D()
    scene.set_object_count(1)
    scene.set_object_vertices(rows(vertices), 0)
    scene.set_object_triangles(np.asfortranarray(faces.astype(np.int32)), 0)
    scene.build(fcpw.aggregate_type.bvh_surface_area, True)
    starts, ends = given["segments"]
    ways = ends - starts
    length = np.linalg.norm(ways, axis=1)
    few = 4 * (len(starts) // 20)
    uniform, near = rows(given["uniform"][0]), rows(given["near"][0])
    origins, directions = rows(starts), rows(ways / length[:, None])
    bounds, far = length.astype(np.float32), np.full(len(starts), np.inf, dtype=np.float32)
    inside = np.empty(len(starts), dtype=np.int32)
    one_by_one = [fcpw.ray_3D(o, d, t) for o, d, t in zip(np.array(origins), np.array(directions), bounds, strict=True)]

    def all_hits() -> None:
        for ray in one_by_one:
            scene.intersect(ray, fcpw.interaction_3D_list(), False, True)

    def nearest(points: np.ndarray) -> Query:
        return lambda: scene.find_closest_points(points, far[: len(points)], fcpw.interaction_3D_list(), True)

    return {
        "contains, uniform": lambda: scene.contains(uniform, inside),
        "contains, ±2 mm": lambda: scene.contains(near, inside),
        "all crossings": all_hits,
        "first crossing": lambda: scene.intersect(origins, directions, bounds, fcpw.interaction_3D_list()),
        "signed distance, uniform": nearest(rows(uniform[:few])),
        "signed distance, ±2 mm": nearest(rows(near[:few])),
    }


def vtk_queries(vertices: np.ndarray, faces: np.ndarray, given: Cases, threads: int) -> dict[str, Query]:
    """Return VTK's queries: enclosed points, implicit distance, and lines against an OBB tree, one at a time."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

    def cloud(array: np.ndarray) -> Any:
        points = vtk.vtkPoints()
        points.SetData(numpy_to_vtk(np.ascontiguousarray(array), deep=True))
        return points

    mesh = vtk.vtkPolyData()
    mesh.SetPoints(cloud(vertices))
    cells = vtk.vtkCellArray()
    cells.SetData(3, numpy_to_vtkIdTypeArray(np.ascontiguousarray(faces, dtype=np.int64).ravel(), deep=True))
    mesh.SetPolys(cells)
    distance = vtk.vtkImplicitPolyDataDistance()
    distance.SetInput(mesh)
    tree = vtk.vtkOBBTree()
    tree.SetDataSet(mesh)
    tree.BuildLocator()
    starts, ends = given["segments"]
    few, hits = 4 * (len(starts) // 20), vtk.vtkPoints()
    uniform, near = given["uniform"][0], given["near"][0]
    ids = vtk.vtkIdList()

    def enclosed(array: np.ndarray) -> Query:
        asked = vtk.vtkPolyData()
        asked.SetPoints(cloud(array))

        def run() -> None:
            select = vtk.vtkSelectEnclosedPoints()
            select.SetInputData(asked)
            select.SetSurfaceData(mesh)
            select.Update()

        return run

    def measured(array: np.ndarray) -> Query:
        points = numpy_to_vtk(np.ascontiguousarray(array), deep=True)
        return lambda: distance.FunctionValue(points, vtk.vtkDoubleArray())

    def lines() -> None:
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            tree.IntersectWithLine(start, end, hits, ids)

    return {
        "contains, uniform": enclosed(uniform),
        "contains, ±2 mm": enclosed(near),
        "all crossings": lines,
        "signed distance, uniform": measured(uniform[:few]),
        "signed distance, ±2 mm": measured(near[:few]),
    }


@numba.njit(nogil=True, error_model="numpy")
def _look_up(values: np.ndarray, low: np.ndarray, inverse: float, points: np.ndarray, out: np.ndarray) -> None:
    """Fill (n,) trilinear values of a grid at points (n, 3)."""
    for n in range(points.shape[0]):
        u, v = (points[n, 0] - low[0]) * inverse, (points[n, 1] - low[1]) * inverse
        w = (points[n, 2] - low[2]) * inverse
        i = min(max(int(u), 0), values.shape[0] - 2)
        j = min(max(int(v), 0), values.shape[1] - 2)
        k = min(max(int(w), 0), values.shape[2] - 2)
        x, y, z = u - i, v - j, w - k
        total = 0.0
        for c in range(8):
            a, b, d = c & 1, (c >> 1) & 1, c >> 2
            total += values[i + a, j + b, k + d] * (x if a else 1.0 - x) * (y if b else 1.0 - y) * (z if d else 1.0 - z)
        out[n] = total


def grid_queries(vertices: np.ndarray, faces: np.ndarray, given: Cases, threads: int) -> dict[str, Query]:
    """Return look-ups in a grid of distances (filled by Open3D): no exact peer, wrong near the surface."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(vertices.astype(np.float32)), open3d.core.Tensor(faces.astype(np.uint32)))
    low, high = vertices.min(axis=0) - 2.0, vertices.max(axis=0) + 2.0
    step = float((high - low).max()) / (GRID_SIDE - 1)
    axes = [low[k] + step * np.arange(int(np.ceil((high[k] - low[k]) / step)) + 1) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    values = scene.compute_signed_distance(open3d.core.Tensor(nodes)).numpy()
    out = np.empty(len(given["uniform"][0]))
    few = 4 * (len(out) // 20)

    def look_up(points: np.ndarray) -> Query:
        return lambda: _look_up(values, low, 1.0 / step, points, out)

    uniform, near = given["uniform"][0], given["near"][0]
    return {
        "contains, uniform": look_up(uniform),
        "contains, ±2 mm": look_up(near),
        "signed distance, uniform": look_up(uniform[:few]),
        "signed distance, ±2 mm": look_up(near[:few]),
    }


PEERS = {
    "Open3D": open3d_queries,
    "embreex": embreex_queries,
    "libigl": libigl_queries,
    "fcpw": fcpw_queries,
    "VTK": vtk_queries,
    "grid": grid_queries,
}
INEXACT = {"grid"}
