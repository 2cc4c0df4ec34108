"""Table 1 of the paper on real organs: mean error (mean ± sd over shapes, mm) against stored numbers, by every method.

    python benchmarks/table1.py [--data ../shared/data] [--kind prostate|liver|all] [--only N] [--jobs 2] [METHOD …]

The published counts (spherical harmonics 1089 and 4225, RBF 1536 and 4952) stand beside equal counts for all.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from hhsr.baselines import METHODS
from hhsr.baselines.compare import RECIPES, Row, compare
from hhsr.errors import HhsrError
from hhsr.read import read_surface

BUDGETS = {"prostate": 320, "liver": 989}
PUBLISHED = {
    "prostate": {"spherical_harmonics": 1089 + 3, "rbf_isosurface": 1536},
    "liver": {"spherical_harmonics": 4225 + 3, "rbf_isosurface": 4952},
}
FRAMES = {"prostate": "RAS", "hubmap": "LSA"}


def rows_of(path: Path, kind: str, methods: Sequence[str]) -> list[Row]:
    """Return the rows of one organ: the methods at the equal budget; without any, all, and two at published counts."""
    frame = next((frame for word, frame in FRAMES.items() if word in path.name), "LPS")
    surface = read_surface(path, frame=frame)
    rows = compare(surface, [BUDGETS[kind]], methods or (*RECIPES, *METHODS))
    for method, budget in PUBLISHED[kind].items() if not methods else ():
        rows += compare(surface, [budget], [method])
    return rows


def safe_rows_of(job: tuple[Path, str, Sequence[str]]) -> tuple[str, list[Row], str]:
    """Return an organ's name, its rows, and what went wrong."""
    try:
        return job[0].stem, rows_of(*job), ""
    except HhsrError as error:
        return job[0].stem, [], str(error)


def print_shapes(found: Sequence[tuple[str, list[Row]]]) -> None:
    """Print mean and largest error (mm) of every organ by every method."""
    columns = list(dict.fromkeys((row.method, row.budget) for _, rows in found for row in rows))
    print("\n| organ | " + " | ".join(f"{method} {budget}" for method, budget in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for name, rows in found:
        known = {(row.method, row.budget): f"{row.mean_mm:.3f}, {row.max_mm:.2f}" for row in rows}
        print(f"| {name} | " + " | ".join(known.get(column, "–") for column in columns) + " |")


def print_table(kind: str, rows: Sequence[Row]) -> None:
    """Print mean ± sd of each method and budget, and the range of stored numbers."""
    print(f"\n| {kind} | numbers | bytes | mean error, mm | worst | largest error, median | seconds |")
    print("|---|---|---|---|---|---|---|")
    for method, budget in dict.fromkeys((row.method, row.budget) for row in rows):
        own = [row for row in rows if (row.method, row.budget) == (method, budget)]
        means = np.array([row.mean_mm for row in own])
        numbers = sorted({row.parameters for row in own})
        span = str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]}–{numbers[-1]}"
        size, far, time = (np.median([getattr(row, name) for row in own]) for name in ("bytes", "max_mm", "seconds"))
        print(
            f"| {method} ({len(own)}) | {span} | {size:.0f} | {means.mean():.3f} ± {means.std():.3f} "
            f"| {means.max():.3f} | {far:.2f} | {time:.1f} |"
        )


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--kind", choices=("prostate", "liver", "all"), default="all")
    parser.add_argument("--only", type=int, default=None, help="the first N organs of each kind")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("methods", nargs="*", choices=[*RECIPES, *METHODS, []], metavar="METHOD")
    words = parser.parse_args()
    for kind in ("prostate", "liver") if words.kind == "all" else (words.kind,):
        files = sorted((words.data / kind).glob(f"{kind}_*.ply"))[: words.only]
        if not files:
            print(f"no {kind} meshes below {words.data}", file=sys.stderr)
            return 2
        rows: list[Row] = []
        shapes: list[tuple[str, list[Row]]] = []
        with ProcessPoolExecutor(words.jobs, get_context("spawn")) as pool:
            for name, found, problem in pool.map(safe_rows_of, [(file, kind, words.methods) for file in files]):
                print(
                    f"{name}: " + (problem or ", ".join(f"{r.method} {r.mean_mm:.3f}" for r in found)), file=sys.stderr
                )
                rows += found
                shapes.append((name, found))
        print_shapes(shapes)
        print_table(kind, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
