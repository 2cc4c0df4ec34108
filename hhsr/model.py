"""The frozen records that an HHSR tree is made of (PAPER §2; DESIGN §1 and §2). Lengths in mm, angles in rad.

Everything here is a number that is stored, and nothing else: what queries need is derived in `hhsr.compiled`.
`parameters` counts by one rule: every stored number, a set of k centres out of M as ⌈log₂ C(M, k) / 32⌉ numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

EXPONENT_LOW = 0.1
EXPONENT_HIGH = 1.9
MAX_SCALE = 0.95
MAX_DEPTH = 12


def frozen(values: ArrayLike, dtype: type = np.float64) -> NDArray[Any]:
    """Return a read-only, C-contiguous copy of `values`."""
    array: NDArray[Any] = np.array(values, dtype=dtype, order="C", copy=True)
    array.setflags(write=False)
    return array


def _empty() -> FloatArray:
    return frozen([])


def exponent_of_logit(logit: ArrayLike) -> FloatArray:
    """Return the exponent in (0.1, 1.9) that a knot's logit value stands for; 1 at 0."""
    return EXPONENT_LOW + (EXPONENT_HIGH - EXPONENT_LOW) / (1.0 + np.exp(-np.asarray(logit, dtype=np.float64)))


def logit_of_exponent(exponent: ArrayLike) -> FloatArray:
    """Return the logit value of an exponent in (0.1, 1.9)."""
    share = (np.asarray(exponent, dtype=np.float64) - EXPONENT_LOW) / (EXPONENT_HIGH - EXPONENT_LOW)
    return np.log(share / (1.0 - share))


@dataclass(frozen=True, eq=False)
class Superquadric:
    """Extended superquadric about the origin of its leaf's frame.

    half_axes: (6,) mm, a₊ a₋ b₊ b₋ c₊ c₋, all > 0.
    azimuth_logits: (n,) logits of ε2 at θ = −π + 2π·i/n, periodic cubic spline; empty: ε2 ≡ 1; one: constant; or n ≥ 3.
    elevation_logits: (m,) logits of ε1 at φ = −π/2 + π·i/(m−1), cubic spline, flat at the poles; empty, one: as above;
    or m ≥ 2.
    """

    half_axes: FloatArray
    azimuth_logits: FloatArray = field(default_factory=_empty)
    elevation_logits: FloatArray = field(default_factory=_empty)

    @property
    def parameters(self) -> int:
        return self.half_axes.size + self.azimuth_logits.size + self.elevation_logits.size


@dataclass(frozen=True)
class CentreGrid:
    """Where scale-field centres may lie: several Fibonacci grids on the unit sphere, coarse to fine, as one list.

    sizes: centres per level. support: support angle of a level in units of its grid spacing √(4π / size).
    """

    sizes: tuple[int, ...]
    support: float

    @property
    def size(self) -> int:
        return sum(self.sizes)

    @cached_property
    def centres(self) -> FloatArray:
        """(size, 3) unit vectors."""
        return frozen(np.concatenate([fibonacci_sphere(n) for n in self.sizes]))

    @cached_property
    def extents(self) -> FloatArray:
        """(size,) 1 − cos σ of each centre's support angle σ (at most π)."""
        angles = [min(self.support * math.sqrt(4.0 * math.pi / n), math.pi) for n in self.sizes]
        return frozen(np.repeat([1.0 - math.cos(a) for a in angles], self.sizes))


def fibonacci_sphere(count: int) -> FloatArray:
    """Return (count, 3) unit vectors spread evenly over the sphere (golden-angle spiral)."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    turn = math.pi * (3.0 - math.sqrt(5.0)) * index
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


@dataclass(frozen=True, eq=False)
class ScaleField:
    """s(u) = Σ_j w_j λ(1 − u·c_j), the share by which the superquadric's radius shrinks in direction u (DESIGN §1).

    grid: the dictionary of centres. index: (k,) ascending indices into it. weights: (k,).
    """

    grid: CentreGrid
    index: IntArray
    weights: FloatArray

    @property
    def parameters(self) -> int:
        return self.weights.size + subset_numbers(self.grid.size, self.weights.size)

    @staticmethod
    def none() -> ScaleField:
        """Return the field that is 0 everywhere."""
        return ScaleField(CentreGrid((), 2.5), frozen([], np.int64), frozen([]))


def subset_numbers(total: int, chosen: int) -> int:
    """Return how many 32-bit numbers tell which `chosen` of `total` centres are used: ⌈log₂ C(total, chosen) / 32⌉."""
    combinations = math.comb(total, chosen)
    return -(-(combinations - 1).bit_length() // 32)


@dataclass(frozen=True, eq=False)
class ModelLeaf:
    """A part as a radius over directions: superquadric times (1 − scale field), in its own frame.

    centre: (3,) mm, the frame's origin in the tree's frame.
    rotation: (3,) rotation vector R of the frame, p = centre + R q; or (0,): the tree's axes.
    """

    centre: FloatArray
    rotation: FloatArray
    superquadric: Superquadric
    scale_field: ScaleField

    @property
    def parameters(self) -> int:
        return 3 + self.rotation.size + self.superquadric.parameters + self.scale_field.parameters


@dataclass(frozen=True, eq=False)
class RetainedPart:
    """A part kept as closed triangles, running 1 mm past each cut of its region and capped outside the region.

    vertices: (n, 3) mm in the tree's frame; faces: (m, 3), outward. No faces: an empty part.
    """

    vertices: FloatArray
    faces: IntArray

    @property
    def parameters(self) -> int:
        return self.vertices.size + self.faces.size


@dataclass(frozen=True, eq=False)
class Contour:
    """One lobe of a cut's 2-D intersection shape: r(α) = (1 − Σ w_j λ(1 − cos(α − α_j))) · q(α) (DESIGN §2).

    centre: (2,) mm in the plane's axes (see `plane_frame`). half_axes: (4,) mm, a₊ a₋ b₊ b₋.
    logits: (n,) logits of the exponent at α = −π + 2π·i/n, periodic cubic; empty: 1; one: constant; else n ≥ 3.
    weights: (k,) of k centres at α_j = −π + 2π·j/k, support 2.5 spacings (at most π).
    """

    centre: FloatArray
    half_axes: FloatArray
    logits: FloatArray = field(default_factory=_empty)
    weights: FloatArray = field(default_factory=_empty)

    @property
    def parameters(self) -> int:
        return 2 + self.half_axes.size + self.logits.size + self.weights.size


@dataclass(frozen=True, eq=False)
class Cut:
    """An inner node: a plane, the band's half width d, the lobes of its 2-D intersection shape, two children.

    normal_angles: (2,) azimuth and elevation (rad) of the unit normal, which points to `right`.
    offset: mm; the signed height of p is n·p − offset. half_width: d ≥ 0 mm; d = 0 has no contour.
    """

    normal_angles: FloatArray
    offset: float
    half_width: float
    contours: tuple[Contour, ...]
    left: Node
    right: Node

    @property
    def own_parameters(self) -> int:
        band = 1 + sum(c.parameters for c in self.contours) if self.half_width > 0 else 0
        return 3 + band

    @property
    def parameters(self) -> int:
        return self.own_parameters + self.left.parameters + self.right.parameters

    @cached_property
    def normal(self) -> FloatArray:
        """(3,) unit normal, pointing to the right child."""
        azimuth, elevation = self.normal_angles
        return frozen(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )

    @cached_property
    def frame(self) -> FloatArray:
        """(3, 3) rows e1, e2, n of the plane's axes."""
        return frozen(plane_frame(self.normal))


Node = Cut | ModelLeaf | RetainedPart


def plane_frame(normal: ArrayLike) -> FloatArray:
    """Return (3, 3) rows e1, e2, n: a right-handed frame that depends on the normal alone (Duff et al. 2017)."""
    x, y, z = (float(v) for v in np.asarray(normal, dtype=np.float64))
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y], [x, y, z]])


def normal_angles_of(normal: ArrayLike) -> FloatArray:
    """Return (2,) azimuth and elevation of a vector's direction."""
    x, y, z = (float(v) for v in np.asarray(normal, dtype=np.float64))
    return np.array([math.atan2(y, x), math.atan2(z, math.hypot(x, y))])


def leaves(node: Node) -> Iterator[ModelLeaf | RetainedPart]:
    """Yield the leaves, left to right: the order in which per-leaf figures are given."""
    if isinstance(node, Cut):
        yield from leaves(node.left)
        yield from leaves(node.right)
    else:
        yield node


def cuts(node: Node) -> Iterator[Cut]:
    """Yield the inner nodes, parents first, left before right."""
    if isinstance(node, Cut):
        yield node
        yield from cuts(node.left)
        yield from cuts(node.right)


def depth(node: Node) -> int:
    """Return the number of cuts on the longest way down."""
    return 1 + max(depth(node.left), depth(node.right)) if isinstance(node, Cut) else 0


@dataclass(frozen=True, eq=False)
class Tree:
    """A whole shape: the root node, and the rigid pose of the tree's frame in the patient's (LPS, mm).

    pose: (6,) rotation vector (rad) then translation (mm): p_lps = R p_tree + t. Counted as six numbers.
    """

    root: Node
    pose: FloatArray

    @property
    def parameters(self) -> int:
        return self.pose.size + self.root.parameters


def rotation_matrix(vector: ArrayLike) -> FloatArray:
    """Return the (3, 3) matrix of a rotation vector (Rodrigues); the unit matrix for an empty vector."""
    v = np.asarray(vector, dtype=np.float64)
    angle = float(np.sqrt((v * v).sum()))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = v / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: FloatArray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return matrix


class ErrorFigures(NamedTuple):
    """Two-sided true distance between a fit and its source, mm: mean, 95th percentile, sampled maximum."""

    mean_mm: float
    p95_mm: float
    max_mm: float


@dataclass(frozen=True, eq=False)
class Provenance:
    """Where a shape comes from and how well it fits; the file's header, not counted as parameters.

    source_hash: SHA-256 of the source's bytes or arrays, hex. frame: of the source as read ("LPS" where nothing was
    flipped). label: of a label map. options: of the fit, JSON values. fit_error, leaf_errors: measured on what is
    stored; leaf order as `leaves`. report: further figures of the fit, JSON values (seconds excepted: no timestamps).
    """

    source_hash: str = ""
    frame: str = "LPS"
    label: int | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    software: str = ""
    fit_error: ErrorFigures | None = None
    leaf_errors: tuple[ErrorFigures, ...] = ()
    report: Mapping[str, Any] = field(default_factory=dict)
