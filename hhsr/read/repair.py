"""From whatever triangles a file holds to a closed, outward surface, or a clear refusal. Every change is stated."""

from __future__ import annotations

from typing import Any

import numpy as np

from hhsr.errors import SurfaceError
from hhsr.model import FloatArray, IntArray
from hhsr.read.quality import QualityReport, body_volumes, measure_quality
from hhsr.read.topology import body_of_faces, edge_counts, faces_to_turn, open_loops
from hhsr.triangle_tree import TriangleTree

# A hole is small where it is no wider than a fifth of the longest side, and all of them are a twentieth of the area.
HOLE_WIDTH_SHARE = 0.2
HOLE_AREA_SHARE = 0.05
WELD_SHARE = 1e-6
FLAT_SHARE = 1e-7
_DYNAMIC_LIMIT = 120


def close(
    vertices: FloatArray, faces: IntArray, weld: bool = False, warnings: tuple[str, ...] = ()
) -> tuple[FloatArray, IntArray, QualityReport]:
    """Return vertices and faces of a closed surface that faces outward, and the report of what it is and what was done.

    Parameters
    ----------
    vertices, faces : (n, 3) mm and (m, 3).
    weld : the file has no shared vertices (STL): equal ones are one, which is no repair.
    warnings : words to hand on in the report.

    Raises
    ------
    SurfaceError : not finite, without triangles, open beyond repair, one-sided, flat.
    """
    _require_sound(vertices, faces)
    found: dict[str, Any] = {"warnings": tuple(warnings)}
    repairs: list[str] = []
    used = np.unique(faces)
    if used.size < len(vertices):
        found["orphan_vertices"] = len(vertices) - used.size
        repairs.append(f"removed {len(vertices) - used.size} vertices that no triangle uses")
        vertices, faces = vertices[used], np.searchsorted(used, faces)
    vertices, faces = _weld(vertices, faces, weld, found, repairs)
    faces = _drop_faces(faces, found, repairs)
    turn = faces_to_turn(faces)
    if turn.any():
        found["turned_faces"] = int(turn.sum())
        repairs.append(f"turned {int(turn.sum())} triangles that faced against their neighbours")
        faces = np.where(turn[:, None], faces[:, ::-1], faces)
    faces, vertices = _fill_holes(vertices, faces, found, repairs)
    used = np.unique(faces)
    vertices, faces = vertices[used], np.searchsorted(used, faces)
    faces = _face_outward(vertices, faces, found, repairs)
    report = measure_quality(vertices, faces, **found, repairs=tuple(repairs))
    if report.volume_ml * 1000.0 < FLAT_SHARE * max(report.extent_mm) ** 3:
        raise SurfaceError(
            f"the surface encloses {report.volume_ml:.3g} ml in a box of {_sides(report)} mm, expected a solid; "
            "is it flat, or two surfaces that cancel?"
        )
    return np.ascontiguousarray(vertices), np.ascontiguousarray(faces), report


def _sides(report: QualityReport) -> str:
    return " × ".join(f"{side:.4g}" for side in report.extent_mm)


def _require_sound(vertices: FloatArray, faces: IntArray) -> None:
    if len(faces) == 0:
        raise SurfaceError(f"the mesh has no triangles ({len(vertices)} vertices), expected a closed surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SurfaceError(f"faces name vertices outside [0, {len(vertices)}); the mesh is damaged")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise SurfaceError(f"{bad.size} vertices are not finite (first: vertex {bad[0]}), expected millimetres")


def _weld(
    vertices: FloatArray, faces: IntArray, weld: bool, found: dict[str, Any], repairs: list[str]
) -> tuple[FloatArray, IntArray]:
    """Make equal vertices one where the file needs it; nearly equal ones only where that leaves fewer open edges."""
    first, same = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)[1:]
    duplicates = len(vertices) - first.size
    is_open = _open_edges(faces) > 0
    if duplicates and (weld or is_open):
        # keep the order of the file
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(order.size)
        vertices, faces = vertices[first[order]], rank[same.ravel()][faces]
        if not weld:
            repairs.append(f"merged {duplicates} duplicate vertices")
            found["duplicate_vertices"] = duplicates
        is_open = _open_edges(faces) > 0
    elif duplicates:
        found["duplicate_vertices"] = duplicates
    if not is_open:
        return vertices, faces
    step = WELD_SHARE * float(np.ptp(vertices, axis=0).max())
    cells = np.round(vertices / step) if step > 0 else vertices
    near, same = np.unique(cells, axis=0, return_index=True, return_inverse=True)[1:]
    merged = near[same.ravel()][faces]
    if _open_edges(merged) < _open_edges(faces):
        repairs.append(f"merged {len(vertices) - near.size} vertices closer than {step:.2g} mm to another")
        found["duplicate_vertices"] = found.get("duplicate_vertices", 0) + len(vertices) - near.size
        return vertices, merged
    return vertices, faces


def _open_edges(faces: IntArray) -> int:
    return int((edge_counts(faces) == 1).sum())


def _drop_faces(faces: IntArray, found: dict[str, Any], repairs: list[str]) -> IntArray:
    """Drop triangles with a repeated vertex, copies of a triangle, and the back of a mesh drawn from both sides."""
    thin = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if thin.any():
        found["degenerate_faces"] = int(thin.sum())
        repairs.append(f"removed {int(thin.sum())} triangles without area")
        faces = faces[~thin]
        if not len(faces):
            raise SurfaceError("all triangles of the mesh have no area, expected a closed surface")
    lowest = np.argmin(faces, axis=1)[:, None]
    cyclic = np.take_along_axis(faces, (lowest + np.arange(3)) % 3, axis=1)
    first = np.unique(cyclic, axis=0, return_index=True)[1]
    sheets = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    if first.size - sheets.size > first.size // 4:  # most triangles have a twin that faces the other way
        first = sheets
    if first.size < len(faces):
        found["duplicate_faces"] = len(faces) - first.size
        repairs.append(f"removed {len(faces) - first.size} copies of triangles")
        faces = faces[np.sort(first)]
    return faces


def _fill_holes(
    vertices: FloatArray, faces: IntArray, found: dict[str, Any], repairs: list[str]
) -> tuple[IntArray, FloatArray]:
    loops = open_loops(faces)
    if not loops:
        return faces, vertices
    longest = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = float(np.linalg.norm(normals, axis=1).sum()) / 2.0
    widths = [float(np.ptp(vertices[loop], axis=0).max()) for loop in loops]
    holes = sum(_ring_area(vertices[loop]) for loop in loops)
    if max(widths) > HOLE_WIDTH_SHARE * longest or holes > HOLE_AREA_SHARE * area:
        raise SurfaceError(
            f"the surface is open beyond repair: {len(loops)} holes, the widest {max(widths):.3g} mm (longest side "
            f"{longest:.4g} mm), together {100 * holes / area:.2g} % of its area; holes are filled up to "
            f"{100 * HOLE_WIDTH_SHARE:.0f} % of the longest side and {100 * HOLE_AREA_SHARE:.0f} % of the area. "
            "Close the mesh and write it again"
        )
    points, patches = vertices, [faces]
    for loop in loops:
        ring = loop[::-1]  # a patch runs against the border of its neighbours
        if loop.size <= _DYNAMIC_LIMIT:
            patches.append(ring[_least_area(points[ring])])
        else:
            points = np.vstack([points, points[ring].mean(axis=0)])
            patches.append(np.stack([ring, np.roll(ring, -1), np.full(ring.size, len(points) - 1)], axis=1))
    found["holes_filled"] = len(loops)
    repairs.append(f"filled {len(loops)} holes, the widest {max(widths):.3g} mm")
    return np.concatenate(patches), points


def _ring_area(ring: FloatArray) -> float:
    """Return the area in mm² that a ring spans: of the fan about its middle."""
    spokes = ring - ring.mean(axis=0)
    return float(np.linalg.norm(np.cross(spokes, np.roll(spokes, -1, axis=0)), axis=1).sum()) / 2.0


def _least_area(ring: FloatArray) -> IntArray:
    """Return (n − 2, 3) triangles over a ring of n points whose total area is least (Barequet and Sharir 1995)."""
    n = len(ring)
    cost = np.zeros((n, n))
    choice = np.zeros((n, n), dtype=np.int64)
    for gap in range(2, n):
        for i in range(n - gap):
            k = i + gap
            middle = np.arange(i + 1, k)
            areas = np.linalg.norm(np.cross(ring[middle] - ring[i], ring[k] - ring[i]), axis=1)
            total = cost[i, middle] + cost[middle, k] + areas
            best = int(np.argmin(total))
            cost[i, k], choice[i, k] = total[best], middle[best]
    triangles, pending = [], [(0, n - 1)]
    while pending:
        i, k = pending.pop()
        if k - i > 1:
            j = int(choice[i, k])
            triangles.append((i, j, k))
            pending += [(i, j), (j, k)]
    return np.array(triangles, dtype=np.int64)


def _face_outward(vertices: FloatArray, faces: IntArray, found: dict[str, Any], repairs: list[str]) -> IntArray:
    """Turn the bodies that face inward, unless they are cavities: inside an odd number of the others."""
    bodies = body_of_faces(faces)
    volumes = body_volumes(vertices, faces, bodies)
    inward = np.flatnonzero(volumes < 0)
    if not inward.size:
        return faces
    if inward.size == volumes.size:
        repairs.append("turned the surface, which faced inward")
        found["turned_faces"] = found.get("turned_faces", 0) + len(faces)
        faces = np.ascontiguousarray(faces[:, ::-1])
        return _face_outward(vertices, faces, found, repairs)
    turned = [body for body in inward.tolist() if not _is_inside_others(vertices, faces, bodies, body)]
    if turned:
        repairs.append(f"turned {len(turned)} bodies that faced inward")
        which = np.isin(bodies, turned)
        found["turned_faces"] = found.get("turned_faces", 0) + int(which.sum())
        faces = np.where(which[:, None], faces[:, ::-1], faces)
    return faces


def _is_inside_others(vertices: FloatArray, faces: IntArray, bodies: IntArray, body: int) -> bool:
    """Return whether most vertices of a body lie inside the solid that the other bodies make."""
    others = TriangleTree(vertices, faces[bodies != body])
    probes = vertices[np.unique(faces[bodies == body])]
    return bool(others.contains(probes[:: max(len(probes) // 64, 1)]).mean() > 0.5)
