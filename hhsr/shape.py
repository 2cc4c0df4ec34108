"""Shape: what a user asks of a fitted organ. Points in LPS mm, (..., 3) in, (...) out; distances < 0 inside."""

from __future__ import annotations

import builtins
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hhsr import io
from hhsr.answers import (
    Clearance,
    Crossings,
    OnInvalid,
    Profile,
    broadcast_segments,
    crossings_of_one,
    curve,
    is_point,
    marks,
    scalar,
)
from hhsr.batches import in_parts
from hhsr.check import as_float, as_points, as_rigid, require_finite
from hhsr.compiled import Compiled, compile_tree
from hhsr.errors import FileFormatError, InputError
from hhsr.kernels import contains as contains_kernels
from hhsr.kernels import crossing as crossing_kernels
from hhsr.kernels import tree as tree_kernels
from hhsr.kernels.clearance import clearance_one
from hhsr.kernels.distance import distance_one
from hhsr.local_error import errors_at
from hhsr.model import ErrorFigures, FloatArray, Provenance, Tree, rotation_matrix
from hhsr.rows import clearance_of_rows, crossings_of_rows, first_of_rows, nearest_to_rows
from hhsr.surface import reconstruct

if TYPE_CHECKING:
    import trimesh

RESOLUTION_MM = 0.01
CROSSING_TOLERANCE_MM = 0.001
TOLERANCE_MM = 0.01


class Shape:
    """A fitted shape: a tree of small records, and every question about the solid that it means (DESIGN §2).

    Parameters
    ----------
    tree : the records and their pose
    provenance : where it comes from and how well it fits
    report : how the fit went, JSON values; by default the provenance's
    """

    def __init__(
        self, tree: Tree, provenance: Provenance | None = None, report: Mapping[str, Any] | None = None
    ) -> None:
        self.tree = tree
        self.provenance = provenance if provenance is not None else Provenance()
        self.report: dict[str, Any] = dict(report if report is not None else self.provenance.report)

    @cached_property
    def compiled(self) -> Compiled:
        """The tree laid out for the kernels; made on the first query, or by `warm_up`."""
        return compile_tree(self.tree)

    @cached_property
    def _blob(self) -> FloatArray:
        return self.compiled.blob

    def warm_up(self) -> Shape:
        """Compile the tree and the kernels now, so that no later query waits; return the shape."""
        at = np.zeros((1, 3))
        for points in (at, at[0]):  # one point goes by a door of its own
            self.contains(points)
            self.field(points)
            self.closest_point(points)
            self.signed_distance(points)
            self.crossings(points, points + 1.0)
            self.first_crossing(points, points + 1.0)
            self.clearance(points, points + 1.0)
        return self

    # -- what it is ---------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> int:
        """How many numbers the shape is made of (the counting rule of `hhsr.model`)."""
        return self.tree.parameters

    @cached_property
    def encoded(self) -> builtins.bytes:
        """The content of the shape's file."""
        return io.encode(self.tree, self.provenance)

    @property
    def bytes(self) -> int:
        """Size of the shape's file."""
        return len(self.encoded)

    @property
    def fit_error(self) -> ErrorFigures | None:
        """Two-sided true distance to the source, mm: mean, 95th percentile, sampled maximum; None: not measured."""
        return self.provenance.fit_error

    @property
    def leaf_errors(self) -> tuple[ErrorFigures, ...]:
        """The same for each leaf, left to right."""
        return self.provenance.leaf_errors

    def fit_error_at(self, points: ArrayLike) -> Any:
        """Return (...) mm, the fit's sampled maximum error near points (..., 3) of its surface: `hhsr.local_error`."""
        array = as_points(points)
        require_finite(array, "points")
        flat = errors_at(self.tree, self.fit_error, self.leaf_errors, self.report, array.reshape(-1, 3))
        return scalar(flat.reshape(array.shape[:-1]))

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) lowest and highest corner of the solid's box, LPS mm; NaN for an empty solid."""
        return self.compiled.bounds

    def mesh(self, tolerance_mm: float = 0.02) -> trimesh.Trimesh:
        """Return the surface as a closed mesh, LPS mm, no farther than the tolerance from it."""
        return reconstruct(self.tree, as_float(tolerance_mm, "tolerance_mm", 1e-4, 1e3))

    def moved(self, T_target_source: ArrayLike) -> Shape:
        """Return the shape after a rigid motion (4, 4), mm: nothing is fitted or proven again."""
        motion = as_rigid(T_target_source)
        pose = np.empty(6)
        pose[:3] = Rotation.from_matrix(motion[:3, :3] @ rotation_matrix(self.tree.pose[:3])).as_rotvec()
        pose[3:] = motion[:3, :3] @ self.tree.pose[3:] + motion[:3, 3]
        pose.setflags(write=False)
        shape = Shape(Tree(self.tree.root, pose), self.provenance, self.report)
        if "compiled" in self.__dict__:
            shape.__dict__["compiled"] = self.compiled.moved(pose)
        return shape

    def save(self, path: str | Path) -> None:
        """Write the shape to a .hhsr file."""
        Path(path).write_bytes(self.encoded)

    # -- where a point is ---------------------------------------------------------------------------------------------

    def contains(self, points: ArrayLike, on_invalid: OnInvalid = "raise") -> Any:
        """Return (...) bool, whether the solid holds points (..., 3) mm; on the surface is inside.

        on_invalid="mark": int8 instead, 1 inside, 0 outside, −1 where a point is not finite (else that is InputError).
        """
        if is_point(points):
            code = contains_kernels.contains_one(self._blob, *points.tolist())
            if code >= 0 and on_invalid == "raise":
                return code == 1
        array, mark = as_points(points), marks(on_invalid)
        flat = array.reshape(-1, 3)
        out = np.empty(len(flat), dtype=np.int8)
        blob = self._blob
        bad = sum(in_parts(len(flat), 20_000, lambda i, j: contains_kernels.contains_many(blob, flat[i:j], out[i:j])))
        if bad and not mark:
            require_finite(array, "points")
        result = out.reshape(array.shape[:-1])
        return scalar(result if mark else result.view(np.bool_))  # then all are 0 or 1

    def field(self, points: ArrayLike, on_invalid: OnInvalid = "raise") -> Any:
        """Return (...) the implicit value at points (..., 3): ≤ 0 inside; no distance, and it jumps across step faces.

        G of Eq. 3 in a leaf's region, (|p∥ − c| − r)/r of the nearest lobe in a slab, signed distance over extent in a
        retained part's.
        """
        array, mark = as_points(points), marks(on_invalid)
        flat = array.reshape(-1, 3)
        out = np.empty(len(flat))
        blob = self._blob
        bad = sum(in_parts(len(flat), 10_000, lambda i, j: tree_kernels.field_many(blob, flat[i:j], out[i:j])))
        if bad and not mark:
            require_finite(array, "points")
        return scalar(out.reshape(array.shape[:-1]))

    def signed_distance(
        self, points: ArrayLike, on_invalid: OnInvalid = "raise", tolerance_mm: float = TOLERANCE_MM
    ) -> Any:
        """Return (...) mm to the surface at points (..., 3), < 0 inside, within the tolerance of the truth.

        NaN where a point is not finite, with on_invalid="mark"; +inf for an empty solid.
        """
        if is_point(points) and on_invalid == "raise":
            tolerance = as_float(tolerance_mm, "tolerance_mm", 1e-6, 1e3)
            x, y, z = points.tolist()
            distance: float = distance_one(self._blob, x, y, z, tolerance)
            if distance == distance:  # else it is NaN: the row is named below
                return distance
        return self._nearest(points, on_invalid, tolerance_mm)[1]

    def closest_point(
        self, points: ArrayLike, on_invalid: OnInvalid = "raise", tolerance_mm: float = TOLERANCE_MM
    ) -> tuple[FloatArray, Any]:
        """Return (..., 3) a surface point nearest to points (..., 3), to the tolerance, and (...) signed distance."""
        return self._nearest(points, on_invalid, tolerance_mm)

    def _nearest(self, points: ArrayLike, on_invalid: OnInvalid, tolerance_mm: float) -> tuple[FloatArray, Any]:
        array, mark = as_points(points), marks(on_invalid)
        tolerance = as_float(tolerance_mm, "tolerance_mm", 1e-6, 1e3)
        flat = array.reshape(-1, 3)
        distance, foot, bad = nearest_to_rows(self._blob, flat, tolerance)
        if bad and not mark:
            require_finite(array, "points")
        return foot.reshape(array.shape), scalar(distance.reshape(array.shape[:-1]))

    # -- what a segment meets -----------------------------------------------------------------------------------------

    def crossings(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        on_invalid: OnInvalid = "raise",
        resolution_mm: float = RESOLUTION_MM,
        tolerance_mm: float = CROSSING_TOLERANCE_MM,
    ) -> Crossings:
        """Return all crossings of segments (n, 3) → (n, 3) with the surface, in order; or of one segment (3,) → (3,).

        Nothing thicker than the resolution is missed; places are right to the tolerance. Between two outside points the
        number is even. A segment of no length has no crossings.
        """
        resolution = as_float(resolution_mm, "resolution_mm", 1e-6, 1e3)
        tolerance = as_float(tolerance_mm, "tolerance_mm", 1e-9, 1e3)
        if on_invalid == "raise" and is_point(starts) and is_point(ends):
            one = crossings_of_one(self._blob, starts, ends, resolution, tolerance)
            if one is not None:
                return one
        first, last, _ = broadcast_segments(starts, ends)
        found = crossings_of_rows(self._blob, first, last, resolution, tolerance)
        if not found.valid.all() and not marks(on_invalid):
            require_finite(first, "starts")
            require_finite(last, "ends")
        return found

    def first_crossing(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        on_invalid: OnInvalid = "raise",
        resolution_mm: float = RESOLUTION_MM,
        tolerance_mm: float = CROSSING_TOLERANCE_MM,
    ) -> Any:
        """Return (...) t in [0, 1] of the first crossing of segments (..., 3) → (..., 3), NaN where there is none.

        With on_invalid="mark": (t, valid), valid (...) False where a segment is not finite.
        """
        resolution = as_float(resolution_mm, "resolution_mm", 1e-6, 1e3)
        tolerance = as_float(tolerance_mm, "tolerance_mm", 1e-9, 1e3)
        if on_invalid == "raise" and is_point(starts) and is_point(ends):
            (ax, ay, az), (bx, by, bz) = starts.tolist(), ends.tolist()
            one = crossing_kernels.first_one(self._blob, ax, ay, az, bx, by, bz, resolution, tolerance)
            if one != -1.0:
                return one
        first, last, shape = broadcast_segments(starts, ends)
        mark = marks(on_invalid)
        out, bad = first_of_rows(self._blob, first, last, resolution, tolerance)
        if bad and not mark:
            require_finite(first, "starts")
            require_finite(last, "ends")
        valid = out != -1.0
        out[~valid] = np.nan
        if mark:
            return scalar(out.reshape(shape)), scalar(valid.reshape(shape))
        return scalar(out.reshape(shape))

    def clearance(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        radius: float = 0.0,
        on_invalid: OnInvalid = "raise",
        tolerance_mm: float = TOLERANCE_MM,
    ) -> Any:
        """Return (...) mm between capsules (segments (..., 3) → (..., 3)) and the solid, < 0 where they touch.

        min over the segment of signed_distance − radius: −(greatest depth) − radius where the axis enters. Never above
        the truth, at most the tolerance below it. NaN where not finite, with on_invalid="mark".
        """
        if is_point(starts) and is_point(ends) and on_invalid == "raise":
            thick = as_float(radius, "radius", 0.0)
            tolerance = as_float(tolerance_mm, "tolerance_mm", 1e-4, 1e3)
            (ax, ay, az), (bx, by, bz) = starts.tolist(), ends.tolist()
            value: float = clearance_one(self._blob, ax, ay, az, bx, by, bz, tolerance)
            if value == value:  # else it is NaN: the row is named below
                return value - thick
        return self.closest_approach(starts, ends, radius, on_invalid, tolerance_mm).clearance

    def closest_approach(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        radius: float = 0.0,
        on_invalid: OnInvalid = "raise",
        tolerance_mm: float = TOLERANCE_MM,
    ) -> Clearance:
        """Return `clearance` with the closest pair of points and where along the segment it lies."""
        first, last, shape = broadcast_segments(starts, ends)
        mark = marks(on_invalid)
        thick = as_float(radius, "radius", 0.0)
        tolerance = as_float(tolerance_mm, "tolerance_mm", 1e-4, 1e3)
        value, t, foot, bad = clearance_of_rows(self._blob, first, last, tolerance)
        if bad and not mark:
            require_finite(first, "starts")
            require_finite(last, "ends")
        axis = first + t[:, None] * (last - first)
        return Clearance(
            scalar((value - thick).reshape(shape)),
            scalar(t.reshape(shape)),
            axis.reshape(*shape, 3),
            foot.reshape(*shape, 3),
        )

    def profile(self, starts: ArrayLike, ends: ArrayLike, n: int = 65) -> Profile:
        """Return signed distance at `n` ≥ 2 even steps along segments (..., 3) → (..., 3), and the length inside."""
        first, last, shape = broadcast_segments(starts, ends)
        if n < 2:
            raise InputError(f"n: got {n}, expected at least 2 steps: both ends")
        t = np.linspace(0.0, 1.0, n)
        found = self.crossings(first, last)
        points = first[:, None] + t[:, None] * (last - first)[:, None]
        distance = np.asarray(self.signed_distance(points)).reshape(*shape, n)
        # Entering at t adds 1 − t to what lies inside, leaving takes 1 − t off again; an inside start adds 1.
        rest = np.where(found.entering, 1.0 - found.t, found.t - 1.0)
        row = np.repeat(np.arange(len(first)), np.diff(found.offsets))
        share = np.bincount(row, weights=rest, minlength=len(first)) + np.asarray(self.contains(first), dtype=float)
        length = np.sqrt(((last - first) ** 2).sum(axis=1))
        return Profile(t, distance, scalar((share * length).reshape(shape)))

    # -- a curved needle ----------------------------------------------------------------------------------------------

    def polyline_crossings(self, points: ArrayLike) -> Crossings:
        """Return the crossings of a curve (k, 3), k ≥ 2: offsets and t of its k − 1 segments, in order along it."""
        rows = curve(points)
        return self.crossings(rows[:-1], rows[1:])

    def polyline_clearance(self, points: ArrayLike, radius: float = 0.0) -> float:
        """Return mm between a curve (k, 3) of a radius and the solid, as `clearance`: the least of its segments."""
        rows = curve(points)
        return float(np.min(self.clearance(rows[:-1], rows[1:], radius)))


def load(path: str | Path) -> Shape:
    """Return the shape in a .hhsr file; raise FileFormatError where it is none, or damaged."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror}), expected a .hhsr file") from error
    return Shape(*io.decode(content))
