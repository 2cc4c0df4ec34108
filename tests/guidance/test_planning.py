from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from guidance.errors import SceneError
from guidance.needle import Needle
from guidance.planning import plan
from guidance.planning.candidates import make_candidates
from guidance.planning.constraints import judge
from guidance.scene import Entry, Structure, Target
from tests.guidance.balls_scene import balls_scene
from tests.guidance.closed_form import ball, segment_distance


def test_the_best_path_keeps_what_it_must():
    scene = balls_scene()
    plans = plan(scene)
    assert len(plans) > 20
    for p in plans:
        hub, tip = p.trajectory.needle_axis(scene.needle)
        for s in scene.avoid:
            true_gap = float(segment_distance(hub, tip, s.shape.start, s.shape.end)[0]) - s.shape.radius
            needed = s.margin_mm + scene.needle.radius_mm + 1.8 + s.shape.fit_error[2]
            assert true_gap >= needed - 1e-9
            assert p.clearances[s.name].clearance_mm == pytest.approx(true_gap - scene.needle.radius_mm, abs=1e-9)
            assert p.clearances[s.name].needed_mm == pytest.approx(needed - scene.needle.radius_mm)
        assert np.linalg.norm(tip - scene.target.point) <= scene.target.tolerance_mm
        assert np.linalg.norm(p.trajectory.entry) == pytest.approx(75.0, abs=0.3)
    assert [p.rank for p in plans] == list(range(1, len(plans) + 1))
    assert [p.cost for p in plans] == sorted(p.cost for p in plans)
    assert plans[0].pareto


def test_the_quick_bound_rules_out_nothing_that_is_safe():
    scene = balls_scene(entry=Entry(structure="organ", count=600))
    candidates = make_candidates(scene, np.zeros((1, 3)))
    verdict = judge(scene, candidates)
    hubs = scene.needle.hub(candidates.tips, candidates.directions)
    for s in scene.avoid:
        true = segment_distance(hubs, candidates.tips, s.shape.start, s.shape.end) - s.shape.radius
        safe = true - scene.needle.radius_mm >= s.margin_mm + 1.8 + s.shape.fit_error[2]
        asked = ~np.isnan(verdict.clearances[s.name].measured)
        np.testing.assert_array_equal(~verdict.fails[f"clearance: {s.name}"][asked], safe[asked])


def test_every_rejection_has_its_reason_and_is_counted():
    plans = plan(balls_scene())
    assert sum(plans.rejections.values()) >= len(plans.rejected)
    assert all(r.reasons for r in plans.rejected)
    assert len(plans) + len(plans.rejected) == plans.candidates
    for reason, count in plans.rejections.items():
        assert sum(reason in r.reasons for r in plans.rejected) == count


def test_no_path_says_which_constraint_forbids_all(tmp_path):
    plans = plan(balls_scene(needle=Needle(40.0, 0.9)))
    assert plans.best is None
    assert plans.rejections["needle too short"] == plans.candidates
    assert "'needle too short' forbids every one" in plans.why_none
    plans.save(tmp_path / "plan.json")
    record = json.loads((tmp_path / "plan.json").read_text())
    assert record["feasible"] == 0
    assert "needle too short" in record["why_none"]


def test_a_shell_around_the_target_is_named():
    scene = balls_scene()
    structures = (*scene.structures, Structure("bone", ball([20, 0, 0], 15), "avoid", 1.0))
    plans = plan(replace(scene, structures=structures))
    assert plans.best is None
    assert "'clearance: bone' forbids every one" in plans.why_none


def test_where_the_centre_cannot_be_reached_the_tolerance_is_used():
    """A rod grazes the centre; points 3 mm off are far enough from it."""
    scene = balls_scene(
        structures=(
            Structure("organ", ball([0, 0, 0], 75), "entry"),
            Structure("wire", ball([20, 0, -4.5], 2.2), "avoid", 0.5),
        ),
        target=Target(np.array([20.0, 0.0, 0.0]), 5.0),
    )
    plans = plan(scene)
    assert plans.best is not None
    assert 0.0 < plans.best.target_miss_mm <= 5.0


def test_p95_instead_of_the_maximum_asks_for_less():
    scene = balls_scene()
    lenient = replace(scene, errors=replace(scene.errors, fit="p95"))
    assert plan(lenient)[0].clearances["bag"].needed_mm == pytest.approx(3.0 + 1.8 + 0.3)
    assert plan(lenient).to_record()["error_budget"]["fit_statistic"] == "p95"


def test_an_entry_that_leaves_again_is_refused():
    """Two balls as one organ in a row: a path through the gap between them enters twice."""
    from tests.guidance.closed_form import Rod

    scene = balls_scene(
        structures=(Structure("organ", Rod([0, -60, 0], [0, 60, 0], 20), "entry"),),
        target=Target(np.array([0.0, 0.0, 25.0]), 1.0),
        entry=Entry(structure="organ", count=50, max_angle_deg=90.0),
    )
    plans = plan(scene)
    assert plans.best is None  # the target lies outside of the organ
    assert plans.rejections["not entered exactly once"] > 0


def test_listed_entries_and_a_region():
    points = np.array([[100.0, 0.0, 0.0], [0.0, 0.0, 100.0], [20.0, 0.0, 0.0]])
    plans = plan(balls_scene(entry=Entry(points=points)))
    assert plans.candidates == 3
    assert plans.rejections["needle too short"] == 1  # the target itself: no path
    near = plan(balls_scene(entry=Entry(points=points, near=np.array([100.0, 0, 0]), within_mm=10.0)))
    assert near.rejections["outside the entry region"] == 2


def test_a_structure_without_a_model_forbids_planning():
    scene = balls_scene()
    structures = tuple(replace(s, shape=None) if s.name == "vein" else s for s in scene.structures)
    with pytest.raises(SceneError, match="no model of vein"):
        plan(replace(scene, structures=structures))


def test_touch_probability_falls_with_the_gap():
    plans = plan(balls_scene())
    pairs = sorted((c.clearance_mm, c.touch_probability) for p in plans for n, c in p.clearances.items() if n == "vein")
    probabilities = [p for _, p in pairs]
    assert probabilities == sorted(probabilities, reverse=True)
    assert 0.0 <= probabilities[0] < 0.01
