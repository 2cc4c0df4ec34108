"""Records of a tree as offsets into one blob: what goes where, before anything is proven (`hhsr.kernels.layout`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hhsr.evaluate import contour_arrays, leaf_arrays
from hhsr.kernels import layout as at
from hhsr.kernels import part as part_at
from hhsr.kernels import slab as slab_at
from hhsr.kernels.maps import blocks_of
from hhsr.model import Cut, FloatArray, ModelLeaf, Node, RetainedPart, Tree, rotation_matrix
from hhsr.triangle_tree import TriangleTree

Plane = tuple[FloatArray, float]  # n, c: the half space n·p ≤ c

BASE_SIDE = 32  # base cells a face side of a leaf's map, where there are few leaves
BASE_CELLS_TOTAL = 100_000  # over all leaves, before they are parted


@dataclass
class Sections:
    """The blob's sections while they grow."""

    ints: list[int] = field(default_factory=lambda: [0] * at.HEADER_SIZE)
    floats: list[FloatArray] = field(default_factory=list)
    float_count: int = 0

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
class Owner:
    kind: int
    node: int
    planes: list[Plane]
    source: ModelLeaf | RetainedPart | Cut
    record: int = -1
    planes_at: int = -1
    box_at: int = -1


class Records:
    """Offsets of everything that a tree is made of."""

    def __init__(self, tree: Tree) -> None:
        self.parts = Sections()
        self.nodes: list[list[int]] = []
        self.node_floats: list[FloatArray] = []
        self.owners: list[Owner] = []
        self.cuts: list[tuple[Cut, int, list[Plane]]] = []
        self.tables: list[tuple[int, int, int]] = []
        self.slab_records: dict[int, tuple[int, list[int]]] = {}
        self._visit(tree.root, [])
        self.base_side = base_side(sum(isinstance(o.source, ModelLeaf) for o in self.owners))
        self._records()

    def _visit(self, node: Node, planes: list[Plane]) -> int:
        index = len(self.nodes)
        self.nodes.append([0, 0, 0, -1])
        self.node_floats.append(np.zeros(at.NODE_FLOAT_SIZE))
        if not isinstance(node, Cut):
            kind = at.MODEL if isinstance(node, ModelLeaf) else at.RETAINED
            self.nodes[index] = [kind, -1, -1, len(self.owners)]
            self.owners.append(Owner(kind, index, planes, node))
            return index
        n, c, d = np.array(node.normal), float(node.offset), float(node.half_width)
        self.cuts.append((node, index, planes))
        self.node_floats[index][:5] = [*n, c, d]
        owner = -1
        if d > 0.0:
            owner = len(self.owners)
            self.owners.append(Owner(at.SLAB, index, [*planes, (n, c + d), (-n, d - c)], node))
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
    def _planes_in_frame(owner: Owner) -> FloatArray:
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
        offsets, rows = blocks_of(arrays.centres, arrays.inverse_extents, arrays.weights)
        record[at.BLOCKS], record[at.BLOCK_DATA] = parts.add_ints(offsets.tolist()), parts.add_floats(rows)
        rotation = rotation_matrix(leaf.rotation)
        record[at.FRAME] = parts.add_floats(np.concatenate([leaf.centre, rotation.ravel()]))
        record[at.ROTATED] = int(not np.array_equal(rotation, np.eye(3)))
        record[at.BOX] = parts.add_floats(np.zeros(8))
        record[at.CELLS], record[at.CELL_BITS] = self.base_side, self.base_side.bit_length() - 1
        record[at.PARTING] = parts.add_ints([0] * (6 * self.base_side**2))
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
            lobe[slab_at.LOBE_SPHERES] = parts.add_floats(np.zeros(slab_at.ENCLOSURE * slab_at.TABLE))
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
    _LEAF_FLOATS = (at.HALF_AXES, at.AZIMUTH, at.ELEVATION, at.BLOCK_DATA, at.FRAME, at.BOX)
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
        blob = np.zeros(ints[at.MAP_START])
        blob.view(np.int64)[:shift] = ints
        blob[shift : shift + self.parts.float_count] = np.concatenate(self.parts.floats)
        self.most_edges = most_edges
        return blob

    @staticmethod
    def header(blob: FloatArray) -> NDArray[np.int64]:
        return blob.view(np.int64)[: at.HEADER_SIZE]


def base_side(leaves: int) -> int:
    """Return the base cells a face side for each of so many leaves."""
    side = BASE_SIDE
    while side > 8 and leaves * 6 * side * side > BASE_CELLS_TOTAL:
        side //= 2
    return side


def pose_arrays(pose: FloatArray) -> FloatArray:
    """Return (12,) rotation and translation, tree frame to LPS, of a pose (rotation vector, translation)."""
    return np.concatenate([rotation_matrix(pose[:3]).ravel(), pose[3:]])
