"""Scene files: TOML in, the checked parts of a scene out. Every error names the key, what was got, and what to do."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from guidance.budget import ErrorBudget
from guidance.errors import GuidanceError, SceneError
from guidance.fitted_shapes import ShapeSource, fitted_shapes
from guidance.needle import Array, Needle
from guidance.scene_parts import AVOID, Entry, Structure, Target

if TYPE_CHECKING:
    from hhsr import Shape

Table = Mapping[str, Any]

_USUAL_PARAMETERS = 600  # of a fit where the scene does not say: an organ to about half a millimetre

_KEYS = {
    "": {"name", "needle", "errors", "target", "entry", "structure"},
    "needle": {"length_mm", "radius_mm"},
    "errors": {"registration_mm", "tracker_mm", "bending_mm", "fit"},
    "target": {"structure", "point", "tolerance_mm"},
    "entry": {"structure", "points", "template", "count", "near", "within_mm", "max_angle_deg"},
    "entry.template": {"centre", "below_target_mm", "direction", "across", "rows", "columns", "spacing_mm"},
    "structure": {
        *("name", "mesh", "labels", "label", "shape", "frame", "unit", "force"),
        *("role", "margin_mm", "max_parameters", "retain"),
    },
}


class SceneParts(NamedTuple):
    """What `Scene` is made of, in the order in which it takes them."""

    name: str
    structures: tuple[Structure, ...]
    target: Target
    entry: Entry
    needle: Needle
    errors: ErrorBudget


def read_scene_file(path: Path, shapes: Path | None, progress: Callable[[str, Any], None] | None) -> SceneParts:
    """Read, check, fit; see `Scene.load`."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SceneError(f"there is no scene file {path}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"cannot read the scene file {path}: {error}") from None
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path} is not valid TOML: {error}") from None
    try:
        return _parts(document, path, shapes, progress)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
    except GuidanceError as error:
        raise SceneError(f"{path}: {error}") from error


def _parts(document: Table, path: Path, shapes: Path | None, progress: Callable[[str, Any], None] | None) -> SceneParts:
    _check_keys(document, "")
    for key in ("needle", "target", "entry", "structure"):
        if key not in document:
            raise SceneError(f"[{key}] is missing; see docs/scene.md for what a scene file holds")
    tables = document["structure"]
    if not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
        raise SceneError("write each structure as [[structure]] (with double brackets)")
    needle = Needle(**_numbers(_table(document, "needle"), "needle"))
    errors = _errors(_table(document, "errors"))
    for t in tables:
        _check_keys(t, "structure")
    names = [str(_text(t, "name", "structure", required=True)) for t in tables]
    if len(set(names)) < len(names):
        raise SceneError(f"two structures share a name; there are {', '.join(names)}")
    target_table, entry_table = _table(document, "target"), _table(document, "entry")
    for what, table in (("target", target_table), ("entry", entry_table)):
        wanted = _text(table, "structure", what)
        if wanted is not None and wanted not in names:
            raise SceneError(f"[{what}] structure = {wanted!r}, but there are only {', '.join(names)}")

    sources = [_source(t, path.parent) for t in tables]
    folder = path.with_suffix(".shapes") if shapes is None else shapes
    fitted = fitted_shapes(sources, folder, progress)
    structures = tuple(_structure(t, s, fitted[s.name]) for t, s in zip(tables, sources, strict=True))
    target = _target(target_table, structures)
    entry = _entry(entry_table, target)
    return SceneParts(document.get("name", path.stem), structures, target, entry, needle, errors)


def _source(table: Table, folder: Path) -> ShapeSource:
    name = str(table["name"])
    where = f"structure {name!r}"
    given = [k for k in ("mesh", "labels", "shape") if k in table]
    if len(given) != 1:
        raise SceneError(f"{where}: give exactly one of mesh, labels, shape (a file); got {given or 'none'}")
    file = (folder / str(_text(table, given[0], where))).resolve()
    if not file.is_file():
        raise SceneError(f"{where}: there is no file {file} (paths are relative to the scene file)")
    label, parameters = table.get("label"), table.get("max_parameters")
    for key, value in (("label", label), ("max_parameters", parameters)):
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise SceneError(f"{where}: {key} is {value!r}; expected a whole number above 0")
    for key in ("retain", "force"):
        if not isinstance(table.get(key, False), bool):
            raise SceneError(f"{where}: {key} is {table[key]!r}; expected true or false")
    return ShapeSource(
        name=name,
        file=file,
        ready=given[0] == "shape",
        frame=_text(table, "frame", where),
        unit=_text(table, "unit", where),
        label=label,
        max_parameters=parameters if parameters is not None or table.get("retain") else _USUAL_PARAMETERS,
        retain=bool(table.get("retain", False)),
        force=bool(table.get("force", False)),
    )


def _structure(table: Table, source: ShapeSource, shape: Shape) -> Structure:
    where = f"structure {source.name!r}"
    margin = _number(table, "margin_mm", where, 0.0)
    return Structure(source.name, shape, _text(table, "role", where) or AVOID, margin, str(table.get(source.key)))


def _target(table: Table, structures: tuple[Structure, ...]) -> Target:
    _check_keys(table, "target")
    name, tolerance = _text(table, "structure", "target"), _number(table, "tolerance_mm", "target", 2.0)
    if "point" in table:
        return Target(_vector(table, "point", "target"), tolerance, name)
    if name is None:
        raise SceneError("[target] needs `structure` (its centre of mass is the target) or `point = [x, y, z]`")
    shape = next(s.shape for s in structures if s.name == name)
    assert shape is not None  # fitted_shapes gives one for every source or raises
    return Target(np.asarray(shape.mesh(0.1).center_mass, dtype=np.float64), tolerance, name)


def _entry(table: Table, target: Target) -> Entry:
    _check_keys(table, "entry")
    points: Array = np.zeros((0, 3))
    if "points" in table:
        try:
            points = np.asarray(table["points"], dtype=np.float64)
        except (TypeError, ValueError):
            points = np.zeros(0)
        if points.ndim != 2 or points.shape[1] != 3:
            raise SceneError("[entry] points must be a list of [x, y, z]")
    if "template" in table:
        points = np.concatenate([points, _template(_table(table, "template", "entry.template"), target)])
    count = table.get("count", 1500)
    if not isinstance(count, int) or isinstance(count, bool):
        raise SceneError(f"[entry] count is {count!r}; expected a whole number")
    return Entry(
        points=points,
        structure=_text(table, "structure", "entry"),
        count=count,
        near=_vector(table, "near", "entry") if "near" in table else None,
        within_mm=_number(table, "within_mm", "entry", np.inf),
        max_angle_deg=_number(table, "max_angle_deg", "entry", 80.0),
    )


def _template(table: Table, target: Target) -> Array:
    """The holes (n, 3) of a template: a grid in the plane across `direction`, about `centre` or below the target."""
    where = "entry.template"
    _check_keys(table, where)
    direction = _vector(table, "direction", where) if "direction" in table else np.array([0.0, 0.0, 1.0])
    across = _vector(table, "across", where) if "across" in table else np.array([1.0, 0.0, 0.0])
    for name, vector in (("direction", direction), ("across", across)):
        if np.linalg.norm(vector) < 1e-9:
            raise SceneError(f"[{where}] {name} has no length")
    direction = direction / np.linalg.norm(direction)
    across = across - (across @ direction) * direction
    if np.linalg.norm(across) < 1e-6:
        raise SceneError(f"[{where}] across must not be parallel to direction")
    across = across / np.linalg.norm(across)
    if ("centre" in table) == ("below_target_mm" in table):
        raise SceneError(f"[{where}] give either `centre = [x, y, z]` or `below_target_mm`")
    if "centre" in table:
        centre = _vector(table, "centre", where)
    else:
        centre = target.point - _number(table, "below_target_mm", where, 0.0) * direction
    rows, columns = table.get("rows", 13), table.get("columns", 13)
    for key, value in (("rows", rows), ("columns", columns)):
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= 200:
            raise SceneError(f"[{where}] {key} is {value!r}; expected a whole number from 1 to 200")
    spacing = _number(table, "spacing_mm", where, 5.0)
    i = (np.arange(columns) - (columns - 1) / 2) * spacing
    j = (np.arange(rows) - (rows - 1) / 2) * spacing
    grid = i[:, None, None] * across + j[None, :, None] * np.cross(direction, across)
    return np.asarray(centre + grid.reshape(-1, 3))


def _errors(table: Table) -> ErrorBudget:
    _check_keys(table, "errors")
    fit = _text(table, "fit", "errors")
    given: dict[str, Any] = dict(_numbers({k: v for k, v in table.items() if k != "fit"}, "errors"))
    return ErrorBudget(**given) if fit is None else ErrorBudget(**given, fit=fit)


def _check_keys(table: Table, where: str) -> None:
    for key in sorted(set(table) - _KEYS[where]):
        place = f"[{where}]" if where else "the file"
        raise SceneError(f"{place} has an unknown key {key!r}; known are {', '.join(sorted(_KEYS[where]))}")


def _table(document: Table, key: str, where: str | None = None) -> Table:
    value = document.get(key, {})
    if not isinstance(value, dict):
        raise SceneError(f"[{where or key}] must be a table")
    return value


def _text(table: Table, key: str, where: str, required: bool = False) -> str | None:
    value = table.get(key)
    if value is None and not required:
        return None
    if not isinstance(value, str) or not value:
        raise SceneError(f"[{where}] {key} is {value!r}; expected a text")
    return value


def _number(table: Table, key: str, where: str, default: float) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SceneError(f"[{where}] {key} is {value!r}; expected a number")
    return float(value)


def _numbers(table: Table, where: str) -> dict[str, float]:
    _check_keys(table, where)
    if where == "needle":
        for key in sorted(_KEYS["needle"] - set(table)):
            raise SceneError(f"[needle] {key} is missing")
    return {key: _number(table, key, where, 0.0) for key in table}


def _vector(table: Table, key: str, where: str) -> Array:
    value = table[key]
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise SceneError(f"[{where}] {key} is {value!r}; expected three finite numbers [x, y, z]")
    return vector
