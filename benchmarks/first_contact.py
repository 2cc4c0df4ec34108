"""Is the true first contact where the warning said? A scene's wrong insertion, simulated with many seeds.

    python benchmarks/first_contact.py SCENE.toml … [--seeds 20]

The truth is the first instant at which the noise-free capsule touches the fitted shape; the statement is the interval
of the report that raised APPROACHING. Prints how often it held, how long before, how wide; exits 1 below 19 of 20.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

import guidance
from guidance.simulation import Insertion, Rig, simulate, wrong_path


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    failed = False
    for path in args.scenes:
        scene = guidance.Scene.load(path)
        best = guidance.plan(scene).best
        wrong = None if best is None else wrong_path(scene, best.trajectory)
        if wrong is None:
            print(f"{path}: no path to go wrong on")
            continue
        insertion = Insertion(wrong[0], Rig.usual(scene.needle))
        told = [simulate(scene, insertion, seed=seed).warning(wrong[1]) for seed in range(args.seeds)]
        held = sum(w.holds for w in told)
        early = np.array([w.truth_s - w.raised_s for w in told])
        width = np.array([w.stated[1] - w.stated[0] for w in told])
        failed |= held < 0.95 * args.seeds
        print(
            f"{path}: wrong insertion into {wrong[1]}: held in {held} of {args.seeds}, warned {early.min():.1f} to "
            f"{early.max():.1f} s before, interval {np.median(width):.2f} s wide (widest {width.max():.2f})"
        )
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
