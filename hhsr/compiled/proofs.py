"""What is proven of a compiled tree: maps of leaves, band tables, enclosures of strips, boxes and straight edges."""

from __future__ import annotations

import math

import numpy as np

from hhsr.compiled.blob import LINE, appended, read_only
from hhsr.compiled.edges import straight_edges
from hhsr.compiled.leaf_maps import fill_leaf_maps
from hhsr.compiled.records import Owner, Records
from hhsr.compiled.voxel_grid import voxel_grid
from hhsr.kernels import layout as at
from hhsr.kernels import slab as slab_at
from hhsr.kernels import voxels as voxel_at
from hhsr.kernels.crossing import first_exits
from hhsr.kernels.disc_bounds import DISC_SIZE, WIDE
from hhsr.kernels.disc_order import order_facets
from hhsr.kernels.discs import fill_discs, level_sizes
from hhsr.kernels.facets import list_facets
from hhsr.kernels.region_box import leaf_box, part_box
from hhsr.kernels.seeds import fill_seeds
from hhsr.kernels.slab_bounds import fill_lobe_spheres
from hhsr.model import Cut, FloatArray, ModelLeaf, RetainedPart, rotation_matrix

VOXELS_TOTAL = 560_000  # some 3 bytes each, surfels and all
SEEDS_TOTAL = 60_000  # four bytes each
EMPTY = 1e9  # mm: where a block has no disc

BandTables = tuple[tuple[tuple[FloatArray, FloatArray], ...], ...]


class Proofs(Records):
    """The steps that fill what is proven, in the order in which one needs the other."""

    def fill_maps(self, blob: FloatArray, parted: bool) -> FloatArray:
        """Return the blob with the maps of the leaves behind it; parted where the surface needs it, or not."""
        leaves = [owner for owner in self.owners if owner.kind == at.MODEL]
        return appended(blob, fill_leaf_maps(blob, read_only(blob), leaves, parted))

    def fill_facets(self, blob: FloatArray) -> FloatArray:
        """Return the blob with the facets of all leaves behind it."""
        view = read_only(blob)
        codes, discs = [], []
        for number, owner in enumerate(self.owners):
            if owner.kind == at.MODEL:
                room = self._cells(blob, owner)
                own, around = np.empty(room, dtype=np.int64), np.empty((room, DISC_SIZE))
                found = list_facets(view, number, owner.record, owner.planes_at, len(owner.planes), own, around)
                codes.append(own[:found])
                discs.append(around[:found])
        if not codes:
            return blob
        code, disc = np.concatenate(codes), np.concatenate(discs)
        if len(code) == 0:
            return blob
        order = np.empty(len(code), dtype=np.int64)
        order_facets(np.ascontiguousarray(disc[:, :3]), order)
        code, disc = code[order], disc[order]
        sizes = np.array(level_sizes(len(code)), dtype=np.int64)
        per_level = -(-sizes // WIDE)
        blocks = np.full((int(per_level.sum()), DISC_SIZE, WIDE), EMPTY, dtype=np.float32)
        fill_discs(disc, sizes, blocks)
        blob = appended(blob, np.zeros(-len(blob) % LINE))  # codes of a block are two lines of the cache, a row is one
        head, start = self.header(blob), len(blob)
        head[at.FACET_COUNT], head[at.FACET_CODES], head[at.FACET_LEVELS] = len(code), start, start + len(code)
        end = start + len(code) + 3 + 2 * len(sizes)
        gap = -end % LINE
        first = 2 * (end + gap - int(head[at.MAP_START]))
        levels = np.column_stack([np.concatenate([[0], np.cumsum(per_level)[:-1]]), sizes]).ravel()
        numbers = np.concatenate([code, [len(sizes)], levels, [first, len(blocks)], np.zeros(gap)]).astype(np.int64)
        grown = appended(appended(blob, numbers), blocks)
        return self._with_seeds(grown, disc)

    def _with_seeds(self, blob: FloatArray, facets: FloatArray) -> FloatArray:
        """Return the blob with the grid of seeds behind it. facets: (m, 8) discs, in the order of their codes."""
        low, high = facets[:, :3].min(axis=0), facets[:, :3].max(axis=0)
        extent = np.maximum(high - low, 1e-3 * float((high - low).max()) + 1e-9)
        side = max(float(np.prod(extent) / SEEDS_TOTAL) ** (1.0 / 3.0), float(extent.max()) / 1000.0)
        counts = np.ceil(extent / side).astype(np.int64)
        seeds = np.empty(tuple(int(c) for c in counts), dtype=np.int32)
        fill_seeds(np.ascontiguousarray(facets[:, :3]), low, side, seeds)
        start = len(blob)
        grown = appended(
            appended(blob, np.concatenate([counts, [0]])),
            np.array([*low, 1.0 / side, 2.0 * float(np.abs([low, high]).max())]),
        )
        head = self.header(grown)
        head[at.SEED_CELLS], head[at.SEED_FRAME], head[at.SEEDS] = start, start + 4, start + 9
        return appended(grown, seeds)

    def _cells(self, blob: FloatArray, owner: Owner) -> int:
        """Return how many cells the map of a leaf has."""
        ints = blob.view(np.int64)
        last = int(ints[ints[owner.record + at.PARTING] + 6 * ints[owner.record + at.CELLS] ** 2 - 1])
        return int((last >> 4) + 4 ** (last & 7))

    def fill_bands(self, blob: FloatArray, blob_view: FloatArray) -> BandTables:
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
            out = blob[spheres : spheres + slab_at.ENCLOSURE * slab_at.TABLE].reshape(slab_at.TABLE, slab_at.ENCLOSURE)
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

    def _owner_box(self, blob_view: FloatArray, owner: Owner, rotation: FloatArray, shift: FloatArray) -> FloatArray:
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
            spheres = blob_view[o : o + slab_at.ENCLOSURE * slab_at.TABLE].reshape(-1, slab_at.ENCLOSURE)
            spheres = spheres[spheres[:, 5] > 0.0]
            if len(spheres):
                centres = spheres[:, :3] @ rotation.T + shift
                low = np.minimum(low, (centres - spheres[:, 3:4]).min(axis=0))
                high = np.maximum(high, (centres + spheres[:, 3:4]).max(axis=0))
        return np.concatenate([low, high])

    def fill_edges(self, blob: FloatArray, blob_view: FloatArray) -> None:
        """Find the straight edges of the surface."""
        low, high = _union([blob_view[o.box_at : o.box_at + 6] for o in self.owners])
        middle = 0.5 * (low + high) if np.isfinite(low).all() else np.zeros(3)
        cuts = [(cut, planes) for cut, _, planes in self.cuts]
        edges = straight_edges(blob_view, cuts, middle, self._reach(blob))[: self.most_edges]
        head = self.header(blob)
        head[at.EDGE_COUNT] = len(edges)
        start = int(head[at.EDGE_FLOATS])
        for k, edge in enumerate(edges):
            blob[start + 6 * k : start + 6 * k + 6] = edge

    def fill_voxels(self, blob: FloatArray) -> FloatArray:
        """Return the finished blob with the grid of voxels behind it."""
        low, high = self.bounds(read_only(blob), np.eye(3), np.zeros(3))
        extent = high - low
        if not np.isfinite(extent).all() or not (extent > 0).all():
            return blob
        side = float((np.prod(extent) / VOXELS_TOTAL) ** (1.0 / 3.0))
        side = max(side, float(extent.max()) / 1000.0)
        low = low - 0.5 * side
        counts = np.ceil(((high - low) / side + 0.5) / voxel_at.BRICK).astype(np.int64)
        return voxel_grid(blob, low, side, counts)

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
