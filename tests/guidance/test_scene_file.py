from __future__ import annotations

import numpy as np
import pytest
import trimesh

from guidance.errors import SceneError
from guidance.scene import Scene

HEAD = """
[needle]
length_mm = 120
radius_mm = 0.9
[target]
structure = "gland"
[entry]
structure = "body"
"""
BODY = '[[structure]]\nname = "body"\nmesh = "body.ply"\nframe = "LPS"\nrole = "entry"\nretain = true\n'
GLAND = '[[structure]]\nname = "gland"\nmesh = "gland.ply"\nframe = "LPS"\nrole = "target"\nretain = true\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    for name, radius, centre in (("body", 60.0, (0, 0, 0)), ("gland", 12.0, (10, 5, 0))):
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        mesh.apply_translation(centre)
        mesh.export(folder / f"{name}.ply")
    return folder


def load(folder, text):
    (folder / "scene.toml").write_text(text)
    return Scene.load(folder / "scene.toml")


def test_a_scene_is_read_fitted_and_kept(folder):
    ready = []
    text = HEAD + BODY + GLAND
    (folder / "scene.toml").write_text(text)
    scene = Scene.load(folder / "scene.toml", progress=lambda name, shape: ready.append((name, shape.parameters)))
    assert [name for name, _ in ready] == ["body", "gland"]
    np.testing.assert_allclose(scene.target.point, [10, 5, 0], atol=0.05)
    kept = sorted((folder / "scene.shapes").glob("*.hhsr"))
    assert len(kept) == 2
    stamps = [k.stat().st_mtime_ns for k in kept]
    again = Scene.load(folder / "scene.toml")
    assert again.hash == scene.hash
    assert [k.stat().st_mtime_ns for k in sorted((folder / "scene.shapes").glob("*.hhsr"))] == stamps
    kept[0].write_bytes(b"damaged")
    assert Scene.load(folder / "scene.toml").hash == scene.hash
    changed = load(folder, text.replace("radius_mm = 0.9", "radius_mm = 1.2"))
    assert changed.hash != scene.hash


def test_a_ready_shape_can_be_given(folder):
    load(folder, HEAD + BODY + GLAND).structure("gland").shape.save(folder / "gland.hhsr")
    text = HEAD + BODY + GLAND.replace('mesh = "gland.ply"\nframe = "LPS"', 'shape = "gland.hhsr"')
    assert load(folder, text).structure("gland").shape.bounds.shape == (2, 3)


def test_a_template_hangs_below_the_target(folder):
    text = HEAD.replace(
        'structure = "body"',
        "[entry.template]\nbelow_target_mm = 70\ndirection = [0, 0, 1]\nrows = 3\ncolumns = 5\nspacing_mm = 5",
    )
    points = load(folder, text + BODY + GLAND).entry.points
    assert points.shape == (15, 3)
    np.testing.assert_allclose(points.mean(axis=0), [10, 5, -70], atol=0.05)
    np.testing.assert_allclose(np.ptp(points, axis=0), [20, 10, 0], atol=1e-9)


BAD = {
    "unknown key": (HEAD + BODY + GLAND + "colour = 3\n", "unknown key 'colour'"),
    "no structures": (HEAD, r"\[structure\] is missing"),
    "single brackets": (HEAD + BODY.replace("[[structure]]", "[structure]"), r"\[\[structure\]\]"),
    "no needle": (HEAD.replace("[needle]", "[errors]"), r"\[needle\] is missing"),
    "a key of another table": (HEAD + "[errors]\nlength_mm = 3\n" + BODY + GLAND, "'length_mm'"),
    "needle without length": (HEAD.replace("length_mm = 120\n", "") + BODY + GLAND, "length_mm is missing"),
    "needle of a text": (HEAD.replace("120", '"long"') + BODY + GLAND, "expected a number"),
    "endless needle": (HEAD.replace("120", "inf") + BODY + GLAND, "length_mm is inf"),
    "missing file": (HEAD + BODY.replace("body.ply", "nobody.ply") + GLAND, "there is no file"),
    "no file key": (HEAD + BODY.replace('mesh = "body.ply"\n', "") + GLAND, "exactly one of mesh"),
    "unknown target": (HEAD.replace('"gland"', '"tumour"') + BODY + GLAND, "'tumour'"),
    "two of one name": (HEAD + BODY + GLAND + GLAND, "share a name"),
    "unknown role": (HEAD + BODY.replace('"entry"', '"shun"') + GLAND, "role is 'shun'"),
    "unknown frame": (HEAD + BODY.replace('"LPS"', '"XYZ"').replace("retain", "force = true\nretain") + GLAND, "XYZ"),
    "negative margin": (HEAD + BODY + GLAND + "margin_mm = -1\n", "margin_mm is -1"),
    "label of a text": (HEAD + BODY + GLAND + 'label = "one"\n', "label is 'one'"),
    "retain of a number": (HEAD + BODY.replace("true", "1") + GLAND, "expected true or false"),
    "target nowhere": (HEAD.replace('structure = "gland"', "point = [1, 2, nan]") + BODY + GLAND, "three finite"),
    "no entry": (HEAD.replace('structure = "body"', "count = 5") + BODY + GLAND, "entry: give"),
    "bad points": (HEAD.replace('structure = "body"', "points = [[1, 2]]") + BODY + GLAND, "list of"),
    "bad statistic": (HEAD + '[errors]\nfit = "best"\n' + BODY + GLAND, "fit is 'best'"),
    "huge error": (HEAD + "[errors]\ntracker_mm = 1e3\n" + BODY + GLAND, "tracker_mm is 1000"),
    "flat template": (
        HEAD.replace('structure = "body"', "[entry.template]\nbelow_target_mm = 70\nacross = [0, 0, 2]") + BODY + GLAND,
        "parallel",
    ),
    "not TOML": ("[needle", "not valid TOML"),
    "not text": ("\x00\udcff", "TOML|read"),
}


@pytest.mark.parametrize(("text", "says"), BAD.values(), ids=BAD.keys())
def test_bad_scenes_say_what_to_change(folder, text, says):
    (folder / "bad.toml").write_bytes(text.encode("utf-8", errors="surrogateescape"))
    with pytest.raises(SceneError, match=says) as raised:
        Scene.load(folder / "bad.toml")
    assert "bad.toml" in str(raised.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(SceneError, match="there is no scene file"):
        Scene.load(tmp_path / "none.toml")


def test_a_mesh_that_cannot_be_used(folder):
    (folder / "text.ply").write_text("not a mesh")
    with pytest.raises(SceneError, match="structure 'body'"):
        load(folder, HEAD + BODY.replace("body.ply", "text.ply") + GLAND)
