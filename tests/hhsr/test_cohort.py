"""Cohorts: killed at any moment and started again, the same files; bad inputs beside good ones; processes and Dask."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import trimesh
from typer.testing import CliRunner

import hhsr
from hhsr.cli import app
from hhsr.cohort import Job, fit_cohort, jobs_of
from hhsr.errors import InputError

# Kept whole: the cohort's own work is tested here, and a fit's sameness by the tests of the fit.
OPTIONS = {"retain": True, "samples": 1000}
READING = {"frame": "LPS"}


@pytest.fixture(scope="module")
def organs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three bodies and a broken file, two of them of one name in different places."""
    folder = tmp_path_factory.mktemp("organs")
    (folder / "left").mkdir()
    for i, name in enumerate(("a.ply", "b.stl", "left/a.ply")):
        body = trimesh.creation.icosphere(subdivisions=2, radius=10.0 + i)
        body.export(folder / name)
    (folder / "c.ply").write_bytes(b"ply\nbroken")
    (folder / "notes.txt").write_text("no organ")
    return folder


def files_of(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder by its path, the table's seconds taken out."""
    found = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    with (folder / "cohort.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]
    found["cohort.csv"] = repr(rows).encode()
    return found


@pytest.fixture(scope="module")
def whole(organs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole")
    fit_cohort(jobs_of(organs, out, READING, OPTIONS), out, workers=2)
    return out


def test_one_bad_input_stops_nothing(whole: Path) -> None:
    assert set(files_of(whole)) == {"a.hhsr", "b.hhsr", "left/a.hhsr", "cohort.csv"}
    with (whole / "cohort.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["fitted", "fitted", "failed", "fitted"]
    assert "readable" in rows[2]["message"]
    shape = hhsr.load(whole / "b.hhsr")
    assert int(rows[1]["parameters"]) == shape.parameters
    assert float(rows[1]["mean_error_mm"]) == shape.fit_error.mean_mm


def test_killed_and_taken_up_again_it_ends_the_same(organs: Path, whole: Path, tmp_path: Path) -> None:
    script = f"""
import os, signal
from pathlib import Path
from hhsr.cohort import fit_cohort, jobs_of
def ended(job, status):
    if status == "fitted":
        os.kill(os.getpid(), signal.SIGKILL)
if __name__ == "__main__":
    out = Path({str(tmp_path)!r})
    fit_cohort(jobs_of(Path({str(organs)!r}), out, {READING!r}, {OPTIONS!r}), out, workers=1, progress=ended)
"""
    program = tmp_path.parent / "killed.py"
    program.write_text(script)
    killed = subprocess.run([sys.executable, str(program)], check=False, capture_output=True)
    assert killed.returncode == -signal.SIGKILL
    done = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.hhsr")}
    assert len(done) == 1
    (tmp_path / ".b.hhsr.part").write_bytes(b"half a file")  # as if killed while writing
    said: list[str] = []
    fit_cohort(
        jobs_of(organs, tmp_path, READING, OPTIONS), tmp_path, 1, progress=lambda job, status: said.append(status)
    )
    assert sorted(said) == ["failed", "fitted", "fitted", "kept"]
    assert all(path.stat().st_mtime_ns == time for path, time in done.items())
    assert files_of(tmp_path) == files_of(whole)


def test_other_options_or_a_damaged_file_are_fitted_again(organs: Path, whole: Path, tmp_path: Path) -> None:
    for name, content in files_of(whole).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    (tmp_path / "a.hhsr").write_bytes((tmp_path / "a.hhsr").read_bytes()[:-3])
    jobs = [job for job in jobs_of(organs, tmp_path, READING, OPTIONS) if job.source.name != "c.ply"]
    jobs[1] = Job(jobs[1].source, jobs[1].target, READING, OPTIONS | {"samples": 2000})
    said: dict[str, str] = {}
    fit_cohort(
        jobs, tmp_path, 1, progress=lambda job, status: said.update({str(job.target.relative_to(tmp_path)): status})
    )
    assert said == {"a.hhsr": "fitted", "b.hhsr": "fitted", "left/a.hhsr": "kept"}


@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_whose_worker_is_killed_gives_the_same(organs: Path, whole: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        killed: list[int] = []

        def ended(job: Job, status: str) -> None:
            if status == "fitted" and not killed:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        jobs: Any = jobs_of(organs, tmp_path, READING, OPTIONS)
        fit_cohort(jobs, tmp_path, scheduler=cluster.scheduler_address, progress=ended)
    assert killed
    assert files_of(tmp_path) == files_of(whole)


def test_the_command_says_what_failed(organs: Path, tmp_path: Path) -> None:
    few = tmp_path / "in"
    few.mkdir()
    (few / "c.ply").write_bytes((organs / "c.ply").read_bytes())
    result = CliRunner().invoke(app, ["cohort", str(few), "-o", str(tmp_path / "out"), "--jobs", "1"])
    assert result.exit_code == 1
    assert "c.ply" in result.stderr
    assert "0 of 1" in result.stdout


def test_an_empty_or_missing_folder_is_refused(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError):
            jobs_of(folder, tmp_path / "out")
