"""The command line: `hhsr fit | info | mesh | verify | query | compare | cohort | warm-up`.

Exit codes: 0 done, 1 not verified or some of a cohort failed, 2 bad input.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from hhsr.model import ErrorFigures
    from hhsr.shape import Shape

app = typer.Typer(
    help="Fit, store and query compact organ shapes (HHSR). LPS, millimetres.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_NOT_ALL, _BAD_INPUT = 1, 2
# A second measurement by other samples differs from the first by about a per cent of a mean error.
_SAME_SHARE, _SAME_MM = 0.05, 0.005

ShapeArgument = Annotated[Path, typer.Argument(metavar="FILE", help="A .hhsr file.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="File to write.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")]
SourceArgument = Annotated[Path, typer.Argument(metavar="INPUT", help="A mesh, a point cloud, or a label map.")]
_FRAME = "Where a mesh's +x, +y, +z point: LPS, RAS, LSA, … Without: as the file says, else LPS."
FrameOption = Annotated[str | None, typer.Option("--frame", help=_FRAME)]
LabelOption = Annotated[int | None, typer.Option("--label", help="Of a label map; needed where it has several.")]
UnitOption = Annotated[str | None, typer.Option("--unit", help="Of a mesh's numbers: mm, cm, m, um or in.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Take any size as meant.")]
BudgetOption = Annotated[int | None, typer.Option("--max-parameters", help="Most numbers that may be stored.")]
MeanOption = Annotated[float | None, typer.Option("--max-mean-error", help="Spend until the mean is below, mm.")]
MaxOption = Annotated[float | None, typer.Option("--max-error", help="Spend until the maximum is below, mm.")]
_WEIGHT = "What the largest miss counts beside the mean, 0 … 1; 0.1 lowers maxima and costs some of the mean."
WeightOption = Annotated[float, typer.Option("--max-error-weight", help=_WEIGHT)]
_BASES = "What leaves may buy: ellipsoid; turned: axes of their own; any: exponents and knots too (slower queries)."
BasesOption = Annotated[str, typer.Option("--bases", help=_BASES)]
RecipeOption = Annotated[str, typer.Option("--recipe", help="default; or paper: the published algorithm as it stands.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of everything random; the same seed, the same file.")]
RowsArgument = Annotated[Path, typer.Argument(metavar="INPUT", help="CSV: x,y,z or x0,y0,z0,x1,y1,z1; or .npy.")]


class Question(StrEnum):
    """What `hhsr query` can ask."""

    contains = "contains"
    distance = "distance"
    crossings = "crossings"


@app.command()
def fit(
    source: SourceArgument,
    out: OutOption,
    label: LabelOption = None,
    frame: FrameOption = None,
    unit: UnitOption = None,
    max_parameters: BudgetOption = None,
    max_mean_error: MeanOption = None,
    max_error: MaxOption = None,
    max_error_weight: WeightOption = 0.01,
    bases: BasesOption = "ellipsoid",
    recipe: RecipeOption = "default",
    seed: SeedOption = 0,
    retain: Annotated[bool, typer.Option("--retain", help="Keep the mesh whole (a vessel tree).")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit a shape to an organ's surface and write it as a .hhsr file."""
    from hhsr.fitting import FitOptions, fit
    from hhsr.read import read_surface

    begun = time.perf_counter()
    with _bad_input_ends():
        _require_folder(out)
        options = FitOptions(
            max_parameters=max_parameters,
            max_mean_error_mm=max_mean_error,
            max_error_mm=max_error,
            max_error_weight=max_error_weight,
            bases=bases,  # type: ignore[arg-type]  # checked by the record
            recipe=recipe,  # type: ignore[arg-type]  # checked by the record
            seed=seed,
            retain=retain,
        )
        with _busy(f"fitting {source.name}"):
            surface = read_surface(source, frame=frame, label=label, unit=unit, force=force)
            shape = fit(surface, options)
            shape.save(out)
        figures = _figures(shape) | {"source": surface.quality.to_json(), "out": str(out)}
    for words in (*surface.quality.repairs, *surface.quality.warnings):
        _say(words)
    _print(f"{source.name} → {out}", figures | {"seconds": time.perf_counter() - begun}, as_json)


@app.command()
def info(file: ShapeArgument, as_json: JsonOption = False) -> None:
    """Say what a .hhsr file holds, where it comes from, and how well it fits."""
    begun = time.perf_counter()
    with _bad_input_ends():
        figures = _figures(_load(file))
    _print(str(file), figures | {"seconds": time.perf_counter() - begun}, as_json)


@app.command()
def mesh(
    file: ShapeArgument,
    out: OutOption,
    tolerance: Annotated[float, typer.Option("--tolerance", help="Most that facets may leave the surface, mm.")] = 0.02,
) -> None:
    """Write a shape's surface as a closed mesh (.ply, .stl, .obj) in LPS mm."""
    from hhsr.io.mesh_writer import write_mesh

    with _bad_input_ends():
        _require_folder(out)
        shape = _load(file)
        with _busy(f"meshing {file.name}"):
            surface = shape.mesh(tolerance_mm=tolerance)
        write_mesh(out, surface.vertices, surface.faces)
    Console(highlight=False).print(f"{out}: {len(surface.vertices)} vertices, {len(surface.faces)} triangles, LPS mm")


@app.command()
def verify(
    file: ShapeArgument,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="What the shape was fitted to.")],
    label: LabelOption = None,
    frame: FrameOption = None,
    unit: UnitOption = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the samples; not the fit's own.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Measure a shape's error against its source again: two-sided true distances. Exit code 1 if the file says less."""
    from hhsr.fitting.report import measure
    from hhsr.read import read_surface
    from hhsr.read.label_map import LABEL_SUFFIXES

    begun = time.perf_counter()
    with _bad_input_ends():
        shape = _load(file)
        stored = shape.provenance
        voxels = source.name.lower().endswith(LABEL_SUFFIXES)
        surface = read_surface(
            source,
            frame=frame or (None if voxels else stored.frame),
            label=label if label is not None or not voxels else stored.label,
            unit=unit,
            force=True,
        )
        with _busy(f"measuring {file.name} against {source.name}"):
            measured = measure(shape, surface.vertices, surface.faces, seed=seed)[0]
    same_source = surface.source_hash == stored.source_hash
    verified = stored.fit_error is not None and _not_worse(measured, stored.fit_error)
    figures = _error_words(measured) | {
        "stored_mean_error_mm": stored.fit_error.mean_mm if stored.fit_error else None,
        "same_source": same_source,
        "verified": verified,
        "seconds": time.perf_counter() - begun,
    }
    if not same_source:
        _say(f"{source.name} is not the file that the shape was fitted to (its SHA-256 differs)")
    _print(f"{file} against {source.name}", figures, as_json)
    if not verified:
        raise typer.Exit(_NOT_ALL)


@app.command()
def query(
    file: ShapeArgument,
    question: Annotated[Question, typer.Argument()],
    source: RowsArgument,
    out: OutOption,
) -> None:
    """Ask a shape about points or segments in LPS mm: inside, signed distance (< 0 inside), or where segments cross."""
    from hhsr.tables import read_rows, write_columns

    asks_segments = question is Question.crossings
    with _bad_input_ends():
        _require_folder(out)
        rows = read_rows(source, 6 if asks_segments else 3)
        shape = _load(file)
        if asks_segments:
            found = shape.crossings(rows[:, :3], rows[:, 3:])
            segment = np.repeat(np.arange(len(rows)), np.diff(found.offsets))
            x, y, z = found.points.reshape(-1, 3).T
            write_columns(out, {"segment": segment, "t": found.t, "x": x, "y": y, "z": z, "entering": found.entering})
        elif question is Question.contains:
            write_columns(out, {"inside": shape.contains(rows)})
        else:
            write_columns(out, {"distance_mm": shape.signed_distance(rows)})
    asked = "segments" if asks_segments else "points"
    Console(highlight=False).print(f"{out}: {question.value} of {len(rows)} {asked}")


@app.command("warm-up")
def warm() -> None:
    """Compile the queries for this machine and keep them: some minutes once, so that no later program waits."""
    from hhsr.warm import warm_up

    begun = time.perf_counter()
    with _busy("compiling the queries"):
        warm_up()
    Console(highlight=False).print(f"queries are compiled ({time.perf_counter() - begun:.0f} s)")


@app.command()
def compare(
    source: SourceArgument,
    max_parameters: Annotated[int, typer.Option("--max-parameters", help="The largest of three budgets.")] = 989,
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write (.png).")] = Path("compare.png"),
    label: LabelOption = None,
    frame: FrameOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit by HHSR and by its comparators, at a quarter, half and all of a budget; print and draw the errors."""
    from hhsr.baselines.compare import compare, draw
    from hhsr.read import read_surface

    with _bad_input_ends():
        _require_folder(out)
        surface = read_surface(source, frame=frame, label=label)
        with Console(stderr=True).status("comparing") as status:
            budgets = (max_parameters // 4, max_parameters // 2, max_parameters)
            rows = compare(surface, budgets, progress=lambda method, n: status.update(f"{method}, {n} parameters"))
        draw(rows, out, source.name)
    if as_json:
        typer.echo(json.dumps([row._asdict() for row in rows]))
        return
    table = Table("method", "parameters", "bytes", "mean mm", "p95 mm", "max mm", "seconds", title=escape(source.name))
    for row in rows:
        errors = (f"{value:.3f}" for value in (row.mean_mm, row.p95_mm, row.max_mm))
        table.add_row(row.method, str(row.parameters), str(row.bytes), *errors, f"{row.seconds:.1f}")
    Console(highlight=False).print(table)
    _say(f"picture: {out}")


@app.command()
def cohort(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Meshes and label maps, in folders below too.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files and cohort.csv.")],
    max_parameters: BudgetOption = None,
    recipe: RecipeOption = "default",
    seed: SeedOption = 0,
    label: LabelOption = None,
    frame: FrameOption = None,
    force: ForceOption = False,
    workers: Annotated[int | None, typer.Option("--jobs", min=1, help="Processes; without: one a core.")] = None,
    scheduler: Annotated[str | None, typer.Option("--scheduler", help="Address of a Dask scheduler, tcp://….")] = None,
) -> None:
    """Fit every organ in a folder; killed and started again, it goes on where it was. Exit code 1 if some failed."""
    from rich.progress import Progress

    from hhsr.cohort import Job, fit_cohort, jobs_of
    from hhsr.fitting import FitOptions

    with _bad_input_ends():
        options = FitOptions(max_parameters=max_parameters, recipe=recipe, seed=seed)  # type: ignore[arg-type]
        reading = {"label": label, "frame": frame, "force": force}
        jobs = jobs_of(folder, out, {k: v for k, v in reading.items() if v}, options.to_json())
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("fitting", total=len(jobs))

            def ended(job: Job, status: str) -> None:
                bar.update(task, advance=1, description=f"{job.source.name}: {status}")

            rows = fit_cohort(jobs, out, workers, scheduler, ended)
    failed = [row for row in rows if row["status"] == "failed"]
    for row in failed:
        _say(f"{row['source']}: {row['message']}")
    Console(highlight=False).print(f"{out}: {len(rows) - len(failed)} of {len(rows)} fitted, figures in cohort.csv")
    if failed:
        raise typer.Exit(_NOT_ALL)


def _load(file: Path) -> Shape:
    from hhsr.shape import load

    return load(file)


def _figures(shape: Shape) -> dict[str, Any]:
    """Return what `--json` prints of a shape."""
    from hhsr.model import RetainedPart, depth, leaves

    parts = list(leaves(shape.tree.root))
    stored = shape.provenance
    return {
        "parameters": shape.parameters,
        "bytes": shape.bytes,
        "leaves": len(parts),
        "retained": sum(isinstance(part, RetainedPart) for part in parts),
        "depth": depth(shape.tree.root),
        **_error_words(stored.fit_error),
        "volume_ml": _volume_ml(shape),
        "frame": stored.frame,
        "label": stored.label,
        "source_hash": stored.source_hash,
        "options": dict(stored.options),
        "software": stored.software,
        "report": dict(stored.report),
    }


def _volume_ml(shape: Shape) -> float:
    """Return the solid's volume as the fit measured it, else of its mesh."""
    measured = shape.provenance.report.get("topology", {}).get("volume_ml")
    return float(measured[1]) if measured else float(shape.mesh(tolerance_mm=0.1).volume) / 1000.0


def _error_words(figures: ErrorFigures | None) -> dict[str, float | None]:
    names = ("mean_error_mm", "p95_error_mm", "max_error_mm")
    return dict(zip(names, figures if figures is not None else (None, None, None), strict=True))


def _not_worse(measured: ErrorFigures, stored: ErrorFigures) -> bool:
    return measured.mean_mm <= stored.mean_mm * (1 + _SAME_SHARE) + _SAME_MM


def _print(title: str, figures: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(figures))
        return
    table = Table(title=escape(title), title_justify="left", show_header=False)
    for name, value in figures.items():
        if isinstance(value, dict | list) or value is None:
            continue
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else escape(str(value)))
    Console(highlight=False).print(table)


def _say(words: str) -> None:
    """Say something on the error stream that is no error."""
    Console(stderr=True, highlight=False).print(f"note: {escape(words)}", soft_wrap=True)


@contextmanager
def _busy(words: str) -> Iterator[None]:
    with Console(stderr=True).status(escape(words)):
        yield


def _require_folder(out: Path) -> None:
    """Refuse before the work what could not be written after it."""
    from hhsr.errors import InputError

    if not out.parent.is_dir():
        raise InputError(f"--out: the folder {out.parent} does not exist")


@contextmanager
def _bad_input_ends() -> Iterator[None]:
    """Turn what the user can mend into one line on the error stream and exit code 2."""
    from hhsr.errors import HhsrError

    try:
        yield
    except (HhsrError, OSError) as error:
        words = " ".join(str(error).split())
        Console(stderr=True, highlight=False).print(f"[red]error:[/] {escape(words)}", soft_wrap=True)
        raise typer.Exit(_BAD_INPUT) from None
