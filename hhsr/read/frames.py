"""Orientation codes: which way a file's axes point in the patient, and the way from there to LPS."""

from __future__ import annotations

import numpy as np

from hhsr.errors import InputError
from hhsr.model import FloatArray, IntArray

# Row of LPS that a letter moves along, and its sign: +x is to the patient's Left, +y Posterior, +z Superior.
_LETTERS = {"L": (0, 1), "R": (0, -1), "P": (1, 1), "A": (1, -1), "S": (2, 1), "I": (2, -1)}


def matrix_to_lps(frame: str) -> FloatArray:
    """Return the (3, 3) signed permutation that carries a file's coordinates to LPS.

    frame : three letters, one of each pair L/R, P/A, S/I: where the file's +x, +y and +z point; 48 codes. "LSA": +x to
        the left, +y up, +z to the front, so LPS = (x, −z, y).
    """
    code = str(frame).upper()
    axes = [_LETTERS.get(letter, (-1, 0))[0] for letter in code]
    if sorted(axes) != [0, 1, 2]:
        raise InputError(
            f"frame: got {frame!r}, expected three letters, one of each pair L/R, P/A and S/I: where the file's +x, "
            "+y and +z point, such as LPS, RAS or LSA"
        )
    matrix = np.zeros((3, 3))
    for column, letter in enumerate(code):
        row, sign = _LETTERS[letter]
        matrix[row, column] = sign
    return matrix


def to_lps(vertices: FloatArray, faces: IntArray, frame: str) -> tuple[FloatArray, IntArray]:
    """Return the vertices in LPS, and the faces turned where the frame is a mirror image of it."""
    matrix = matrix_to_lps(frame)
    turned = faces if np.linalg.det(matrix) > 0 else np.ascontiguousarray(faces[:, ::-1])
    return vertices @ matrix.T + 0.0, turned  # + 0.0: no −0.0
