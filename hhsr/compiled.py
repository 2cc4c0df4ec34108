"""A tree laid out flat for the kernels, with its proven bounds: one read-only blob (layout: `hhsr.kernels.layout`).

Nothing of it is stored in a file: it is made from the records on the first query, in a few tenths of a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hhsr.evaluate import contour_arrays, leaf_arrays
from hhsr.kernels import layout as at
from hhsr.kernels import part as part_at
from hhsr.kernels import slab as slab_at
from hhsr.kernels.crossing import cross_many, first_exits
from hhsr.kernels.maps import blocks_of, build_map, pyramid_size
from hhsr.kernels.region_box import leaf_box, part_box
from hhsr.kernels.slab_bounds import fill_lobe_spheres
from hhsr.model import Cut, FloatArray, ModelLeaf, Node, RetainedPart, Tree, frozen, rotation_matrix
from hhsr.triangle_tree import TriangleTree

Plane = tuple[FloatArray, float]  # n, c: the half space n·p ≤ c

MAP_CELLS_TOTAL = 12 * 64 * 64  # cells a face over all leaves: 64² each up to 12 leaves, then fewer
EDGE_OFFSET = 1e-6  # mm, how far off a straight edge its four sides are asked
EDGE_RESOLUTION = 1e-4  # mm


@dataclass(frozen=True, eq=False)
class Compiled:
    """What the kernels take, and a few derived figures.

    blob: read-only. band_tables: per cut (parents first, left before right) and lobe, the (256,) radii L at h = −d and R
    at h = d, mm, at α_i = −π + 2π·i/256.
    """

    blob: FloatArray
    band_tables: tuple[tuple[tuple[FloatArray, FloatArray], ...], ...]
    layout: _Layout
    pose: FloatArray

    @property
    def nbytes(self) -> int:
        return int(self.blob.nbytes)

    @cached_property
    def bounds(self) -> FloatArray:
        """(2, 3) lowest and highest corner of the solid, LPS mm; NaN where there is none."""
        return frozen(self.layout.bounds(self.blob, rotation_matrix(self.pose[:3]), self.pose[3:]))

    def moved(self, pose: FloatArray) -> Compiled:
        """Return the same under another pose (6,): nothing is proven again."""
        blob = self.blob.copy()
        start = int(self.layout.header(blob)[at.POSE])
        blob[start : start + 12] = pose_arrays(pose)
        blob.setflags(write=False)
        return Compiled(blob, self.band_tables, self.layout, pose)


@dataclass
class _Parts:
    """The blob's sections while they grow."""

    ints: list[int] = field(default_factory=lambda: [0] * at.HEADER_SIZE)
    floats: list[FloatArray] = field(default_factory=list)
    float_count: int = 0
    table_count: int = 0

    def add_floats(self, values: NDArray[np.float64]) -> int:
        """Append numbers; return their offset among the floats."""
        start = self.float_count
        flat = np.ascontiguousarray(values, dtype=np.float64).ravel()
        self.floats.append(flat)
        self.float_count += flat.size
        return start

    def add_ints(self, values: list[int]) -> int:
        start = len(self.ints)
        self.ints.extend(int(v) for v in values)
        return start


@dataclass
class _Owner:
    kind: int
    node: int
    planes: list[Plane]
    source: ModelLeaf | RetainedPart | Cut
    record: int = -1
    planes_at: int = -1
    box_at: int = -1


def pose_arrays(pose: FloatArray) -> FloatArray:
    """Return (12,) rotation and translation, tree frame to LPS, of a pose (rotation vector, translation)."""
    return np.concatenate([rotation_matrix(pose[:3]).ravel(), pose[3:]])


def compile_tree(tree: Tree) -> Compiled:
    """Lay a tree out flat and prove its bounds; every tree has a solid, whatever its numbers (DESIGN §2)."""
    layout = _Layout(tree)
    blob = layout.assemble()
    view = blob.view()
    view.setflags(write=False)
    for owner in layout.owners:
        if owner.kind == at.MODEL:
            layout.fill_map(blob, view, owner)
    tables = layout.fill_bands(blob, view)
    layout.fill_boxes(blob, view)
    layout.fill_edges(blob, view)
    start = int(layout.header(blob)[at.POSE])
    blob[start : start + 12] = pose_arrays(tree.pose)
    blob.setflags(write=False)
    return Compiled(blob, tables, layout, tree.pose)


class _Layout:
    """Offsets of everything, and the steps that fill what was proven."""

    def __init__(self, tree: Tree) -> None:
        self.parts = _Parts()
        self.nodes: list[list[int]] = []
        self.node_floats: list[FloatArray] = []
        self.owners: list[_Owner] = []
        self.cuts: list[tuple[Cut, int, list[Plane]]] = []
        self.tables: list[tuple[int, int, int]] = []
        self.slab_records: dict[int, tuple[int, list[int]]] = {}
        self._visit(tree.root, [])
        model_leaves = sum(o.kind == at.MODEL for o in self.owners)
        self.cells = 64
        while self.cells > 16 and self.cells**2 * model_leaves > MAP_CELLS_TOTAL:
            self.cells //= 2
        self._records()

    def _visit(self, node: Node, planes: list[Plane]) -> int:
        index = len(self.nodes)
        self.nodes.append([0, 0, 0, -1])
        self.node_floats.append(np.zeros(at.NODE_FLOAT_SIZE))
        if not isinstance(node, Cut):
            kind = at.MODEL if isinstance(node, ModelLeaf) else at.RETAINED
            self.nodes[index] = [kind, -1, -1, len(self.owners)]
            self.owners.append(_Owner(kind, index, planes, node))
            return index
        n, c, d = np.array(node.normal), float(node.offset), float(node.half_width)
        self.cuts.append((node, index, planes))
        self.node_floats[index][:5] = [*n, c, d]
        owner = -1
        if d > 0.0:
            owner = len(self.owners)
            self.owners.append(_Owner(at.SLAB, index, [*planes, (n, c + d), (-n, d - c)], node))
        left = self._visit(node.left, [*planes, (n, c - d)])
        right = self._visit(node.right, [*planes, (-n, -c - d)])
        self.nodes[index] = [at.CUT, left, right, owner]
        return index

    def _records(self) -> None:
        parts = self.parts
        head = parts.ints
        head[at.POSE] = parts.add_floats(np.concatenate([np.eye(3).ravel(), np.zeros(3)]))
        head[at.NODE_COUNT] = len(self.nodes)
        head[at.NODE_INTS] = parts.add_ints([v for n in self.nodes for v in n])
        head[at.NODE_FLOATS] = parts.add_floats(np.array(self.node_floats))
        for owner in self.owners:
            if isinstance(owner.source, ModelLeaf):
                owner.record = self._leaf_record(owner.source)
            elif isinstance(owner.source, RetainedPart):
                owner.record = self._part_record(owner.source)
            else:
                owner.record = self._slab_record(owner.source, owner.node)
            owner.planes_at = parts.add_floats(self._planes_in_frame(owner))
            owner.box_at = parts.add_floats(np.zeros(6))
        head[at.OWNER_COUNT] = len(self.owners)
        head[at.OWNER_INTS] = parts.add_ints([0] * (at.OWNER_INT_SIZE * len(self.owners)))
        planes = [
            [*cut.normal, cut.offset + side * cut.half_width]
            for cut, _, _ in self.cuts
            for side in ((-1, 1) if cut.half_width > 0 else (0,))
        ]
        head[at.PLANE_COUNT] = len(planes)
        head[at.PLANE_FLOATS] = parts.add_floats(np.array(planes).reshape(-1))

    @staticmethod
    def _planes_in_frame(owner: _Owner) -> FloatArray:
        """Return (k, 4) the planes of the owner's region in the owner's frame."""
        rotation, centre = np.eye(3), np.zeros(3)
        if isinstance(owner.source, ModelLeaf):
            rotation, centre = rotation_matrix(owner.source.rotation), owner.source.centre
        return np.array([[*(rotation.T @ n), c - float(n @ centre)] for n, c in owner.planes]).reshape(-1, 4)

    def _leaf_record(self, leaf: ModelLeaf) -> int:
        parts, arrays = self.parts, leaf_arrays(leaf)
        record = [0] * at.LEAF_INT_SIZE
        record[at.HALF_AXES] = parts.add_floats(arrays.half_axes)
        record[at.AZIMUTH], record[at.AZIMUTH_COUNT] = parts.add_floats(arrays.azimuth), len(arrays.azimuth)
        record[at.ELEVATION], record[at.ELEVATION_COUNT] = parts.add_floats(arrays.elevation), len(arrays.elevation)
        rows = np.column_stack([arrays.centres, arrays.inverse_extents, arrays.weights])
        record[at.CENTRES], record[at.CENTRE_COUNT] = parts.add_floats(rows), len(rows)
        offsets, index = blocks_of(arrays.centres, arrays.inverse_extents)
        record[at.BLOCKS] = parts.add_ints((offsets + len(parts.ints) + len(offsets)).tolist())
        parts.add_ints(index.tolist())
        rotation = rotation_matrix(leaf.rotation)
        record[at.FRAME] = parts.add_floats(np.concatenate([leaf.centre, rotation.ravel()]))
        record[at.ROTATED] = int(not np.array_equal(rotation, np.eye(3)))
        record[at.BOX] = parts.add_floats(np.zeros(8))
        record[at.CELLS] = self.cells
        record[at.CELL_TABLE] = parts.table_count
        record[at.RANGE_TABLE] = record[at.CELL_TABLE] + 6 * self.cells**2 * at.CELL_SIZE
        record[at.SPHERE_TABLE] = record[at.RANGE_TABLE] + 2 * pyramid_size(self.cells)
        parts.table_count = record[at.SPHERE_TABLE] + 4 * pyramid_size(self.cells)
        return parts.add_ints(record)

    def _part_record(self, part: RetainedPart) -> int:
        parts = self.parts
        record = [0] * part_at.PART_INT_SIZE
        if len(part.faces):
            boxes, links, corners, _ = TriangleTree(part.vertices, part.faces).arrays
            record[part_at.BOXES], record[part_at.NODES] = parts.add_floats(boxes), len(boxes)
            record[part_at.LINKS] = parts.add_ints(links.ravel().tolist())
            record[part_at.CORNERS], record[part_at.TRIANGLES] = parts.add_floats(corners), len(corners)
            record[part_at.EXTENT] = parts.add_floats(
                np.array([max(np.ptp(boxes[0].reshape(2, 3), axis=0).max(), 1e-9)])
            )
        return parts.add_ints(record)

    def _slab_record(self, cut: Cut, node: int) -> int:
        parts = self.parts
        lobes, starts = [], []
        for contour in cut.contours:
            arrays = contour_arrays(contour)
            tables = parts.add_floats(np.concatenate([contour.centre, np.zeros(2 * (slab_at.TABLE + 1))]))
            starts.append(tables)
            lobe = [0] * slab_at.LOBE_INT_SIZE
            lobe[slab_at.LOBE_TABLES] = tables
            lobe[slab_at.LOBE_AXES] = parts.add_floats(np.concatenate([arrays.half_axes, np.ones(2)]))
            lobe[slab_at.LOBE_SPHERES] = parts.add_floats(np.zeros(6 * slab_at.TABLE))
            lobe[slab_at.LOBE_SPLINE] = parts.add_floats(arrays.angle)
            lobe[slab_at.LOBE_SEGMENTS] = len(arrays.angle)
            lobe[slab_at.LOBE_CENTRES] = parts.add_floats(arrays.centres)
            lobe[slab_at.LOBE_COUNT_CENTRES] = len(arrays.weights)
            lobe[slab_at.LOBE_WEIGHTS] = parts.add_floats(arrays.weights)
            lobe[slab_at.LOBE_EXTENT] = parts.add_floats(np.array([arrays.inverse_extent]))
            lobes.extend(lobe)
        frame = parts.add_floats(np.concatenate([cut.frame.ravel(), [cut.offset, cut.half_width]]))
        lobes_at = parts.add_ints(lobes)
        self.slab_records[node] = (lobes_at, starts)
        return parts.add_ints([frame, len(cut.contours), lobes_at])

    # -- assembly -----------------------------------------------------------------------------------------------------

    # Records hold offsets among the floats; in the blob the floats come after the integers, so these move by `shift`.
    _LEAF_FLOATS = (at.HALF_AXES, at.AZIMUTH, at.ELEVATION, at.CENTRES, at.FRAME, at.BOX)
    _PART_FLOATS = (part_at.BOXES, part_at.CORNERS, part_at.EXTENT)
    _LOBE_FLOATS = (
        slab_at.LOBE_TABLES,
        slab_at.LOBE_AXES,
        slab_at.LOBE_SPLINE,
        slab_at.LOBE_CENTRES,
        slab_at.LOBE_WEIGHTS,
        slab_at.LOBE_EXTENT,
        slab_at.LOBE_SPHERES,
    )

    def assemble(self) -> FloatArray:
        """Return the writable blob with all records in place and the proven tables still empty."""
        ints = self.parts.ints
        most_edges = 64 * sum(len(planes) * 2 for _, _, planes in self.cuts)
        shift = len(ints)
        for slot in (at.POSE, at.NODE_FLOATS, at.PLANE_FLOATS):
            ints[slot] += shift
        for number, owner in enumerate(self.owners):
            slots: tuple[int, ...] = ()
            if owner.kind == at.MODEL:
                slots = self._LEAF_FLOATS
            elif owner.kind == at.RETAINED:
                slots = self._PART_FLOATS
            else:
                ints[owner.record + slab_at.SLAB_FRAME] += shift
                lobes_at, starts = self.slab_records[owner.node]
                for k in range(len(starts)):
                    for slot in self._LOBE_FLOATS:
                        ints[lobes_at + slab_at.LOBE_INT_SIZE * k + slot] += shift
                self.slab_records[owner.node] = (lobes_at, [s + shift for s in starts])
            for slot in slots:
                ints[owner.record + slot] += shift
            owner.planes_at += shift
            owner.box_at += shift
            o = ints[at.OWNER_INTS] + at.OWNER_INT_SIZE * number
            ints[o : o + at.OWNER_INT_SIZE] = [
                owner.kind,
                owner.record,
                len(owner.planes),
                owner.planes_at,
                owner.node,
                owner.box_at,
            ]
        ints[at.EDGE_FLOATS] = shift + self.parts.float_count
        ints[at.MAP_START] = shift + self.parts.float_count + 6 * most_edges
        blob = np.zeros(ints[at.MAP_START] + (self.parts.table_count + 1) // 2)
        blob.view(np.int64)[:shift] = ints
        blob[shift : shift + self.parts.float_count] = np.concatenate(self.parts.floats)
        self.most_edges = most_edges
        return blob

    @staticmethod
    def header(blob: FloatArray) -> NDArray[np.int64]:
        return blob.view(np.int64)[: at.HEADER_SIZE]

    def fill_map(self, blob: FloatArray, blob_view: FloatArray, owner: _Owner) -> None:
        """Prove the bounds of one leaf."""
        ints = blob.view(np.int64)
        record = ints[owner.record : owner.record + at.LEAF_INT_SIZE]
        tables = blob[ints[at.MAP_START] :].view(np.float32)
        n, size = self.cells, pyramid_size(self.cells)
        cells, ranges, spheres = (int(record[k]) for k in (at.CELL_TABLE, at.RANGE_TABLE, at.SPHERE_TABLE))
        box = int(record[at.BOX])
        build_map(
            blob_view,
            owner.record,
            n,
            tables[cells : cells + 6 * n * n * at.CELL_SIZE].reshape(6, n, n, at.CELL_SIZE),
            tables[ranges : ranges + 2 * size].reshape(size, 2),
            tables[spheres : spheres + 4 * size].reshape(size, 4),
            blob[box : box + 8],
        )

    def fill_bands(
        self, blob: FloatArray, blob_view: FloatArray
    ) -> tuple[tuple[tuple[FloatArray, FloatArray], ...], ...]:
        """Fill L and R of every lobe, the deepest cuts first: a child's section already has its own bands."""
        angles = -math.pi + 2.0 * math.pi * np.arange(slab_at.TABLE) / slab_at.TABLE
        found: dict[int, list[tuple[FloatArray, FloatArray]]] = {}
        reach = self._reach(blob)
        for cut, node, _ in reversed(self.cuts):
            found[node] = []
            if node not in self.slab_records:
                continue
            e1, e2, n = cut.frame
            rays = reach * (np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2)
            for contour, start in zip(cut.contours, self.slab_records[node][1], strict=True):
                pair = []
                for side, child in ((-1.0, self.nodes[node][1]), (1.0, self.nodes[node][2])):
                    centre = contour.centre[0] * e1 + contour.centre[1] * e2 + (cut.offset + side * cut.half_width) * n
                    shares = np.empty(slab_at.TABLE)
                    first_exits(blob_view, child, centre, rays, 1e-3, 1e-6, shares)
                    pair.append(shares * reach)
                    o = start + 2 + (0 if side < 0 else slab_at.TABLE + 1)
                    blob[o : o + slab_at.TABLE] = pair[-1]
                    blob[o + slab_at.TABLE] = pair[-1][0]
                found[node].append((pair[0], pair[1]))
            self._fill_strips(blob, blob_view, node)
        return tuple(tuple(found[node]) for _, node, _ in self.cuts)

    def _fill_strips(self, blob: FloatArray, blob_view: FloatArray, node: int) -> None:
        """Prove the enclosures of a slab's strips."""
        ints = blob_view.view(np.int64)
        slab = self.owners[self.nodes[node][3]].record
        lobes_at, starts = self.slab_records[node]
        for k in range(len(starts)):
            lobe = lobes_at + slab_at.LOBE_INT_SIZE * k
            spheres = int(ints[lobe + slab_at.LOBE_SPHERES])
            out = blob[spheres : spheres + 6 * slab_at.TABLE].reshape(slab_at.TABLE, 6)
            fill_lobe_spheres(blob_view, ints, slab, lobe, out)

    def _reach(self, blob: FloatArray) -> float:
        """Return a length (mm) that no straight line within the solid can reach."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        ints = blob.view(np.int64)
        for owner in self.owners:
            if isinstance(owner.source, ModelLeaf):
                box = int(ints[owner.record + at.BOX])
                far = math.sqrt(3.0) * blob[box + 7]
                low, high = np.minimum(low, owner.source.centre - far), np.maximum(high, owner.source.centre + far)
            elif isinstance(owner.source, RetainedPart) and len(owner.source.faces):
                low = np.minimum(low, owner.source.vertices.min(axis=0))
                high = np.maximum(high, owner.source.vertices.max(axis=0))
        for cut, _, _ in self.cuts:  # a lobe may reach beyond every leaf
            for contour in cut.contours:
                centre = cut.frame.T @ np.array([*contour.centre, cut.offset])
                far = 3.0 * 10.0 * float(contour.half_axes.max()) + cut.half_width
                low, high = np.minimum(low, centre - far), np.maximum(high, centre + far)
        return 2.0 * float(np.linalg.norm(high - low)) + 1.0 if np.isfinite(low).all() else 1.0

    def fill_boxes(self, blob: FloatArray, blob_view: FloatArray) -> None:
        """Fill each owner's box: its surface within its region, tree frame."""
        for owner in self.owners:
            blob[owner.box_at : owner.box_at + 6] = self._owner_box(blob_view, owner, np.eye(3), np.zeros(3))

    def _owner_box(self, blob_view: FloatArray, owner: _Owner, rotation: FloatArray, shift: FloatArray) -> FloatArray:
        box = np.empty(6)
        if isinstance(owner.source, ModelLeaf):
            own = rotation @ rotation_matrix(owner.source.rotation)
            leaf_box(blob_view, owner.record, owner.planes_at, len(owner.planes), own, box)
            return box + np.tile(rotation @ owner.source.centre + shift, 2)
        if isinstance(owner.source, RetainedPart):
            part_box(blob_view, owner.record, owner.planes_at, len(owner.planes), np.ascontiguousarray(rotation), box)
            return box + np.tile(shift, 2)
        return self._slab_box(blob_view, owner.source, owner.node, rotation, shift)

    def _slab_box(
        self, blob_view: FloatArray, cut: Cut, node: int, rotation: FloatArray, shift: FloatArray
    ) -> FloatArray:
        ints = blob_view.view(np.int64)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        lobes_at, starts = self.slab_records[node]
        for k in range(len(starts)):
            o = int(ints[lobes_at + slab_at.LOBE_INT_SIZE * k + slab_at.LOBE_SPHERES])
            spheres = blob_view[o : o + 6 * slab_at.TABLE].reshape(-1, 6)
            spheres = spheres[spheres[:, 5] > 0.0]
            if len(spheres):
                centres = spheres[:, :3] @ rotation.T + shift
                low = np.minimum(low, (centres - spheres[:, 3:4]).min(axis=0))
                high = np.maximum(high, (centres + spheres[:, 3:4]).max(axis=0))
        return np.concatenate([low, high])

    def fill_edges(self, blob: FloatArray, blob_view: FloatArray) -> None:
        """Find the straight edges of the surface: where a cut meets a plane that bounds its region, and states differ."""
        reach = self._reach(blob)
        low, high = _union([blob_view[o.box_at : o.box_at + 6] for o in self.owners])
        middle = 0.5 * (low + high) if np.isfinite(low).all() else np.zeros(3)
        edges: list[FloatArray] = []
        for cut, _, planes in self.cuts:
            n = np.array(cut.normal)
            for side in (-1.0, 1.0) if cut.half_width > 0 else (0.0,):
                for k, (m, c) in enumerate(planes):
                    line = _meet(n, cut.offset + side * cut.half_width, m, c, middle)
                    if line is None:
                        continue
                    span = _clip(line, [p for i, p in enumerate(planes) if i != k], reach)
                    if span is not None:
                        edges.extend(_edge_pieces(blob_view, *span, n, m))
        edges = edges[: self.most_edges]
        head = self.header(blob)
        head[at.EDGE_COUNT] = len(edges)
        start = int(head[at.EDGE_FLOATS])
        for k, edge in enumerate(edges):
            blob[start + 6 * k : start + 6 * k + 6] = edge

    def bounds(self, blob_view: FloatArray, rotation: FloatArray, shift: FloatArray) -> FloatArray:
        """Return (2, 3) the box of the solid after a rigid motion: of its patches and straight edges."""
        boxes = [self._owner_box(blob_view, o, rotation, shift) for o in self.owners]
        head = self.header(blob_view)
        start, count = int(head[at.EDGE_FLOATS]), int(head[at.EDGE_COUNT])
        ends = blob_view[start : start + 6 * count].reshape(-1, 3) @ rotation.T + shift
        boxes.extend(np.concatenate([p, p]) for p in ends)
        low, high = _union(boxes)
        return np.array([low, high]) if np.isfinite(low).all() else np.full((2, 3), np.nan)


def _union(boxes: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for box in boxes:
        if box[0] <= box[3]:
            low, high = np.minimum(low, box[:3]), np.maximum(high, box[3:])
    return low, high


def _meet(n: FloatArray, c: float, m: FloatArray, e: float, near: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return (point, unit direction) of the line where n·p = c and m·p = e meet, the point next to `near`."""
    along = np.cross(n, m)
    length = float(np.linalg.norm(along))
    if length < 1e-9:
        return None
    along = along / length
    rows = np.array([n, m, along])
    return np.linalg.solve(rows, np.array([c, e, float(along @ near)])), along


def _clip(
    line: tuple[FloatArray, FloatArray], planes: list[Plane], reach: float
) -> tuple[FloatArray, FloatArray] | None:
    point, along = line
    t0, t1 = -reach, reach
    for m, c in planes:
        rate, gap = float(m @ along), c - float(m @ point)
        if abs(rate) < 1e-12:
            if gap < -1e-9:
                return None
        elif rate > 0:
            t1 = min(t1, gap / rate)
        else:
            t0 = max(t0, gap / rate)
    return (point + t0 * along, point + t1 * along) if t0 < t1 else None


def _edge_pieces(
    blob_view: FloatArray, start: FloatArray, end: FloatArray, n: FloatArray, m: FloatArray
) -> list[FloatArray]:
    """Return the pieces (6,) of start → end about which the four quadrants between two planes do not all agree."""
    shifts = EDGE_OFFSET * np.array([n + m, n - m, m - n, -n - m])
    counts, begins = np.empty(4, dtype=np.int64), np.empty(4, dtype=np.bool_)
    t = np.empty(1024)
    done, _ = cross_many(blob_view, start + shifts, end + shifts, EDGE_RESOLUTION, EDGE_RESOLUTION, counts, begins, t)
    if done < 4:
        return [np.concatenate([start, end])]
    stops = np.concatenate([[0.0], np.sort(t[: counts.sum()]), [1.0]])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    pieces = []
    for a, b in zip(stops[:-1], stops[1:], strict=True):
        if b <= a:
            continue
        x = 0.5 * (a + b)
        states = {bool(begins[k]) ^ bool((t[offsets[k] : offsets[k + 1]] < x).sum() % 2) for k in range(4)}
        if len(states) > 1:
            pieces.append(np.concatenate([start + a * (end - start), start + b * (end - start)]))
    return pieces
