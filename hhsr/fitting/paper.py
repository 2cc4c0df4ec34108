"""The paper's fit (Algorithm 1): mutex cuts, superquadrics with splines, uniform centres, one budget over all leaves."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

import numpy as np

from hhsr.fitting.bands import add_bands, band_reserve
from hhsr.fitting.cuts import Plane, ranked_planes
from hhsr.fitting.mutex import MutexPairs, mutex_pairs
from hhsr.fitting.options import FitOptions
from hhsr.fitting.retain import require_room, retained_part
from hhsr.fitting.rounding import rounded_node
from hhsr.fitting.share import Claim, shared_out
from hhsr.fitting.source import Source
from hhsr.fitting.split import Part
from hhsr.fitting.uniform_field import base_leaf, best_centre, interior_points
from hhsr.model import MAX_DEPTH, Cut, ModelLeaf, Node, RetainedPart, frozen, normal_angles_of

POSE_NUMBERS = 6
CUT_NUMBERS = 3
BARE_LEAF_NUMBERS = 9
# A leaf's base takes 12–25 numbers; below about 60 a further leaf leaves too little for the fields of all.
NUMBERS_PER_LEAF = 60
PLANES_TRIED = 6
MOST_LEAVES = 64
BASE_POINTS = 250
LEAST_SAMPLES = 40


@dataclass(eq=False)
class Branch:
    """A node of the decomposition: its part, and the plane and children once it is cut."""

    part: Part
    plane: Plane | None = None
    children: list[Branch] = field(default_factory=list)

    def leaves(self) -> list[Branch]:
        """Return the uncut nodes, left to right."""
        return [leaf for child in self.children for leaf in child.leaves()] if self.children else [self]

    def count_cuts(self) -> int:
        return len(self.leaves()) - 1


def fit_paper(source: Source, options: FitOptions) -> Node:
    """Fit a source on its own axes by the paper's Algorithm 1; return the tree's root.

    With a budget the parts with most non-convexity are cut first, as many as leave 60 numbers for each leaf; without
    one, until t1, t2 or the depth stops it. The leaves' uniform centres are bought where they save most.

    Raises
    ------
    FitError : the budget cannot hold what has to be retained, or not even one superquadric.
    """
    budget = options.max_parameters
    require_room(POSE_NUMBERS + BARE_LEAF_NUMBERS, budget, "a pose and one superquadric")
    root = decompose(source, options)
    nodes = {id(b): _base_of(b.part, source, options) for b in root.leaves()}
    reserve = band_reserve(root, source, options)
    fixed = POSE_NUMBERS + CUT_NUMBERS * root.count_cuts()
    nodes = _fitted(root, nodes, source, options, fixed + reserve)
    # Bands lean on the leaves as they are stored.
    tree = rounded_node(_assembled(root, nodes), source.extent_mm)
    room = None if budget is None else budget - POSE_NUMBERS - tree.parameters
    return add_bands(tree, source, options, room)


def threshold_mm(source: Source, options: FitOptions) -> float:
    """Return t in mm: as asked, or 1/40 of the longest side."""
    return options.t_mm if options.t_mm is not None else source.extent_mm / 40.0


def decompose(source: Source, options: FitOptions) -> Branch:
    """Cut the source into approximately convex parts, heaviest part first (PAPER §3, §4; thresholds t1 and t2)."""
    root = Branch(source.root)
    pairs = _pairs(root.part, source, options)
    most = MOST_LEAVES
    if options.max_parameters is not None:
        most = int(np.clip(options.max_parameters // NUMBERS_PER_LEAF, 1, MOST_LEAVES))
    floor = options.t1 * pairs.total
    heap: list[tuple[float, int, Branch, MutexPairs]] = [(-pairs.total, 0, root, pairs)]
    leaves = order = 1
    while heap and leaves < most:
        weight, _, branch, pairs = heapq.heappop(heap)
        # At t1 = 0 a part is cut while it has any weight; without weight it is a leaf.
        if -weight <= floor or branch.part.depth >= MAX_DEPTH or branch.part.box_volume_mm3 < options.t2_mm3:
            continue
        if not _cut(branch, pairs, source, options):
            continue
        leaves += 1
        for child in branch.children:
            found = _pairs(child.part, source, options)
            heapq.heappush(heap, (-found.total, order, child, found))
            order += 1
    return root


def _pairs(part: Part, source: Source, options: FitOptions) -> MutexPairs:
    """Return the mutex pairs of a part."""
    return mutex_pairs(part.vertices, part.faces, part.capped(), threshold_mm(source, options), options.directions)


def _cut(branch: Branch, pairs: MutexPairs, source: Source, options: FitOptions) -> bool:
    """Cut a part by the plane with most utility whose two sides can both be modelled; return whether there is one."""
    points = source.samples.points[source.inside(branch.part)]
    for plane in ranked_planes(pairs, points, PLANES_TRIED):
        sides = branch.part.cut(plane)
        if all(_has_inside(side, source, options.seed) for side in sides):
            branch.plane, branch.children = plane, [Branch(side) for side in sides]
            return True
    return False


def _has_inside(part: Part, source: Source, seed: int) -> bool:
    """Return whether a part has surface and a point inside it to look from."""
    return (
        len(part.faces) > 0
        and source.inside(part).size >= LEAST_SAMPLES
        and interior_points(part, source, seed, 500)[0].shape[0] > 0
    )


def _base_of(part: Part, source: Source, options: FitOptions) -> Node:
    """Return a part's superquadric, or the part retained where it is too small (t2) or has no inside."""
    centre = None if part.box_volume_mm3 < options.t2_mm3 else best_centre(part, source, options.seed)
    if centre is None:
        return retained_part(source.vertices, source.faces, part.planes)
    most = 22 if options.max_parameters is None else max(6, options.max_parameters // 16)
    return base_leaf(part, source, centre, BASE_POINTS, most)


def _fitted(
    root: Branch, nodes: dict[int, Node], source: Source, options: FitOptions, fixed: int
) -> dict[int, Node]:
    """Return the nodes with fields on the leaves; a leaf that misses by more than t3 in the mean is retained."""
    limit = options.t3_mm if options.t3_mm is not None else 0.1 * source.extent_mm
    while True:
        kept = sum(n.parameters for n in nodes.values() if isinstance(n, RetainedPart))
        require_room(POSE_NUMBERS + CUT_NUMBERS * root.count_cuts() + kept, options.max_parameters, "what is retained")
        claims = [
            Claim(id(b), node, b.part) for b in root.leaves() if isinstance(node := nodes[id(b)], ModelLeaf)
        ]
        fits = shared_out(claims, source, options, fixed + kept)
        bad = [key for key, fit in fits.items() if fit.mean_mm > limit]
        if not bad:
            return {**nodes, **{key: fit.leaf for key, fit in fits.items()}}
        for branch in root.leaves():
            if id(branch) in bad:
                nodes[id(branch)] = retained_part(source.vertices, source.faces, branch.part.planes)


def _assembled(branch: Branch, nodes: dict[int, Node]) -> Node:
    """Return the tree of cuts without bands over the leaves' nodes."""
    if branch.plane is None:
        return nodes[id(branch)]
    left, right = (_assembled(child, nodes) for child in branch.children)
    angles = frozen(normal_angles_of(branch.plane.normal))
    return Cut(angles, branch.plane.offset, 0.0, (), left, right)
