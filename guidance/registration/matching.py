"""Which landmark is which, when their order is unknown."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from guidance.errors import InputError
from guidance.registration.points import RegistrationError, checked_points, kabsch, refuse_lines, residuals_mm, rms
from guidance.rigid import transform_points

__all__ = ["match_landmarks"]


def match_landmarks(source: ArrayLike, target: ArrayLike, ambiguity: float = 2.0) -> NDArray[np.intp]:
    """Find which target belongs to which source landmark, when their order is unknown.

    The three source points of the largest triangle are tried on every ordered triple of targets; the rest is assigned
    by distance. Works for up to some thirty landmarks.

    Parameters
    ----------
    source, target : (n, 3) array_like
        The same landmarks in two frames and two orders, mm; n ≥ 4.
    ambiguity : float
        The next best order must be worse by this factor in rms error, else the match is refused.

    Returns
    -------
    (n,) ndarray of int
        ``target[order[k]]`` is the partner of ``source[k]``.

    Raises
    ------
    RegistrationError
        Where the arrangement is too symmetric to tell.
    """
    source, target = checked_points(source, "source", 4), checked_points(target, "target", 4)
    if source.shape != target.shape:
        raise InputError(f"source and target: expected equal numbers, got {len(source)} and {len(target)} points")
    refuse_lines(source, "source")
    first = np.array(np.unravel_index(np.argmax(cdist(source, source)), (len(source), len(source))))
    edge = source[first[1]] - source[first[0]]
    width = np.linalg.norm(np.cross(source - source[first[0]], edge), axis=1)
    triple = np.append(first, np.argmax(width))
    wanted, given = cdist(source[triple], source[triple]), cdist(target, target)
    found: dict[tuple[int, ...], float] = {}
    for candidate in permutations(range(len(target)), 3):
        chosen = np.array(candidate)
        # a triangle that differs by a fifth is no candidate: landmarks are placed to a few per cent of their distances
        if np.abs(given[np.ix_(chosen, chosen)] - wanted).max() > 0.2 * wanted.max():
            continue
        T = kabsch(source[triple], target[chosen])
        _, order = linear_sum_assignment(cdist(transform_points(T, source), target) ** 2)
        key = tuple(int(k) for k in order)
        if key not in found:
            found[key] = rms(residuals_mm(kabsch(source, target[order]), source, target[order]))
    if not found:
        raise RegistrationError("the two sets have no triangle in common; are both in mm, and of the same body?")
    ranked = sorted(found, key=found.__getitem__)
    if len(ranked) > 1 and found[ranked[1]] < max(ambiguity * found[ranked[0]], 1e-6):
        raise RegistrationError(
            f"ambiguous: two orders fit to {found[ranked[0]]:.2f} and {found[ranked[1]]:.2f} mm; give the order"
        )
    return np.array(ranked[0], dtype=np.intp)
