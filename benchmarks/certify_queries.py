"""The queries of fitted shapes against slow twins, at length: how many answers differ. Exits 1 if any does.

    python benchmarks/certify_queries.py SHAPE.hhsr … [--points 10000000] [--segments 100000] [--short 100000]
                                         [--long 500] [--distances 10000]

contains: the voxels' and the maps' answer against the sign of `field`, the formulas alone, on uniform points, points
within 0.05 mm of the surface and points on cutting planes. crossings: an even count between outside points, on segments
along axes, through leaf centres and within cutting planes too; between two crossings the state that they claim; on
segments of at most 2 mm about the surface, and on long ones, the states at steps of 0.002 mm; the first crossing alone
is the first of all. distances: their feet are surface, and no other surface point is nearer. clearances: never above
201 distances.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from scipy.spatial import cKDTree

import hhsr
from hhsr.model import Cut, ModelLeaf, Node, leaves, rotation_matrix

MESH_MM = 0.02
STEP_MM, RESOLUTION_STEPS = 0.002, 6
CHUNK = 1_000_000


def planes_of(node: Node) -> list[tuple[np.ndarray, float]]:
    """Return the cutting planes (n, c) of a tree."""
    if not isinstance(node, Cut):
        return []
    return [(np.array(node.normal), float(node.offset)), *planes_of(node.left), *planes_of(node.right)]


def points_of(shape: hhsr.Shape, surface: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return (count, 3) points: half uniform, the rest close to the surface and on cutting planes."""
    low, high = shape.bounds
    points = rng.uniform(low - 2.0, high + 2.0, (count, 3))
    near = count // 3
    points[:near] = surface[rng.integers(len(surface), size=near)] + rng.normal(size=(near, 3)) * 0.05
    rotation, shift = rotation_matrix(shape.tree.pose[:3]), shape.tree.pose[3:]
    for k, (normal, offset) in enumerate(planes_of(shape.tree.root)):
        rows = slice(near + k * (count // 100), near + (k + 1) * (count // 100))
        local = (points[rows] - shift) @ rotation
        local -= ((local @ normal) - offset)[:, None] * normal
        points[rows] = local @ rotation.T + shift
    return points


def segments_of(shape: hhsr.Shape, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return (count, 3) ends of long segments, all outside the box: any way, along axes, through leaf centres."""
    low, high = shape.bounds
    middle, reach = 0.5 * (low + high), float(np.linalg.norm(high - low))
    through = rng.uniform(low, high, (count, 3))
    way = rng.normal(size=(count, 3))
    way[: count // 4] = np.eye(3)[rng.integers(3, size=count // 4)]
    rotation, shift = rotation_matrix(shape.tree.pose[:3]), shape.tree.pose[3:]
    centres = [leaf.centre @ rotation.T + shift for leaf in leaves(shape.tree.root) if isinstance(leaf, ModelLeaf)]
    if centres:
        some = rng.integers(len(centres), size=count // 4)
        through[count // 8 : count // 8 + count // 4] = np.array(centres)[some]
    planes = planes_of(shape.tree.root)
    for k in range(count // 2, count // 2 + count // 8 if planes else 0):
        normal, offset = planes[k % len(planes)]
        local = (through[k] - shift) @ rotation
        through[k] = (local - (local @ normal - offset) * normal) @ rotation.T + shift
        local = way[k] @ rotation
        way[k] = (local - (local @ normal) * normal) @ rotation.T
    way /= np.linalg.norm(way, axis=1)[:, None]
    far = reach + np.linalg.norm(through - middle, axis=1)[:, None]
    return through - far * way, through + far * way


def steps_against(shape: hhsr.Shape, starts: np.ndarray, ends: np.ndarray, room: int = 2_000_000) -> int:
    """Return on how many segments (n, 3) → (n, 3) the states at small steps and the crossings disagree.

    On longer than the resolution; or, where both have as many crossings, on more than a step and the tolerance.
    """
    wrong = i = 0
    length = np.linalg.norm(ends - starts, axis=1)
    number = np.ceil(length / STEP_MM).astype(int) + 2
    while i < len(starts):
        j = max(int(np.searchsorted(np.cumsum(number[i:]), room)), 1) + i
        some, row = number[i:j], np.repeat(np.arange(i, min(j, len(starts))), number[i:j])
        share = (np.arange(len(row)) - np.repeat(np.cumsum(some) - some, some)) / (number[row] - 1)
        states = np.asarray(shape.contains(starts[row] + share[:, None] * (ends - starts)[row]))
        found = shape.crossings(starts[i:j], ends[i:j])
        counts = np.diff(found.offsets)
        keys = 2.0 * np.repeat(np.arange(len(counts)), counts) + found.t
        passed = np.searchsorted(keys, 2.0 * (row - i) + share) - found.offsets[row - i]
        begins = np.asarray(shape.contains(starts[i:j]))
        apart = states != (begins[row - i] ^ (passed % 2 == 1))
        flips = np.bincount(
            row[1:] - i, weights=(states[1:] != states[:-1]) & (row[1:] == row[:-1]), minlength=len(counts)
        )
        # The length of each stretch of disagreement, in steps.
        edges = np.flatnonzero(np.diff(np.concatenate([[False], apart, [False]]).astype(int)))
        first, steps = edges[::2], edges[1::2] - edges[::2]
        same = (counts == flips)[row[first] - i]
        bad = (steps > RESOLUTION_STEPS) | (same & (steps > 2))
        wrong += len(np.unique(row[first][bad]))
        i = j
    return wrong


def other_firsts(shape: hhsr.Shape, starts: np.ndarray, ends: np.ndarray, found: hhsr.Crossings) -> int:
    """Return of how many segments (n, 3) → (n, 3) the first crossing is not the first of all."""
    some = np.diff(found.offsets) > 0
    own = np.full(len(starts), np.nan)
    own[some] = found.t[found.offsets[:-1][some]]
    return int((~np.isclose(shape.first_crossing(starts, ends), own, rtol=0.0, atol=0.0, equal_nan=True)).sum())


def certify(path: str, points: int, segments: int, short: int, long: int, distances: int, seed: int) -> int:
    """Print one line for each query and return how many answers are wrong."""
    shape, rng = hhsr.load(path), np.random.default_rng(seed)
    mesh = shape.mesh(MESH_MM)
    surface = np.asarray(mesh.vertices)
    wrong = asked = 0
    while asked < points:
        some = points_of(shape, surface, min(CHUNK, points - asked), rng)
        wrong += int((shape.contains(some) != (shape.field(some) <= 0.0)).sum())
        asked += len(some)
    print(f"{path}: contains, {asked} points: {wrong} differ from the formulas")
    starts, ends = segments_of(shape, segments, rng)
    found = shape.crossings(starts, ends)
    odd = int((np.diff(found.offsets) % 2 == 1).sum())
    row = np.repeat(np.arange(segments), np.diff(found.offsets))
    same = row[1:] == row[:-1]
    middle = 0.5 * (found.t[1:] + found.t[:-1])[same]
    length = np.linalg.norm(ends - starts, axis=1)[row[1:][same]]
    # Within a cutting plane rounding decides between the states of its sides: there only the parity is asked.
    inside_plane = (row[1:][same] >= segments // 2) & (row[1:][same] < segments // 2 + segments // 8)
    wide = ((found.t[1:] - found.t[:-1])[same] * length > 0.02) & ~inside_plane
    at = (starts[row[1:][same]] + middle[:, None] * (ends - starts)[row[1:][same]])[wide]
    false = int(((shape.field(at) <= 0.0) != found.entering[:-1][same][wide]).sum())
    others = other_firsts(shape, starts, ends, found)
    print(f"  crossings, {segments} segments, {len(found.t)} crossings: {odd} odd, {false} stretches of a wrong state")
    middle = surface[rng.integers(len(surface), size=short)] + rng.normal(size=(short, 3)) * 0.3
    way = rng.normal(size=(short, 3))
    way *= rng.uniform(0.0, 1.0, (short, 1)) / np.linalg.norm(way, axis=1)[:, None]
    missed = steps_against(shape, middle - way, middle + way)
    others += other_firsts(shape, middle - way, middle + way, shape.crossings(middle - way, middle + way))
    starts, ends = segments_of(shape, 2 * long, rng)  # the second half lies in cutting planes, in part
    missed_long = steps_against(shape, starts[:long], ends[:long])
    print(
        f"  against steps of {STEP_MM} mm: {missed} of {short} short segments differ, {missed_long} of {long} long ones"
    )
    print(f"  first crossings, {segments + short} segments: {others} not the first of all")
    # A distance is right if its foot is on the surface, and no other surface point (feet of points near it) is nearer.
    exact = shape.closest_point(surface[rng.integers(len(surface), size=10 * distances)])[0]
    low, high = shape.bounds
    some = rng.uniform(low - 5.0, high + 5.0, (distances, 3))
    some[::2] = surface[rng.integers(len(surface), size=len(some[::2]))] + rng.normal(size=(len(some[::2]), 3))
    foot, distance = shape.closest_point(some)
    nearest, _ = cKDTree(exact).query(some)
    beaten = int((np.abs(distance) > nearest + 0.0101).sum())
    off = foot
    for ways in (64, 4096, 1_000_000):  # a thin wedge is met by few
        around = rng.normal(size=(ways, 3))
        states = shape.contains(off[:, None] + 2e-4 * around / np.linalg.norm(around, axis=1)[:, None])
        off = off[states.all(axis=1) | ~states.any(axis=1)]
    floating = len(off)
    sign = int(((distance < 0) != shape.contains(some))[np.abs(distance) > 1e-9].sum())
    bad = beaten + floating + sign
    print(
        f"  signed distance, {distances}: {beaten} beaten by another point, {floating} feet off it, {sign} signs wrong"
    )
    a, b = rng.uniform(low - 20.0, high + 20.0, (2, distances // 10, 3))
    clear = shape.clearance(a, b, 0.0)
    steps = np.linspace(0.0, 1.0, 201)
    signed = np.array([shape.signed_distance(p + steps[:, None] * (q - p)).min() for p, q in zip(a, b, strict=True)])
    step = np.linalg.norm(b - a, axis=1) / 400.0
    optimistic, low_by = int((clear > signed + 1e-9 + 0.01).sum()), int((clear < signed - step - 0.0201).sum())
    print(f"  clearance, {len(a)} segments: {optimistic} optimistic, {low_by} too low")
    return wrong + odd + false + others + missed + missed_long + bad + optimistic + low_by


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shapes", nargs="+")
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--segments", type=int, default=100_000)
    parser.add_argument("--short", type=int, default=100_000)
    parser.add_argument("--long", type=int, default=500)
    parser.add_argument("--distances", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    how_many = args.points, args.segments, args.short, args.long, args.distances
    sys.exit(1 if sum(certify(path, *how_many, args.seed) for path in args.shapes) else 0)


if __name__ == "__main__":
    main()
