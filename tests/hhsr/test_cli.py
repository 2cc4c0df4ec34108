"""The command line on the real thing: a small body is fitted once, then described, meshed, verified and asked."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

import hhsr
from hhsr.cli import app

NAMES = {
    "parameters",
    "bytes",
    "leaves",
    "retained",
    "mean_error_mm",
    "p95_error_mm",
    "max_error_mm",
    "volume_ml",
    "seconds",
}


def run(*words: object) -> Any:
    return CliRunner().invoke(app, [str(word) for word in words])


def json_of(*words: object) -> dict[str, Any]:
    result = run(*words)
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def lopsided() -> trimesh.Trimesh:
    """Return a smooth body of some 30 mm that no symmetry hides the axes of."""
    body = trimesh.creation.icosphere(subdivisions=4, radius=12.0)
    x, y, z = body.vertices.T
    body.vertices = np.stack([1.3 * x + 0.01 * x * x, 0.9 * y, 0.7 * z + 0.008 * x * y + 0.004 * y * y], axis=1)
    body.apply_translation((5, 60, -20))
    return body


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with body.ply (written in RAS) and its fit, body.hhsr."""
    path = tmp_path_factory.mktemp("cli")
    body = lopsided()
    body.apply_transform(np.diag([-1.0, -1.0, 1.0, 1.0]))
    body.export(path / "body.ply")
    result = run("fit", path / "body.ply", "--frame", "RAS", "--max-parameters", 60, "-o", path / "body.hhsr")
    assert result.exit_code == 0, result.output
    return path


def test_fit_prints_what_was_asked_for(folder: Path) -> None:
    words = ("--frame", "RAS", "--max-parameters", 60, "-o", folder / "again.hhsr", "--json")
    figures = json_of("fit", folder / "body.ply", *words)
    assert set(figures) >= NAMES
    assert figures["parameters"] <= 60
    assert figures["retained"] == 0
    assert 0 < figures["mean_error_mm"] <= figures["p95_error_mm"] <= figures["max_error_mm"]
    assert figures["volume_ml"] == pytest.approx(lopsided().volume / 1000, rel=0.02)
    assert (folder / "again.hhsr").read_bytes() == (folder / "body.hhsr").read_bytes()
    assert figures["bytes"] == (folder / "body.hhsr").stat().st_size


def test_what_a_fit_may_buy_and_aim_at_reaches_it(folder: Path) -> None:
    out = folder / "bought.hhsr"
    words = ("--frame", "RAS", "--max-parameters", 60, "--bases", "any", "--max-error-weight", 0.5, "-o", out, "--json")
    assert json_of("fit", folder / "body.ply", *words)["parameters"] <= 60
    assert hhsr.load(out).provenance.options == {"max_parameters": 60, "bases": "any", "max_error_weight": 0.5}
    goal = ("--frame", "RAS", "--max-mean-error", 0.5, "--max-error", 4, "-o", out, "--json")
    figures = json_of("fit", folder / "body.ply", *goal)
    assert figures["mean_error_mm"] <= 0.5
    assert figures["max_error_mm"] <= 4
    assert hhsr.load(out).provenance.options == {"max_mean_error_mm": 0.5, "max_error_mm": 4.0}


def test_info_tells_the_same(folder: Path) -> None:
    figures = json_of("info", folder / "body.hhsr", "--json")
    assert set(figures) >= NAMES
    assert figures["frame"] == "RAS"
    shape = hhsr.load(folder / "body.hhsr")
    assert figures["mean_error_mm"] == shape.fit_error.mean_mm
    table = run("info", folder / "body.hhsr")
    assert table.exit_code == 0
    assert "mean_error_mm" in table.stdout


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_mesh_is_closed_and_in_lps(folder: Path, suffix: str) -> None:
    out = folder / f"out{suffix}"
    assert run("mesh", folder / "body.hhsr", "-o", out, "--tolerance", 0.1).exit_code == 0
    surface = hhsr.read_surface(out)
    assert surface.frame == "LPS"
    assert not any("taken as LPS" in words for words in surface.quality.warnings)
    assert np.allclose(surface.vertices.mean(axis=0), lopsided().vertices.mean(axis=0), atol=1.0)


def test_verify_measures_again(folder: Path) -> None:
    figures = json_of("verify", folder / "body.hhsr", folder / "body.ply", "--json")
    assert figures["verified"] is True
    assert figures["same_source"] is True
    assert figures["mean_error_mm"] == pytest.approx(figures["stored_mean_error_mm"], rel=0.05)
    moved = lopsided().apply_translation((2, 0, 0))
    moved.export(folder / "moved.ply")
    result = run("verify", folder / "body.hhsr", folder / "moved.ply", "--frame", "LPS", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["verified"] is False


def test_queries_answer_row_by_row(folder: Path) -> None:
    shape = hhsr.load(folder / "body.hhsr")
    points = np.random.default_rng(0).uniform(shape.bounds[0] - 3, shape.bounds[1] + 3, (40, 3))
    np.savetxt(folder / "p.csv", points, delimiter=",", header="x,y,z", comments="", fmt="%.17g")
    np.save(folder / "p.npy", points)
    for source in ("p.csv", "p.npy"):
        assert run("query", folder / "body.hhsr", "contains", folder / source, "-o", folder / "in.csv").exit_code == 0
        header, *rows = (folder / "in.csv").read_text().split()
        assert header == "inside"
        assert [row == "1" for row in rows] == shape.contains(points).tolist()
        assert run("query", folder / "body.hhsr", "distance", folder / source, "-o", folder / "d.csv").exit_code == 0
        header, *rows = (folder / "d.csv").read_text().split()
        assert header == "distance_mm"
        assert [float(row) for row in rows] == shape.signed_distance(points).tolist()
    assert run("query", folder / "body.hhsr", "contains", folder / "p.npy", "-o", folder / "in.npy").exit_code == 0
    assert np.array_equal(np.load(folder / "in.npy"), shape.contains(points))


def test_crossings_are_listed_in_order(folder: Path) -> None:
    shape = hhsr.load(folder / "body.hhsr")
    segments = np.random.default_rng(1).uniform(
        np.tile(shape.bounds[0] - 9, 2), np.tile(shape.bounds[1] + 9, 2), (30, 6)
    )
    head = "x1,y1,z1,note,x0,y0,z0"  # columns go by name
    rows = [",".join([*map(repr, row[3:].tolist()), "?", *map(repr, row[:3].tolist())]) for row in segments]
    (folder / "s.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    assert run("query", folder / "body.hhsr", "crossings", folder / "s.csv", "-o", folder / "c.csv").exit_code == 0
    header, *lines = (folder / "c.csv").read_text().split()
    assert header == "segment,t,x,y,z,entering"
    found = shape.crossings(segments[:, :3], segments[:, 3:])
    table = np.array([[float(field) for field in line.split(",")] for line in lines]).reshape(-1, 6)
    assert len(table) == found.offsets[-1] > 0
    assert np.array_equal(np.searchsorted(table[:, 0], np.arange(31)), found.offsets)
    assert np.array_equal(table[:, 1], found.t)
    assert np.array_equal(table[:, 2:5], found.points)
    assert np.array_equal(table[:, 5] == 1, found.entering)


def test_no_rows_in_no_rows_out(folder: Path) -> None:
    (folder / "none.csv").write_text("x,y,z\n", encoding="utf-8")
    assert run("query", folder / "body.hhsr", "contains", folder / "none.csv", "-o", folder / "o.csv").exit_code == 0
    assert (folder / "o.csv").read_text() == "inside\n"


def test_a_retained_mesh_is_kept_whole(folder: Path) -> None:
    ring = trimesh.creation.torus(major_radius=20, minor_radius=5, major_sections=24, minor_sections=12)
    ring.export(folder / "ring.ply")
    figures = json_of("fit", folder / "ring.ply", "--frame", "LPS", "--retain", "-o", folder / "ring.hhsr", "--json")
    assert (figures["leaves"], figures["retained"]) == (1, 1)
    assert figures["max_error_mm"] < 0.01
    assert figures["volume_ml"] == pytest.approx(ring.volume / 1000, rel=1e-3)


def test_a_label_map_asks_for_its_label(folder: Path) -> None:
    index = np.stack(np.meshgrid(*[np.arange(30)] * 3, indexing="ij"), axis=-1) - 14.6
    labels = np.where((index**2 / [144, 100, 81]).sum(axis=-1) < 1, 2, 0).astype(np.uint8)
    labels[0, 0, 0] = 1
    nibabel.save(nibabel.Nifti1Image(labels, np.eye(4)), folder / "map.nii.gz")
    result = run("fit", folder / "map.nii.gz", "-o", folder / "map.hhsr")
    assert result.exit_code == 2
    assert "1, 2" in result.stderr
    options = ("--label", 2, "--max-parameters", 40)
    figures = json_of("fit", folder / "map.nii.gz", *options, "-o", folder / "map.hhsr", "--json")
    assert (figures["label"], figures["frame"]) == (2, "RAS")
    assert figures["volume_ml"] == pytest.approx(labels.astype(bool).sum() / 1000, rel=0.03)
    verified = json_of("verify", folder / "map.hhsr", folder / "map.nii.gz", "--json")
    assert verified["verified"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("info", "{}/none.hhsr"), "none.hhsr"),
        (("info", "{}/body.ply"), "not a .hhsr file"),
        (("fit", "{}/none.ply", "-o", "{}/o.hhsr"), "no such file"),
        (("fit", "{}/body.ply", "-o", "{}/nowhere/o.hhsr"), "folder"),
        (("fit", "{}/body.ply", "--frame", "XYZ", "-o", "{}/o.hhsr"), "three letters"),
        (("fit", "{}/body.ply", "--max-parameters", "3", "-o", "{}/o.hhsr"), "max_parameters"),
        (("fit", "{}/body.ply", "--bases", "none", "-o", "{}/o.hhsr"), "bases"),
        (("fit", "{}/body.ply", "--max-error-weight", "2", "-o", "{}/o.hhsr"), "max_error_weight"),
        (("fit", "{}/body.ply", "--unit", "m", "--recipe", "none", "-o", "{}/o.hhsr"), "recipe"),
        (("mesh", "{}/body.hhsr", "-o", "{}/o.xyz"), ".ply"),
        (("query", "{}/body.hhsr", "contains", "{}/bad.csv", "-o", "{}/o.csv"), "line 3"),
        (("query", "{}/body.hhsr", "contains", "{}/nan.csv", "-o", "{}/o.csv"), "not finite"),
        (("query", "{}/body.hhsr", "crossings", "{}/nan.csv", "-o", "{}/o.csv"), "x0,y0,z0,x1,y1,z1"),
        (("query", "{}/body.hhsr", "contains", "{}/body.ply", "-o", "{}/o.csv"), "expected"),
        (("verify", "{}/body.hhsr", "{}/none.ply"), "no such file"),
    ],
)
def test_bad_input_ends_with_2_and_one_line(folder: Path, words: tuple[str, ...], says: str) -> None:
    (folder / "bad.csv").write_text("x,y,z\n1,2,3\n1,two,3\n", encoding="utf-8")
    (folder / "nan.csv").write_text("x,y,z\n1,nan,3\n", encoding="utf-8")
    result = run(*(word.format(folder) for word in words))
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_it_runs_as_a_program(folder: Path) -> None:
    words = [sys.executable, "-c", "from hhsr.cli import app; app()", "info", str(folder / "body.ply")]
    result = subprocess.run(words, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "not a .hhsr file" in result.stderr
    assert "Traceback" not in result.stderr
