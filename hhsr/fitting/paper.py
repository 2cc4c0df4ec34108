"""The paper's fit (Algorithm 1): mutex cuts, superquadrics with splines, uniform centres, one budget over all."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

import numpy as np

from hhsr.errors import FitError
from hhsr.fitting.bands import add_bands, band_reserve
from hhsr.fitting.cuts import Plane, ranked_planes
from hhsr.fitting.mutex import MutexPairs, mutex_pairs
from hhsr.fitting.options import FitOptions
from hhsr.fitting.retain import require_room, retained_part
from hhsr.fitting.rounding import rounded_node
from hhsr.fitting.share import Ladder, shared_out
from hhsr.fitting.source import Source, threshold_mm
from hhsr.fitting.split import Part
from hhsr.fitting.uniform_field import FieldFit, base_leaf, best_centre, interior_points
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
T3_SHARE = 0.1
WORTH_REFITTING = 16
COUNTS = (0, 1, 2, 3, 5, 8, 12, 18, 27, 40)


@dataclass(eq=False)
class Branch:
    """A node of the decomposition: its part; once it is cut, the plane, the children, and which cut of all it was."""

    part: Part
    plane: Plane | None = None
    children: list[Branch] = field(default_factory=list)
    rank: int = 0

    def leaves(self, cuts: int) -> list[Branch]:
        """Return the parts that the first `cuts` cuts make, left to right."""
        if self.plane is None or self.rank >= cuts:
            return [self]
        return [leaf for child in self.children for leaf in child.leaves(cuts)]


def fit_paper(source: Source, options: FitOptions) -> Node:
    """Fit a source on its own axes by the paper's Algorithm 1; return the tree's root.

    Without a budget it is cut until t1, t2 or the depth stops it. With one the parts with most non-convexity are cut
    first; as many cuts are kept as make the leaves miss least, and uniform centres are bought where they save most.

    Raises
    ------
    FitError : the budget cannot hold what has to be retained, or not even one superquadric.
    """
    require_room(POSE_NUMBERS + BARE_LEAF_NUMBERS, options.max_parameters, "a pose and one superquadric")
    fitting = _Fitting(source, options)
    count = fitting.best_count()
    bare = fitting.tree(count, fitting.reserve(count))
    if options.max_parameters is None:
        return add_bands(bare, source.root, source, options, None)[0]
    budget = options.max_parameters - POSE_NUMBERS
    banded, left = add_bands(bare, source.root, source, options, budget - bare.parameters)
    if left is None or left < WORTH_REFITTING:
        return banded
    # What no band wanted goes back to the leaves; bands lean on the leaves, so they are tried again.
    spent = banded.parameters - bare.parameters
    bare = fitting.tree(count, spent)
    return add_bands(bare, source.root, source, options, budget - bare.parameters)[0] if spent else bare


def decompose(source: Source, options: FitOptions) -> tuple[Branch, int]:
    """Cut the source into approximately convex parts, heaviest part first (PAPER §3, §4; thresholds t1 and t2).

    Returns the root of the decomposition and the number of cuts.
    """
    root = Branch(source.root)
    pairs = _pairs(root.part, source, options)
    most = MOST_LEAVES
    if options.max_parameters is not None:
        most = int(np.clip(options.max_parameters // NUMBERS_PER_LEAF, 1, MOST_LEAVES))
    floor = options.t1 * pairs.total
    heap: list[tuple[float, int, Branch, MutexPairs]] = [(-pairs.total, 0, root, pairs)]
    cuts, order = 0, 1
    while heap and cuts + 1 < most:
        weight, _, branch, pairs = heapq.heappop(heap)
        # At t1 = 0 a part is cut while it has any weight; without weight it is a leaf.
        if -weight <= floor or branch.part.depth >= MAX_DEPTH or branch.part.box_volume_mm3 < options.t2_mm3:
            continue
        if not _cut(branch, pairs, source, options):
            continue
        branch.rank = cuts
        cuts += 1
        for child in branch.children:
            found = _pairs(child.part, source, options)
            heapq.heappush(heap, (-found.total, order, child, found))
            order += 1
    return root, cuts


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


class _Fitting:
    """One run: the decomposition, and for each of its parts the superquadric and the fields tried on it."""

    def __init__(self, source: Source, options: FitOptions) -> None:
        self.source, self.options = source, options
        self.limit_mm = options.t3_mm if options.t3_mm is not None else T3_SHARE * source.extent_mm
        self.root, self.cuts = decompose(source, options)
        self._bases: dict[int, Node] = {}
        self._ladders: dict[int, Ladder] = {}

    def best_count(self) -> int:
        """Return how many cuts to keep: all without a budget; else as many as miss least, of 0, 1, 2, 3, 5, 8, 12, …"""
        if self.options.max_parameters is None:
            return self.cuts
        best: tuple[float, int] | None = None
        for count in [c for c in COUNTS if c < self.cuts] + [self.cuts]:
            try:
                miss = sum(fit.area_error for fit in self._fields(count, self._fixed(count), fill=False).values())
            except FitError:
                continue
            if best is None or miss < best[0]:
                best = miss, count
        if best is None:
            # Not even the whole as one part goes in: say why.
            self._fields(0, self._fixed(0))
            return 0
        return best[1]

    def reserve(self, count: int) -> int:
        """Return how many numbers to keep free for the contours of the kept cuts."""
        if self.options.max_parameters is None:
            return 0
        free = self.options.max_parameters - self._fixed(count) - 9 * (count + 1)
        return min(band_reserve(self._kept(self.root, count), self.source, self.options), max(free, 0) // 4)

    def tree(self, count: int, reserve: int) -> Node:
        """Return the fitted tree of the first `count` cuts, without bands, its numbers as they are stored."""
        fits = self._fields(count, self._fixed(count) + reserve)
        # Bands lean on the leaves as they are stored.
        return rounded_node(self._assembled(self.root, count, fits), self.source.extent_mm)

    def _kept(self, branch: Branch, count: int) -> list[Branch]:
        """Return the cut branches among the first `count`."""
        if branch.plane is None or branch.rank >= count:
            return []
        return [branch] + [b for child in branch.children for b in self._kept(child, count)]

    def _fixed(self, count: int) -> int:
        return POSE_NUMBERS + CUT_NUMBERS * count

    def base(self, branch: Branch) -> Node:
        """Return a part's superquadric, or the part retained where it is too small (t2) or has no inside."""
        if id(branch) not in self._bases:
            part, source, options = branch.part, self.source, self.options
            centre = None if part.box_volume_mm3 < options.t2_mm3 else best_centre(part, source, options.seed)
            most = 22 if options.max_parameters is None else max(6, options.max_parameters // 16)
            self._bases[id(branch)] = (
                self._retained(branch) if centre is None else base_leaf(part, source, centre, BASE_POINTS, most)
            )
        return self._bases[id(branch)]

    def _retained(self, branch: Branch) -> RetainedPart:
        return retained_part(self.source.vertices, self.source.faces, branch.part.planes)

    def _fields(self, count: int, fixed: int, fill: bool = True) -> dict[int, FieldFit]:
        """Return the fits of the model leaves by branch; one that misses by more than t3 in the mean is retained."""
        while True:
            branches = self.root.leaves(count)
            nodes = [self.base(b) for b in branches]
            kept = sum(n.parameters for n in nodes if isinstance(n, RetainedPart))
            require_room(fixed + kept, self.options.max_parameters, "what is retained, with the cuts,")
            models = [(b, n) for b, n in zip(branches, nodes, strict=True) if isinstance(n, ModelLeaf)]
            for branch, leaf in models:
                self._ladders.setdefault(id(branch), Ladder(leaf, branch.part, self.source))
            fits = shared_out([self._ladders[id(b)] for b, _ in models], self.options, fixed + kept, fill)
            bad = [b for (b, _), fit in zip(models, fits, strict=True) if fit.mean_mm > self.limit_mm]
            if not bad:
                return {id(b): fit for (b, _), fit in zip(models, fits, strict=True)}
            for branch in bad:
                self._bases[id(branch)] = self._retained(branch)

    def _assembled(self, branch: Branch, count: int, fits: dict[int, FieldFit]) -> Node:
        """Return the tree of the first `count` cuts without bands."""
        if branch.plane is None or branch.rank >= count:
            return fits[id(branch)].leaf if id(branch) in fits else self.base(branch)
        left, right = (self._assembled(child, count, fits) for child in branch.children)
        angles = frozen(normal_angles_of(branch.plane.normal))
        return Cut(angles, branch.plane.offset, 0.0, (), left, right)
