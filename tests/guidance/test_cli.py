"""The commands on small scenes of retained meshes: the whole walk, files in, files out."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

import devices
from guidance.cli import app
from guidance.event_log import replay
from guidance.scene import Scene

SCENE = """
name = "two balls"
[needle]
length_mm = 120
radius_mm = 0.9
[target]
structure = "gland"
tolerance_mm = 2
[entry]
structure = "body"
count = 150
[[structure]]
name = "body"
mesh = "body.ply"
frame = "LPS"
role = "entry"
retain = true
[[structure]]
name = "gland"
mesh = "gland.ply"
frame = "LPS"
role = "target"
retain = true
[[structure]]
name = "big vessel"
mesh = "vessel.ply"
frame = "LPS"
margin_mm = 2
retain = true
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    for name, radius, centre in (("body", 50.0, (0, 0, 0)), ("gland", 8.0, (10, 5, 0)), ("vessel", 5.0, (-12, 0, 0))):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        mesh.apply_translation(centre)
        mesh.export(folder / f"{name}.ply")
    (folder / "scene.toml").write_text(SCENE)
    return folder


@pytest.fixture(scope="module")
def done(folder):
    result = CliRunner().invoke(app, ["run", str(folder / "scene.toml"), "--out", str(folder / "out"), "--seed", "3"])
    assert result.exit_code == 0, result.output
    return result


def events(folder):
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def test_a_run_leaves_its_files(done, folder):
    out = folder / "out"
    assert {"body.hhsr", "gland.hhsr", "big_vessel.hhsr"} <= {p.name for p in out.iterdir()}
    assert (out / "picture.png").stat().st_size > 50_000
    assert "warned" in done.output
    plan = json.loads((out / "plan.json").read_text())
    assert plan["feasible"] > 10
    assert plan["plans"][0]["clearances"]["big vessel"]["surplus_mm"] >= 0.0
    assert plan["error_budget"]["fit_statistic"] == "max"


def test_the_plan_can_be_followed_as_a_tracker(done, folder):
    plan = json.loads((folder / "out" / "plan.json").read_text())
    tracker = devices.open_tracker(f"sim:{folder / 'out' / 'plan.json'}?seed=1&rate=60&noise_mm=0.2")
    last = list(tracker.frames())[-1].tools["needle"].T_tracker_tool
    tip = (np.array(plan["T_patient_tracker"]) @ last @ np.array(plan["T_tool_tip"]))[:3, 3]
    np.testing.assert_allclose(tip, plan["plans"][0]["tip_mm"], atol=1.5)


def test_the_wrong_insertion_is_warned_of_before_contact(done, folder):
    wrong = [e for e in events(folder / "out") if e["run"] == "wrong" and e["structure"] == "big vessel"]
    states = [e["to"] for e in wrong]
    assert states.index("APPROACHING") < states.index("CONTACT")
    approaching = wrong[states.index("APPROACHING")]
    low, high = approaching["seconds_to_contact_interval"]
    assert low <= approaching["seconds_to_contact"] <= high
    assert approaching["alarm"]
    planned = [e for e in events(folder / "out") if e["run"] == "planned" and e["alarm"]]
    assert planned == []


def test_the_session_replays(done, folder):
    scene = Scene.load(folder / "scene.toml")
    for run in ("planned", "wrong"):
        assert all(same for _, same in replay(folder / "out" / f"session-{run}.jsonl", scene))


def test_the_same_seed_gives_the_same_files(done, folder):
    again = folder / "again"
    CliRunner().invoke(app, ["run", str(folder / "scene.toml"), "--out", str(again), "--seed", "3"])
    for name in ("plan.json", "events.jsonl", "body.hhsr", "session-wrong.jsonl"):
        assert (again / name).read_bytes() == (folder / "out" / name).read_bytes()


def test_no_safe_path_is_a_result_not_an_error(folder):
    (folder / "short.toml").write_text(SCENE.replace("length_mm = 120", "length_mm = 20"))
    result = CliRunner().invoke(app, ["run", str(folder / "short.toml"), "--out", str(folder / "short")])
    assert result.exit_code == 0, result.output
    plan = json.loads((folder / "short" / "plan.json").read_text())
    assert plan["feasible"] == 0
    assert "'needle too short' forbids every one" in plan["why_none"]
    assert (folder / "short" / "picture.png").is_file()


def test_bad_input_ends_with_two_and_one_line(folder):
    for text in (SCENE.replace("gland.ply", "nothing.ply"), SCENE + "margin_mm = -2\n", "no toml"):
        (folder / "bad.toml").write_text(text)
        result = CliRunner().invoke(app, ["run", str(folder / "bad.toml"), "--out", str(folder / "bad")])
        assert result.exit_code == 2
        assert "error:" in result.stderr
        assert "Traceback" not in result.output
    assert CliRunner().invoke(app, ["run", str(folder / "none.toml")]).exit_code == 2
    assert CliRunner().invoke(app, ["demo", "--seed", "-1"]).exit_code == 2
