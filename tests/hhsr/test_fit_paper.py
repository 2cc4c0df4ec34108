"""The paper's fit from end to end, small: budgets kept, options refused, real organs within the figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import hhsr
from hhsr.errors import FitError, InputError
from hhsr.model import Cut, RetainedPart, cuts, leaves

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def dumbbell() -> hhsr.Surface:
    """Two balls of 10 mm joined by a rod."""
    rod = trimesh.creation.cylinder(radius=4.0, height=26.0, sections=48)
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=10.0) for _ in range(2)]
    balls[0].apply_translation((-13, 0, 0))
    balls[1].apply_translation((13, 0, 0))
    mesh = trimesh.boolean.union([*balls, rod], engine="manifold")
    return hhsr.Surface.from_mesh(np.array(mesh.vertices), np.array(mesh.faces))


@pytest.fixture(scope="module")
def fitted() -> hhsr.Shape:
    return hhsr.fit(dumbbell(), hhsr.FitOptions.paper(max_parameters=300, t_mm=3.0, samples=2000))


def test_a_dumbbell_is_cut_fitted_and_closed(fitted: hhsr.Shape) -> None:
    assert fitted.parameters <= 300
    assert isinstance(fitted.tree.root, Cut)
    assert fitted.fit_error is not None
    assert fitted.fit_error.mean_mm < 0.5
    mesh = fitted.mesh()
    assert mesh.is_watertight
    assert mesh.volume / 1000 == pytest.approx(fitted.report["topology"]["volume_ml"][0], rel=0.02)


def test_cut_with_a_band_holds_contours_and_the_report_says_so(fitted: hhsr.Shape) -> None:
    for cut, row in zip(cuts(fitted.tree.root), fitted.report["cuts"], strict=True):
        assert (cut.half_width > 0) == bool(cut.contours) == (row["lobes"] > 0)
    assert len(fitted.leaf_errors) == len(list(leaves(fitted.tree.root))) == len(fitted.report["leaves"])


def test_the_same_options_give_the_same_bytes(fitted: hhsr.Shape) -> None:
    again = hhsr.fit(dumbbell(), hhsr.FitOptions.paper(max_parameters=300, t_mm=3.0, samples=2000))
    assert again.encoded == fitted.encoded


def test_t1_of_one_never_cuts() -> None:
    options = hhsr.FitOptions.paper(max_parameters=120, t_mm=3.0, t1=1.0, samples=1000)
    assert not list(cuts(hhsr.fit(dumbbell(), options).tree.root))


def test_the_papers_fit_spends_until_its_largest_error_is_met() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    u = np.array(ball.vertices) / 20.0
    bumpy = 20.0 * u * (1.0 + 0.05 * np.sin(5.0 * u[:, :1]) * np.cos(4.0 * u[:, 1:2]))
    surface = hhsr.Surface.from_mesh(bumpy, np.array(ball.faces))
    fits = [
        hhsr.fit(surface, hhsr.FitOptions.paper(max_error_mm=goal, t1=1.0, samples=2000)) for goal in (1.0, 0.3, 0.1)
    ]
    assert fits[0].parameters < fits[1].parameters < fits[2].parameters
    for fit, goal in zip(fits, (1.0, 0.3, 0.1), strict=True):
        assert fit.fit_error is not None
        assert fit.fit_error.max_mm < goal


def test_what_cannot_be_modelled_is_retained_or_named() -> None:
    kept = hhsr.fit(dumbbell(), hhsr.FitOptions.paper(t_mm=3.0, t2_mm3=1e9, samples=1000))
    assert isinstance(kept.tree.root, RetainedPart)
    assert kept.fit_error is not None
    assert kept.fit_error.max_mm < 1e-3
    with pytest.raises(FitError, match="max_parameters is 300"):
        hhsr.fit(dumbbell(), hhsr.FitOptions.paper(max_parameters=300, t3_mm=1e-6, t_mm=3.0))


def test_retain_keeps_the_mesh_whole() -> None:
    surface = dumbbell()
    shape = hhsr.fit(surface, hhsr.FitOptions(retain=True, samples=1000))
    assert isinstance(shape.tree.root, RetainedPart)
    assert np.array_equal(shape.tree.root.vertices, surface.vertices)


@pytest.mark.parametrize(
    "bad",
    [
        {"recipe": "best"},
        {"max_parameters": 3},
        {"max_parameters": 12.5},
        {"t_mm": 0.0},
        {"t_mm": float("nan")},
        {"t1": 1.5},
        {"seed": -1},
        {"samples": 10},
        {"half_width_mm": -1.0},
    ],
)
def test_impossible_options_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        hhsr.FitOptions(**bad)


def test_options_say_only_what_differs() -> None:
    assert hhsr.FitOptions().to_json() == {}
    assert hhsr.FitOptions.paper(t_mm=3.0).to_json() == {"recipe": "paper", "t_mm": 3.0}


def test_a_mesh_is_no_surface() -> None:
    with pytest.raises(InputError, match="read_surface"):
        hhsr.fit(trimesh.creation.box())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "budget", "goal"),
    [
        ("prostate/prostate_picai_10024.ply", 337, 0.152),
        ("prostate/prostate_picai_10001.ply", 337, 0.152),
        ("liver/liver_sksurgery_B.ply", 989, 1.116),
    ],
)
def test_real_organs_are_within_the_papers_figures(name: str, budget: int, goal: float) -> None:
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{path} is missing: the real organs are not part of the project")
    shape = hhsr.fit(hhsr.read_surface(path, frame="LPS"), hhsr.FitOptions.paper(max_parameters=budget, samples=5000))
    assert shape.parameters <= budget
    assert shape.fit_error is not None
    assert shape.fit_error.mean_mm <= goal
    mesh = shape.mesh()
    assert mesh.is_watertight
    assert shape.report["topology"]["volume_ml"][1] == pytest.approx(shape.report["topology"]["volume_ml"][0], rel=0.02)
