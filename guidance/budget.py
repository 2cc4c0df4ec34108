"""The error budget: what may be wrong between the picture and the patient, in mm, added to every margin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from guidance.errors import SceneError
from guidance.needle import Array

if TYPE_CHECKING:
    from hhsr import Shape

FIT_STATISTICS = ("mean", "p95", "max")


@dataclass(frozen=True)
class ErrorBudget:
    """Errors that do not depend on the path, and which statistic of the fit error is added to them.

    The parts are *summed*, not added in quadrature: they are not independent (registration and bending
    both push the same way when tissue moves), and a margin should hold, not hold on average.

    Parameters
    ----------
    registration_mm, tracker_mm, bending_mm : float
        Of the registration at the target, of the tracked tip, of the needle's bending.
    fit : {"max", "p95", "mean"}
        Statistic of the shape's own two-sided fit error, in the leaf nearest to the path.
    """

    registration_mm: float = 1.0
    tracker_mm: float = 0.3
    bending_mm: float = 0.5
    fit: str = "max"

    def __post_init__(self) -> None:
        for name in ("registration_mm", "tracker_mm", "bending_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0.0 <= value <= 50.0):
                raise SceneError(f"errors.{name} is {value!r}; expected millimetres from 0 to 50")
        if self.fit not in FIT_STATISTICS:
            raise SceneError(f"errors.fit is {self.fit!r}; choose one of {', '.join(FIT_STATISTICS)}")

    @property
    def without_fit_mm(self) -> float:
        """Registration + tracker + bending, mm."""
        return self.registration_mm + self.tracker_mm + self.bending_mm

    def to_record(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return {
            "registration_mm": self.registration_mm,
            "tracker_mm": self.tracker_mm,
            "bending_mm": self.bending_mm,
            "fit_statistic": self.fit,
        }


def fit_errors_mm(shape: Shape, points: Array, statistic: str) -> Array:
    """The fit error (n,), mm, of the leaf in whose region each of the surface points (n, 3) lies.

    A far spike of the fit therefore does not widen the margin everywhere.

    Raises
    ------
    SceneError
        If the shape does not say how well it fits.
    """
    errors = _errors_by_leaf(shape, statistic)
    if len(errors) == 1:
        return np.full(len(points), errors[0])
    return np.asarray(np.array(errors)[_leaf_at(shape, points)])


def fit_error_range_mm(shape: Shape, statistic: str) -> tuple[float, float]:
    """The least and the largest (mm) that `fit_errors_mm` can give: what a quick bound may assume."""
    errors = _errors_by_leaf(shape, statistic)
    return min(errors), max(errors)


def _errors_by_leaf(shape: Shape, statistic: str) -> list[float]:
    """Per leaf, left to right; one entry where the shape states only the error of the whole."""
    column = FIT_STATISTICS.index(statistic)
    if shape.leaf_errors:
        return [figures[column] for figures in shape.leaf_errors]
    if shape.fit_error is None:
        raise SceneError("a shape does not say how well it fits its source: fit it with hhsr, which measures that")
    return [shape.fit_error[column]]


def _leaf_at(shape: Shape, points: Array) -> NDArray[np.intp]:
    """The leaf, counted left to right, in whose region each point (n, 3) lies: descend by the sides of the planes."""
    from hhsr.model import Cut, Node, leaves, rotation_matrix

    pose = shape.tree.pose
    local = (points - pose[3:]) @ rotation_matrix(pose[:3])
    found = np.zeros(len(points), dtype=np.intp)

    def descend(node: Node, which: NDArray[np.intp], first: int) -> None:
        if not isinstance(node, Cut):
            found[which] = first
            return
        right = local[which] @ node.normal - node.offset >= 0.0
        descend(node.left, which[~right], first)
        descend(node.right, which[right], first + sum(1 for _ in leaves(node.left)))

    descend(shape.tree.root, np.arange(len(points)), 0)
    return found
