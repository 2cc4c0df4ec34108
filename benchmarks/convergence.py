"""How the error falls with the number of stored numbers: each shape at 200, 400, 800, 1,600 and 3,200.

    python benchmarks/convergence.py [--budgets 200 400 800 1600 3200] [--data ../shared/data] [NAME …]

Default: the five livers. Prints the mean and the largest two-sided distance (mm) per budget, and "rises" where a mean
is more than 2 % above the one before it. Returns 1 if one does.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import pairwise
from pathlib import Path

import hhsr

SLACK = 1.02


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["liver_"])
    parser.add_argument("--budgets", type=int, nargs="+", default=[200, 400, 800, 1600, 3200])
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    words = parser.parse_args()
    files = sorted(p for p in words.data.glob("*/*.ply") if any(name in p.stem for name in words.names))
    print("| shape | " + " | ".join(f"{b}: mean, largest, s" for b in words.budgets) + " | |")
    print("|---" * (len(words.budgets) + 2) + "|")
    rose = False
    for file in files:
        surface = hhsr.read_surface(file, frame="LPS")
        means, cells = [], []
        for budget in sorted(words.budgets):
            begun = time.perf_counter()
            shape = hhsr.fit(surface, hhsr.FitOptions(max_parameters=budget))
            assert shape.fit_error is not None
            means.append(shape.fit_error.mean_mm)
            seconds = time.perf_counter() - begun
            cells.append(f"{means[-1]:.4f}, {shape.fit_error.max_mm:.2f}, {seconds:.0f}")
            print(f"{file.stem} {budget}: {cells[-1]}", file=sys.stderr, flush=True)
        rises = any(b > SLACK * a for a, b in pairwise(means))
        rose |= rises
        print(f"| {file.stem} | " + " | ".join(cells) + (" | rises |" if rises else " | |"), flush=True)
    return int(rose)


if __name__ == "__main__":
    sys.exit(main())
