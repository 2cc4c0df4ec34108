"""Thirty-five organs as a cohort: undisturbed, killed half way and taken up again, and on Dask with a dead worker.

    python benchmarks/cohort_killed.py [--max-parameters 60] [--jobs 2] [--data ../shared/data] [--only N]

Prints per run how many organs were fitted and kept, and whether its files are those of the undisturbed run, byte for
byte (the table's seconds apart). Returns 1 where they are not, or where something finished was fitted again.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hhsr.cohort import Job, fit_cohort, jobs_of

READING = {"frame": "LPS"}


def files_of(folder: Path) -> dict[str, bytes]:
    """Return every file of a run by its name, the table without its seconds."""
    found = {p.name: p.read_bytes() for p in folder.iterdir()}
    with (folder / "cohort.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]
    return found | {"cohort.csv": repr(rows).encode()}


def run(organs: Path, out: Path, options: dict[str, Any], **others: Any) -> Counter[str]:
    """Fit what is missing; return how many were fitted, kept, failed."""
    said: Counter[str] = Counter()
    watch: Callable[[Job, str], None] = others.pop("watch", lambda job, status: None)

    def ended(job: Job, status: str) -> None:
        said[status] += 1
        watch(job, status)

    fit_cohort(jobs_of(organs, out, READING, options), out, progress=ended, **others)
    return said


def killed(organs: Path, out: Path, options: dict[str, Any], jobs: int, after: int) -> int:
    """Run in a process of its own and kill it with SIGKILL once `after` organs are done; return how many are."""
    program = f"""
from pathlib import Path
from hhsr.cohort import fit_cohort, jobs_of
if __name__ == "__main__":
    out = Path({str(out)!r})
    fit_cohort(jobs_of(Path({str(organs)!r}), out, {READING!r}, {options!r}), out, workers={jobs})
"""
    script = organs.parent / "killed.py"
    script.write_text(program)
    process = subprocess.Popen([sys.executable, str(script)])
    while process.poll() is None and len(list(out.glob("*.hhsr"))) < after:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return len(list(out.glob("*.hhsr")))


def on_dask(organs: Path, out: Path, options: dict[str, Any], jobs: int) -> Counter[str]:
    """Run on a local Dask cluster, one worker of which is killed with SIGKILL after the first organ."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None) as cluster:  # type: ignore[no-untyped-call]
        dead: list[int] = []

        def watch(job: Job, status: str) -> None:
            if status == "fitted" and not dead:
                dead.append(next(iter(cluster.workers.values())).pid)
                os.kill(dead[0], signal.SIGKILL)

        return run(organs, out, options, scheduler=cluster.scheduler_address, watch=watch)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--max-parameters", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, default=None, help="the first N organs")
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    words = parser.parse_args()
    options = {"max_parameters": words.max_parameters, "samples": 2000}
    sources = [*sorted(words.data.glob("prostate/prostate_*.ply")), *sorted(words.data.glob("liver/*.ply"))]
    with tempfile.TemporaryDirectory() as folder:
        organs, whole, again, cluster = (Path(folder, name) for name in ("organs", "whole", "again", "dask"))
        for place in (organs, again):
            place.mkdir()
        for source in sources[: words.only]:
            shutil.copy(source, organs)
        print("undisturbed:", dict(run(organs, whole, options, workers=words.jobs)), flush=True)
        right = files_of(whole)
        done = killed(organs, again, options, words.jobs, len(list(organs.iterdir())) // 2)
        times = {p: p.stat().st_mtime_ns for p in again.glob("*.hhsr")}
        said = run(organs, again, options, workers=words.jobs)
        kept = all(p.stat().st_mtime_ns == t for p, t in times.items()) and said["kept"] == done

        same = [files_of(again) == right]
        print(f"killed with {done} done, taken up again: {dict(said)}, same files: {same[0]}, nothing twice: {kept}")
        said = on_dask(organs, cluster, options, words.jobs)
        same.append(files_of(cluster) == right)
        print(f"Dask, one worker killed: {dict(said)}, same files: {same[1]}", flush=True)
    return 0 if all(same) and kept else 1


if __name__ == "__main__":
    sys.exit(main())
