"""The four kinds of surface that a shape's boundary is made of, each with its exact miss in mm (DESIGN §2)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from hhsr.evaluate import LeafArrays, contour_radius, leaf_arrays
from hhsr.kernels.leaf import leaf_radii
from hhsr.model import Cut, FloatArray, ModelLeaf, rotation_matrix

THINNEST = 1e-3  # mm


@dataclass(frozen=True, eq=False)
class Patch:
    """The surface of a model leaf. leaf: its number in the order of `hhsr.model.leaves`."""

    leaf: int
    model: ModelLeaf = field(repr=False)

    @cached_property
    def _arrays(self) -> LeafArrays:
        return leaf_arrays(self.model)

    @cached_property
    def _rotation(self) -> FloatArray:
        return rotation_matrix(self.model.rotation)

    def miss(self, points: FloatArray) -> FloatArray:
        """Return |q| − ρ (n,) mm, the radial miss of (n, 3) points of the tree's frame."""
        q = np.ascontiguousarray((points - self.model.centre) @ self._rotation)
        return np.asarray(np.linalg.norm(q, axis=1) - leaf_radii(q, *self._arrays))


@dataclass(frozen=True, eq=False)
class Retained:
    """Triangles of a retained part. leaf: its number in the order of `hhsr.model.leaves`."""

    leaf: int


@dataclass(frozen=True, eq=False)
class Step:
    """A step face: part of the plane h = side · d of a cut. cut: its number in the order of `hhsr.model.cuts`."""

    cut: int
    side: int
    model: Cut = field(repr=False)

    def miss(self, points: FloatArray) -> FloatArray:
        """Return h − side · d (n,) mm of (n, 3) points of the tree's frame."""
        return np.asarray(points @ self.model.normal - self.model.offset - self.side * self.model.half_width)


@dataclass(frozen=True, eq=False)
class Strip:
    """A band's surface about one lobe. left, right: (256,) mm, the lobe's radii at h = −d and +d."""

    cut: int
    lobe: int
    model: Cut = field(repr=False)
    left: FloatArray = field(repr=False)
    right: FloatArray = field(repr=False)

    def radius(self, angle: FloatArray, share: FloatArray) -> FloatArray:
        """Return r(α, t) (n,) mm for (n,) angles and shares t of the way from −d to +d.

        Where the formula gives less than THINNEST the band holds nothing, and its surface is a thread about the centre.
        """
        left, right = _at(self.left, angle), _at(self.right, angle)
        middle = 2.0 * contour_radius(self.model.contours[self.lobe], angle) - 0.5 * (left + right)
        rest = 1.0 - share
        return np.asarray(
            np.maximum(rest * rest * left + 2.0 * share * rest * middle + share * share * right, THINNEST)
        )

    def miss(self, points: FloatArray) -> FloatArray:
        """Return |p∥ − c| − r (n,) mm of (n, 3) points of the tree's frame."""
        local = points @ self.model.frame.T
        x, y = (local[:, :2] - self.model.contours[self.lobe].centre).T
        share = 0.5 * ((local[:, 2] - self.model.offset) / self.model.half_width + 1.0)
        return np.asarray(np.hypot(x, y) - self.radius(np.arctan2(y, x), np.clip(share, 0.0, 1.0)))


Source = Patch | Retained | Step | Strip


def _at(table: FloatArray, angle: FloatArray) -> FloatArray:
    """Return a periodic, piecewise linear table at angles; its entry i stands at −π + 2π·i/n."""
    n = len(table)
    position = (angle / (2.0 * np.pi) + 0.5) * n
    low = np.floor(position)
    share = position - low
    i = low.astype(np.int64) % n
    return np.asarray((1.0 - share) * table[i] + share * table[(i + 1) % n])
