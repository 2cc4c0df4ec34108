"""What queries return, and how what they are asked is brought into rows."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hhsr.check import as_points
from hhsr.errors import InputError
from hhsr.kernels.crossing import cross_one
from hhsr.model import FloatArray, IntArray

OnInvalid = Literal["raise", "mark"]
ROOM = 16  # crossings of a single segment


class Crossings(NamedTuple):
    """Where segments cross a shape's surface; segment i has rows offsets[i] … offsets[i + 1], in order.

    offsets: (n + 1,). t: (m,) share of the segment, in [0, 1]. points: (m, 3) LPS mm. entering: (m,) bool.
    valid: (n,) bool, False where a segment was not finite (asked with on_invalid="mark").
    Of a segment asked alone offsets, entering and valid are read-only.
    """

    offsets: IntArray
    t: FloatArray
    points: FloatArray
    entering: NDArray[np.bool_]
    valid: NDArray[np.bool_]


class Clearance(NamedTuple):
    """Clearance of capsules, with the closest pair.

    clearance: (...) mm. t: (...) share of the segment where the axis is nearest (deepest, where it enters).
    on_axis, on_surface: (..., 3) the pair of points, LPS mm.
    """

    clearance: FloatArray
    t: FloatArray
    on_axis: FloatArray
    on_surface: FloatArray


class Profile(NamedTuple):
    """What lies along segments. t: (n,) shares. distance: (..., n) signed, mm. inside_mm: (...) length inside."""

    t: FloatArray
    distance: FloatArray
    inside_mm: Any


def is_point(value: object) -> TypeGuard[FloatArray]:
    """Return whether a value is a float64 array (3,): what single calls take without a copy."""
    return type(value) is _ARRAY and value.shape == (3,) and value.dtype == _FLOAT


def _fixed(values: list[Any], dtype: type) -> NDArray[Any]:
    array: NDArray[Any] = np.array(values, dtype)
    array.setflags(write=False)
    return array


_ARRAY, _FLOAT = np.ndarray, np.dtype(np.float64)
_VALID = _fixed([True], np.bool_)
# Offsets and entering by what `cross_one` returns: entering and leaving alternate.
_OFFSETS = [_fixed([0, code // 2], np.int64) for code in range(2 * ROOM + 2)]
_ENTERING = [_fixed([(k + code) % 2 == 0 for k in range(code // 2)], np.bool_) for code in range(2 * ROOM + 2)]


def crossings_of_one(
    blob: FloatArray, start: FloatArray, end: FloatArray, resolution: float, tolerance: float
) -> Crossings | None:
    """Return the crossings of one segment (3,) → (3,); None where it is not finite, or has more than there is room for.

    A single call's time goes mostly into what it returns: all but t and points was made before, and is read-only.
    """
    t, points = np.empty(ROOM), np.empty((ROOM, 3))
    (ax, ay, az), (bx, by, bz) = start.tolist(), end.tolist()
    code = cross_one(blob, ax, ay, az, bx, by, bz, resolution, tolerance, t, points)
    if code < 0:
        return None
    count = code // 2
    return tuple.__new__(Crossings, (_OFFSETS[code], t[:count], points[:count], _ENTERING[code], _VALID))


def curve(points: ArrayLike) -> FloatArray:
    """Return the points of a curve (k, 3), k ≥ 2."""
    rows = as_points(points)
    if rows.ndim != 2 or len(rows) < 2:
        raise InputError(f"points: got shape {rows.shape}, expected (k, 3) with k ≥ 2 points along a curve")
    return rows


def marks(on_invalid: str) -> bool:
    """Return whether rows that are not finite are to be marked instead of refused."""
    if on_invalid not in ("raise", "mark"):
        raise InputError(f'on_invalid: got {on_invalid!r}, expected "raise" or "mark"')
    return on_invalid == "mark"


def scalar(array: NDArray[Any]) -> Any:
    """Return a Python scalar for a 0-d array: one point in, one answer out."""
    return array.item() if array.ndim == 0 else array


def broadcast_segments(starts: ArrayLike, ends: ArrayLike) -> tuple[FloatArray, FloatArray, tuple[int, ...]]:
    """Return starts and ends as (n, 3), and the shape (...) of the answer; one start may serve many ends."""
    first, last = as_points(starts, "starts"), as_points(ends, "ends")
    if first.shape != last.shape:
        try:
            first, last = np.broadcast_arrays(first, last)
        except ValueError as error:
            raise InputError(
                f"starts and ends: got shapes {first.shape} and {last.shape}, expected one end for each start"
            ) from error
        first, last = np.ascontiguousarray(first), np.ascontiguousarray(last)
    return first.reshape(-1, 3), last.reshape(-1, 3), first.shape[:-1]
