"""House rules that no linter knows, read from the source itself."""

from __future__ import annotations

import ast
import pkgutil
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(p for package in ("hhsr", "devices", "guidance") for p in (ROOT / package).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Return the top-level names that a file imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


EMITTERS = {  # these write the processor's vectors themselves (decisions 0005, 0007 to 0010), or say how to compile
    "unmanaged.py",
    "vectors.py",
    "stride.py",
    "field_sums.py",
    "cell_along.py",
    "disc_bounds.py",
    "either_lanes.py",
    "table_lanes.py",
}


@pytest.mark.parametrize("path", sorted((ROOT / "hhsr" / "kernels").glob("*.py")), ids=lambda p: p.name)
def test_kernels_import_numpy_numba_and_math_only(path: Path) -> None:
    known = {"numpy", "numba", "math", "__future__"}
    if path.name in EMITTERS:
        known |= {"llvmlite", "typing", "collections", "functools"}
    foreign = {n for n in imported(path) if n.split(".")[0] not in known}
    assert all(n.startswith("hhsr.kernels") for n in foreign), foreign


def test_only_one_file_imports_serial() -> None:
    users = [p.relative_to(ROOT).as_posix() for p in SOURCES if any(n.split(".")[0] == "serial" for n in imported(p))]
    assert users in ([], ["devices/transport.py"])


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_files_stay_short_and_well_named(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 450, "split the file: two ideas live here"
    assert not {"util", "utils", "helper", "helpers", "manager", "data"} & set(path.stem.split("_"))


@pytest.mark.parametrize("package", ["hhsr", "devices", "guidance"])
def test_no_public_name_is_also_a_module(package: str) -> None:
    module = __import__(package)
    names = set(module.__all__)
    assert len(names) <= 30
    assert not names & {m.name for m in pkgutil.iter_modules(module.__path__)}
    for name in names:
        assert getattr(module, name) is not None


def test_only_the_system_clock_reads_a_clock() -> None:
    """Time is an argument. Reports of how long something took may use perf_counter."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "time":
                allowed = {"perf_counter"} | (
                    {"monotonic", "time", "sleep"} if path.parts[-2:] == ("devices", "clock.py") else set()
                )
                assert node.attr in allowed, f"{path.relative_to(ROOT)}:{node.lineno} reads time.{node.attr}"


def test_every_imported_package_is_declared() -> None:
    """A package installed by hand hides a missing line in pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    listed = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        listed += extra
    declared = {d.split(">")[0].split("[")[0].split("=")[0].lower().replace("-", "_") for d in listed}
    alias = {
        "serial": "pyserial",
        "skimage": "scikit_image",
        "yaml": "pyyaml",
        "mpl_toolkits": "matplotlib",
        "igl": "libigl",
        "DracoPy": "dracopy",
        "distributed": "dask",
    }
    import sys

    for path in SOURCES:
        for name in {n.split(".")[0] for n in imported(path)}:
            if name in sys.stdlib_module_names or name in {"hhsr", "devices", "guidance"}:
                continue
            assert alias.get(name, name).lower() in declared, f"{path.relative_to(ROOT)} imports {name}"
