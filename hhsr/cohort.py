"""Many organs: fitted by processes on one machine or by a Dask cluster, resumable, no bad input stopping the rest.

What is finished is what lies in the output folder as a whole file whose source's hash and options are the asked ones. A
file is written beside its place and moved there, so being killed leaves whole files only, and the next run fits what is
missing. Workers send bytes; only this process writes. Figures come out of the files, so a run that was killed and taken
up again ends with the same files and the same table, but for the seconds.
"""

from __future__ import annotations

import csv
import hashlib
import multiprocessing
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from hhsr.errors import FileFormatError, HhsrError, InputError

SUFFIXES = (".stl", ".ply", ".obj", ".nii", ".nii.gz")
TABLE = "cohort.csv"
_ATTEMPTS = 2
_COLUMNS = (
    "source",
    "status",
    "parameters",
    "bytes",
    "leaves",
    "retained",
    "mean_error_mm",
    "p95_error_mm",
    "max_error_mm",
    "seconds",
    "message",
)


@dataclass(frozen=True)
class Job:
    """One organ to fit: source file, .hhsr file to write, how to read and how to fit it (arguments by name)."""

    source: Path
    target: Path
    reading: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)


class Outcome(NamedTuple):
    """What a worker sends back: the file's bytes, or in words why there are none; seconds of work."""

    content: bytes | None
    message: str
    seconds: float


def jobs_of(
    folder: Path, out: Path, reading: Mapping[str, Any] | None = None, options: Mapping[str, Any] | None = None
) -> list[Job]:
    """Return a job for every mesh and label map below a folder, in order of their paths; the same tree below `out`."""
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of meshes and label maps")
    sources = sorted(p for p in folder.rglob("*") if p.is_file() and p.name.lower().endswith(SUFFIXES))
    sources = [source for source in sources if out.resolve() not in source.resolve().parents]
    if not sources:
        raise InputError(f"{folder}: no file that ends in {', '.join(SUFFIXES)}")
    stems = [_stem(source.relative_to(folder)) for source in sources]
    jobs = []
    for source, stem in zip(sources, stems, strict=True):
        name = stem if stems.count(stem) == 1 else source.relative_to(folder)
        jobs.append(Job(source, out / f"{name}.hhsr", dict(reading or {}), dict(options or {})))
    return jobs


def _stem(path: Path) -> Path:
    suffix = max((s for s in SUFFIXES if path.name.lower().endswith(s)), key=len)
    return path.with_name(path.name[: -len(suffix)])


def fit_cohort(
    jobs: Sequence[Job],
    out: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[Job, str], None] = lambda job, status: None,
) -> list[dict[str, Any]]:
    """Fit what is not finished yet, write `out`/cohort.csv, and return its rows.

    Parameters
    ----------
    workers : processes on this machine; None: one a core.
    scheduler : address of a Dask scheduler ("tcp://…") instead; its workers must see the sources under the same paths.
    progress : called with each job and "kept", "fitted" or "failed", in the order in which they end.
    """
    seconds: dict[Path, float] = {}
    messages: dict[Path, str] = {}
    missing = []
    for job in jobs:
        if _is_finished(job):
            progress(job, "kept")
        else:
            missing.append(job)
    run = _on_dask(missing, scheduler) if scheduler else _on_processes(missing, workers or os.cpu_count() or 1)
    for job, outcome in run:
        seconds[job.source] = outcome.seconds
        if outcome.content is not None:
            _write_whole(job.target, outcome.content)
        else:
            messages[job.source] = outcome.message
        progress(job, "fitted" if outcome.content is not None else "failed")
    rows = [_row(job, seconds.get(job.source), messages.get(job.source)) for job in jobs]
    _write_whole(out / TABLE, _table(rows))
    return rows


def fit_one(source: str, reading: Mapping[str, Any], options: Mapping[str, Any]) -> Outcome:
    """Fit one organ; whatever goes wrong comes back in words. Runs in a worker."""
    begun = time.perf_counter()
    try:
        from hhsr.fitting import FitOptions, fit
        from hhsr.read import read_surface

        shape = fit(read_surface(source, **reading), FitOptions(**options))
        return Outcome(shape.encoded, "", time.perf_counter() - begun)
    except Exception as error:  # one bad input must not stop the rest, whatever it does
        kind = "" if isinstance(error, HhsrError) else f"{type(error).__name__}: "
        return Outcome(None, kind + " ".join(str(error).split()), time.perf_counter() - begun)


def _is_finished(job: Job) -> bool:
    """Return whether the target is a whole file of this very source, read and fitted in this very way."""
    from hhsr.fitting import FitOptions
    from hhsr.io import decode

    try:
        stored = decode(job.target.read_bytes())[1]
    except (OSError, FileFormatError):
        return False
    frame, label = job.reading.get("frame"), job.reading.get("label")
    return (
        stored.source_hash == hashlib.sha256(job.source.read_bytes()).hexdigest()
        and dict(stored.options) == dict(FitOptions(**job.options).to_json())
        and (frame is None or stored.frame == str(frame).upper())
        and (label is None or stored.label == label)
    )


def _write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def _on_processes(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Outcome]]:
    """Yield outcomes as they end. Each thread owns one process, so that one that dies takes one organ with it."""
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    ended: queue.SimpleQueue[tuple[Job, Outcome]] = queue.SimpleQueue()
    for job in jobs:
        waiting.put(job)
    stop = threading.Event()

    def work() -> None:
        pool = _one_process()
        try:
            while not stop.is_set():
                job = waiting.get_nowait()
                for attempt in range(_ATTEMPTS):
                    try:
                        outcome = pool.submit(fit_one, str(job.source), job.reading, job.options).result()
                        break
                    except BrokenProcessPool:
                        pool.shutdown(wait=False)
                        pool = _one_process()
                        outcome = Outcome(None, f"the worker died {attempt + 1} times (out of memory?)", 0.0)
                ended.put((job, outcome))
        except queue.Empty:
            return
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    threads = [threading.Thread(target=work, daemon=True) for _ in range(min(workers, len(jobs)))]
    for thread in threads:
        thread.start()
    try:
        for _ in jobs:
            yield ended.get()
    finally:
        stop.set()
    for thread in threads:
        thread.join()


def _one_process() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_begin_worker)


def _begin_worker() -> None:
    """Keep a worker's libraries to one thread, as the processes share the cores; and end with the process that asks.

    Without that a worker would wait for ever for a parent that was killed: it holds both ends of the queue itself.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _on_dask(jobs: Sequence[Job], scheduler: str) -> Iterator[tuple[Job, Outcome]]:
    """Yield outcomes as they end; a task whose worker dies is given to another by the scheduler."""
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'hhsr-guidance[cluster]'") from error
    with Client(scheduler) as client:  # type: ignore[no-untyped-call]
        futures = {client.submit(fit_one, str(j.source), j.reading, j.options, pure=False, retries=2): j for j in jobs}
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            try:
                outcome = Outcome(*future.result())
            except Exception as error:  # the scheduler gave up on the task: its worker died again and again
                outcome = Outcome(None, f"{type(error).__name__}: {error}", 0.0)
            yield futures[future], outcome


def _row(job: Job, seconds: float | None, message: str | None) -> dict[str, Any]:
    """Return a job's line of the table: figures out of its file."""
    from hhsr.io import decode
    from hhsr.model import RetainedPart, leaves

    row: dict[str, Any] = dict.fromkeys(_COLUMNS, "")
    row |= {"source": job.source.name, "status": "failed", "message": message or ""}
    if seconds is not None:
        row["seconds"] = round(seconds, 3)
    if message is not None:
        return row
    content = job.target.read_bytes()
    tree, stored = decode(content)
    parts = list(leaves(tree.root))
    row |= {
        "status": "fitted",
        "parameters": tree.parameters,
        "bytes": len(content),
        "leaves": len(parts),
        "retained": sum(isinstance(part, RetainedPart) for part in parts),
    }
    if stored.fit_error is not None:
        row |= zip(("mean_error_mm", "p95_error_mm", "max_error_mm"), map(repr, stored.fit_error), strict=True)
    return row


def _table(rows: Sequence[Mapping[str, Any]]) -> bytes:
    from io import StringIO

    text = StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
