"""Fits in processes of their own: they end when told to, and none begins afterwards."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from guidance import fitted_shapes
from guidance.errors import SceneError
from guidance.fitted_shapes import ShapeSource, _Commands


def test_a_command_says_how_it_ended(tmp_path: Path) -> None:
    code, said = _Commands().run("info", str(tmp_path / "none.hhsr"))
    assert code == 2
    assert "none.hhsr" in " ".join(said)


def test_a_command_runs_the_package_that_runs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hhsr").mkdir()
    (tmp_path / "hhsr" / "__init__.py").write_text("raise ImportError('another hhsr, in the folder one stands in')")
    monkeypatch.chdir(tmp_path)
    code, said = _Commands().run("--help")
    assert code == 0, said
    assert any("warm-up" in line for line in said)


def test_stopped_commands_end_and_none_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []
    commands = _Commands()
    monkeypatch.setattr(fitted_shapes, "_HHSR", "import time; print('begun', flush=True); time.sleep(600)")
    thread = threading.Thread(target=lambda: ended.append(commands.run("fit")[0]))
    thread.start()
    while not commands._running:
        time.sleep(0.01)
    commands.stop()
    thread.join(60.0)
    assert len(ended) == 1
    assert ended[0] != 0
    assert commands.run("fit") == (1, ["stopped before it began"])


def test_a_bad_source_ends_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that cannot be read is told of; what would have run for ten minutes is ended."""
    bad = tmp_path / "bad.ply"
    bad.write_text("no mesh")
    long = tmp_path / "long.ply"
    long.write_text("no mesh either, and never read")
    monkeypatch.setattr(fitted_shapes, "_cores", lambda: 2)
    wait = "time.sleep(0 if sys.argv[2].endswith('bad.ply') else 600)"
    script = f"import sys, time; {wait}; sys.exit('cannot be read')"
    monkeypatch.setattr(fitted_shapes, "_HHSR", script)
    sources = [ShapeSource("bad", bad, max_parameters=60), ShapeSource("long", long, max_parameters=60)]
    with pytest.raises(SceneError, match=r"'bad' \(bad\.ply\): cannot be read"):
        fitted_shapes.fitted_shapes(sources, tmp_path / "kept")
