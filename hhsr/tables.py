"""Points and segments from CSV or .npy files, and answers into them."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from hhsr.errors import InputError
from hhsr.model import FloatArray

COLUMNS = {3: ("x", "y", "z"), 6: ("x0", "y0", "z0", "x1", "y1", "z1")}


def read_rows(path: Path, width: int) -> FloatArray:
    """Return (n, width) numbers from a CSV with a header of the columns' names, or from a .npy of that shape.

    width : 3, points x, y, z; or 6, segments x0, y0, z0, x1, y1, z1; mm. Other columns of a CSV are ignored.

    Raises
    ------
    InputError : no such file, another shape or header, a field that is no number (with its line).
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    return _read_npy(path, width) if path.suffix.lower() == ".npy" else _read_csv(path, width)


def _read_npy(path: Path, width: int) -> FloatArray:
    try:
        rows = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise InputError(f"{path.name}: not a readable .npy file of numbers ({error})") from error
    if rows.ndim != 2 or rows.shape[1] != width or not np.issubdtype(rows.dtype, np.number) or np.iscomplexobj(rows):
        raise InputError(f"{path.name}: got shape {rows.shape} of {rows.dtype}, expected (n, {width}) numbers")
    return np.asarray(rows, dtype=np.float64)


def _read_csv(path: Path, width: int) -> FloatArray:
    names = COLUMNS[width]
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file)
            header = [name.strip().lower() for name in next(lines, [])]
            if not set(names) <= set(header):
                raise InputError(f"{path.name}: the header is {','.join(header)!r}, expected {','.join(names)}")
            places = [header.index(name) for name in names]
            rows = [[float(line[place]) for place in places] for line in lines if line]
    except (ValueError, IndexError, UnicodeDecodeError, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path.name}, line {lines.line_num}: expected {width} numbers ({error})") from error
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def write_columns(path: Path, columns: Mapping[str, ArrayLike]) -> None:
    """Write columns of equal length: a CSV with a header, or a .npy of shape (n,) or (n, columns).

    Yes and no are 1 and 0; floats are written so that they are read back the same.
    """
    arrays = [np.asarray(values) for values in columns.values()]
    if path.suffix.lower() == ".npy":
        np.save(
            path, arrays[0] if len(arrays) == 1 else np.stack([array.astype(np.float64) for array in arrays], axis=1)
        )
        return
    plain = [array.astype(np.int64) if array.dtype == bool else array for array in arrays]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows(chain([list(columns)], zip(*(array.tolist() for array in plain), strict=True)))
