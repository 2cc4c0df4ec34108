"""Bands: the blend of two parts across their cut, as wide as it is valid (PAPER §4, DESIGN §2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from hhsr.compiled import compile_tree
from hhsr.evaluate import contour_radius
from hhsr.fitting.contour import Lobe, fit_contour, inside_loop, loop_area, section_lobes, star_centre
from hhsr.fitting.cuts import Plane
from hhsr.fitting.options import FitOptions
from hhsr.fitting.rounding import LENGTH_BITS, power_step, rounded_contour, to_step
from hhsr.fitting.source import Source, threshold_mm
from hhsr.fitting.split import Part
from hhsr.model import Contour, Cut, FloatArray, Node, RetainedPart, Tree, frozen, plane_frame
from hhsr.shape import Shape

RAYS = 256
HALVINGS = 4
LEAST_LOBE_SHARE = 0.02
MOST_HIDDEN = 0.02
MOST_UNCLAIMED = 0.05
GRID = 48
GOAL_SHARE = 0.01
BAND_NUMBERS = 1
CONTOUR_NUMBERS = 6
USUAL_WEIGHTS = 12


class Outline(NamedTuple):
    """A cut's section in the source: the lobes, and a centre for each that sees them at h = −d, 0 and +d."""

    lobes: list[Lobe]
    centres: list[FloatArray]


def wanted_half_width(source: Source, options: FitOptions) -> float:
    """Return the half width d (mm) that is tried first: as asked, or half of t."""
    if options.half_width_mm is not None:
        return options.half_width_mm
    return 0.5 * threshold_mm(source, options)


def outline(frame: FloatArray, offset: float, part: Part, source: Source, d: float, t_mm: float) -> Outline | None:
    """Return the source's section of a cut within a part's region, if one centre per lobe sees it at −d, 0 and +d.

    Lobes of less than 2 % of the section's area are left to the step faces. None where a lobe has a hole, or
    some centre would miss more than 2 % of an outline.
    """
    heights = (-d, 0.0, d) if d > 0.0 else (0.0,)
    sections = [_lobes_in(frame, offset + h, part, source, t_mm) for h in heights]
    middle = sections[len(sections) // 2]
    if not middle:
        return None
    lobes, centres = [], []
    for lobe in middle:
        loops = [lobe.points]
        for section in sections:
            loops += [other.points for other in section if other is not lobe and _meet(lobe.points, other.points)]
        centre, hidden = star_centre(loops, lobe.points)
        if hidden > MOST_HIDDEN or any(not inside_loop(loop, centre[None])[0] for loop in loops):
            return None
        lobes.append(lobe)
        centres.append(centre)
    return Outline(lobes, centres)


def _lobes_in(frame: FloatArray, offset: float, part: Part, source: Source, t_mm: float) -> list[Lobe]:
    """Return the loops of one plane section that reach into a region; those of next to no area left out."""
    loops = section_lobes(source.vertices, source.faces, frame, offset, t_mm / 3.0)
    lobes = []
    for loop in loops:
        seen = part.holds(loop @ frame[:2] + offset * frame[2])
        if seen.any():
            lobes.append(Lobe(loop, seen))
    areas = [loop_area(lobe.points) for lobe in lobes]
    return [lobe for lobe, area in zip(lobes, areas, strict=True) if area >= LEAST_LOBE_SHARE * sum(areas)]


def _meet(first: FloatArray, second: FloatArray) -> bool:
    """Return whether one loop holds a point of the other."""
    return bool(inside_loop(first, second[:1])[0]) or bool(inside_loop(second, first[:1])[0]) or _overlap(first, second)


def _overlap(first: FloatArray, second: FloatArray) -> bool:
    """Return whether some point of either loop lies in the other."""
    return bool(inside_loop(first, second).any()) or bool(inside_loop(second, first).any())


class HasPlane(Protocol):
    """A cut part, as the decomposition knows it."""

    part: Part
    plane: Plane | None


def band_reserve(branches: Sequence[HasPlane], source: Source, options: FitOptions) -> int:
    """Return how many numbers to keep free for the contours of cuts whose sections in the source allow some band."""
    d = wanted_half_width(source, options) / 2**HALVINGS
    total = 0
    for branch in branches if d > 0.0 else ():
        if branch.plane is not None:
            frame = plane_frame(branch.plane.normal)
            found = outline(frame, branch.plane.offset, branch.part, source, d, threshold_mm(source, options))
            total += BAND_NUMBERS + (CONTOUR_NUMBERS + USUAL_WEIGHTS) * len(found.lobes) if found is not None else 0
    return total


def add_bands(node: Node, part: Part, source: Source, options: FitOptions, room: int | None) -> tuple[Node, int | None]:
    """Return the tree with a band on every cut where one is valid, bottom up, and the numbers that are left.

    d starts at `wanted_half_width` and is halved until the band is valid on the fitted solid; a cut whose d would fall
    below 1/16 of that, or whose contours do not go into the room, keeps d = 0 and stores none.

    Parameters
    ----------
    node, part : the subtree, and the part of the source that its region holds.
    room : numbers that contours may take; None: any.
    """
    if not isinstance(node, Cut):
        return node, room
    plane = Plane(np.array(node.normal), node.offset)
    sides = [replace(part, planes=(*part.planes, (plane, side))) for side in (-1, 1)]
    left, room = add_bands(node.left, sides[0], source, options, room)
    right, room = add_bands(node.right, sides[1], source, options, room)
    node = replace(node, left=left, right=right)
    d = wanted_half_width(source, options)
    children = [Shape(Tree(child, frozen(np.zeros(6)))) for child in (left, right)]
    for child in children:  # asked a few hundred times, and never for a distance
        child.__dict__["compiled"] = compile_tree(child.tree, sketch=True)
    for _ in range(HALVINGS + 1 if d > 0.0 else 0):
        banded = banded_cut(node, children, part, source, options, d)
        if banded is not None:
            cost = banded.own_parameters - node.own_parameters
            if room is not None and cost > room:
                break
            return banded, None if room is None else room - cost
        d *= 0.5
    return node, room


def banded_cut(
    node: Cut, children: list[Shape], part: Part, source: Source, options: FitOptions, d: float
) -> Cut | None:
    """Return the cut with a band of half width d (mm), or None where that is not valid on its fitted children."""
    found = outline(np.asarray(node.frame), node.offset, part, source, d, threshold_mm(source, options))
    if found is None:
        return None
    contours = []
    for lobe, centre in zip(found.lobes, found.centres, strict=True):
        size = math.sqrt(loop_area(lobe.points) / math.pi)
        contour = fit_contour(lobe, centre, GOAL_SHARE * size)
        if contour is None:
            return None
        contours.append(rounded_contour(contour, source.extent_mm))
    step = power_step(source.extent_mm, LENGTH_BITS)
    banded = replace(node, half_width=max(float(to_step(np.array(d), step)), step), contours=tuple(contours))
    return banded if is_valid(banded, children, part, source.extent_mm) else None


def is_valid(cut: Cut, children: list[Shape], part: Part, extent_mm: float) -> bool:
    """Return whether a cut's band is valid on its fitted children, left and right (DESIGN §2).

    Each side's section at ∓d has in every lobe one exit along each of 256 in-plane rays from the lobe's centre (within
    the region); r > 0 throughout; lobes are disjoint; and the lobes hold all but 5 % of each side's section.
    """
    tables: list[list[FloatArray]] = []
    for side, child in zip((-1, 1), children, strict=True):
        radii = [_exits(contour, cut, side, child, part, extent_mm) for contour in cut.contours]
        if any(r is None for r in radii):
            return False
        tables.append([r for r in radii if r is not None])
    angles = -math.pi + 2.0 * math.pi * np.arange(RAYS) / RAYS
    for k, contour in enumerate(cut.contours):
        low = ((np.sqrt(tables[0][k]) - np.sqrt(tables[1][k])) / 2.0) ** 2
        if not (contour_radius(contour, angles) > low + 1e-9).all():
            return False
    middle = [contour_radius(contour, angles) for contour in cut.contours]
    if not all(_disjoint(cut.contours, outlines, angles) for outlines in (tables[0], middle, tables[1])):
        return False
    return all(
        _unclaimed(cut, side, child, part, table) <= MOST_UNCLAIMED
        for side, child, table in zip((-1, 1), children, tables, strict=True)
    )


def _exits(contour: Contour, cut: Cut, side: int, child: Shape, part: Part, extent_mm: float) -> FloatArray | None:
    """Return (256,) mm where rays from a lobe's centre leave a child's solid at h = side · d; None: not just once."""
    if isinstance(child.tree.root, RetainedPart) and not len(child.tree.root.faces):
        return None
    height = cut.offset + side * cut.half_width
    start = contour.centre @ cut.frame[:2] + height * cut.frame[2]
    if not child.contains(start) or not part.holds(start[None])[0]:
        return None
    angles = -math.pi + 2.0 * math.pi * np.arange(RAYS) / RAYS
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ cut.frame[:2]
    reach = 2.0 * extent_mm
    starts = np.broadcast_to(start, along.shape)
    found = child.crossings(starts, start + reach * along)
    row = np.repeat(np.arange(RAYS), np.diff(found.offsets))
    counted = np.bincount(row, weights=part.holds(found.points).astype(np.float64), minlength=RAYS)
    edge = part.exits(starts, along)
    ends_inside = counted == 0
    # A ray without an exit must have left the region while still inside.
    if (counted > 1).any() or (ends_inside & ~np.isfinite(edge)).any() or (np.diff(found.offsets) == 0).any():
        return None
    return np.asarray(found.t[found.offsets[:-1]] * reach)


def _disjoint(contours: tuple[Contour, ...], radii: list[FloatArray], angles: FloatArray) -> bool:
    """Return whether no lobe's outline reaches into another lobe."""
    outlines = [
        c.centre + r[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        for c, r in zip(contours, radii, strict=True)
    ]
    return not any(_overlap(a, b) for i, a in enumerate(outlines) for b in outlines[i + 1 :])


def _unclaimed(cut: Cut, side: int, child: Shape, part: Part, radii: list[FloatArray]) -> float:
    """Return the share of a child's section at h = side · d, within the region, that no lobe holds."""
    far = max(float(r.max()) for r in radii)
    low = np.min([c.centre for c in cut.contours], axis=0) - 1.5 * far
    high = np.max([c.centre for c in cut.contours], axis=0) + 1.5 * far
    grid = np.stack(np.meshgrid(*(np.linspace(low[i], high[i], GRID) for i in range(2))), axis=-1).reshape(-1, 2)
    points = grid @ cut.frame[:2] + (cut.offset + side * cut.half_width) * cut.frame[2]
    kept = part.holds(points)
    grid, points = grid[kept], points[kept]
    inside = np.asarray(child.contains(points), dtype=np.bool_)
    claimed = np.zeros(inside.size, dtype=np.bool_)
    angles = -math.pi + 2.0 * math.pi * np.arange(RAYS) / RAYS
    for contour, radius in zip(cut.contours, radii, strict=True):
        away = grid - contour.centre
        claimed |= np.hypot(*away.T) < np.interp(np.arctan2(away[:, 1], away[:, 0]), angles, radius, period=2 * math.pi)
    return float((inside & ~claimed).sum() / max(int(inside.sum()), 1))
