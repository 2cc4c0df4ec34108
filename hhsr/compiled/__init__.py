"""A tree laid out flat for the kernels, with its proven bounds: one read-only blob (layout: `hhsr.kernels.layout`).

Nothing of it is stored in a file: it is made from the records on the first query, in a few tenths of a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from hhsr.compiled.blob import read_only, room
from hhsr.compiled.proofs import BandTables, Proofs
from hhsr.compiled.records import pose_arrays
from hhsr.kernels import layout as at
from hhsr.model import FloatArray, Tree, frozen, rotation_matrix


@dataclass(frozen=True, eq=False)
class Compiled:
    """What the kernels take, and a few derived figures.

    blob: read-only. band_tables: per cut (parents first, left before right) and lobe, the (256,) radii L at h = −d and
    R at h = d, mm, at α_i = −π + 2π·i/256.
    """

    blob: FloatArray
    band_tables: BandTables
    layout: Proofs
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
        blob = room(self.blob.size)
        blob[:] = self.blob
        start = int(self.layout.header(blob)[at.POSE])
        blob[start : start + 12] = pose_arrays(pose)
        blob.setflags(write=False)
        return Compiled(blob, self.band_tables, self.layout, pose)


def compile_tree(tree: Tree, sketch: bool = False) -> Compiled:
    """Lay a tree out flat and prove its bounds; every tree has a solid, whatever its numbers (DESIGN §2).

    sketch: in a tenth of the time, for a few hundred questions of `contains` and `crossings`: coarse maps, no voxels,
    and no facets, without which no distance may be asked.
    """
    layout = Proofs(tree)
    blob = layout.fill_maps(layout.assemble(), not sketch)
    if not sketch:
        blob = layout.fill_facets(blob)
    view = read_only(blob)
    tables = layout.fill_bands(blob, view)
    if not sketch:
        layout.fill_boxes(blob, view)
        layout.fill_edges(blob, view)
        blob = layout.fill_voxels(blob)
    start = int(layout.header(blob)[at.POSE])
    blob[start : start + 12] = pose_arrays(tree.pose)
    blob.setflags(write=False)
    return Compiled(blob, tables, layout, tree.pose)


__all__ = ["Compiled", "compile_tree"]
