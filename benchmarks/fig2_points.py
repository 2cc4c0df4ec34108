"""Fig. 2 of the paper: what the number of points (925 down to 125) does to a superquadric's numbers and error.

    python benchmarks/fig2_points.py [MESH …]      default: the first five prostates

Printed per organ and count: six half axes (mm), the exponents' mean, and the rms radial miss on 4,000 other points.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from hhsr.evaluate import leaf_radius
from hhsr.fitting.normalise import normalise
from hhsr.fitting.samples import area_samples
from hhsr.fitting.superquadric import Start, fit_superquadric
from hhsr.model import ModelLeaf, ScaleField, exponent_of_logit, frozen, rotation_matrix
from hhsr.read import read_surface

COUNTS = (925, 725, 525, 325, 225, 125)
HELD_OUT = 4000


def line_of(path: Path, count: int) -> str:
    """Return one row of the table: a superquadric of `count` points of an organ."""
    surface = read_surface(path, frame="LPS")
    vertices, _ = normalise(surface.vertices, surface.faces)
    points = area_samples(vertices, surface.faces, count, seed=0).points
    found = fit_superquadric(points, Start(np.zeros(3), np.zeros(3)))
    base = found.superquadric
    leaf = ModelLeaf(frozen(found.centre), frozen(found.rotation), base, ScaleField.none())
    others = area_samples(vertices, surface.faces, HELD_OUT, seed=1).points
    rays = (others - found.centre) @ rotation_matrix(found.rotation)
    miss = np.linalg.norm(rays, axis=1) - leaf_radius(leaf, rays)
    exponents = [
        float(exponent_of_logit(logits).mean()) if logits.size else 1.0
        for logits in (base.elevation_logits, base.azimuth_logits)
    ]
    axes = " ".join(f"{axis:6.2f}" for axis in base.half_axes)
    return (
        f"| {path.stem} | {count} | {axes} | {exponents[0]:.2f} {exponents[1]:.2f} | {np.sqrt((miss**2).mean()):.3f} |"
    )


def main() -> int:
    """Run the benchmark."""
    data = Path(__file__).resolve().parents[2] / "shared" / "data" / "prostate"
    files = [Path(word) for word in sys.argv[1:]] or sorted(data.glob("prostate_*.ply"))[:5]
    if not files:
        print(f"no meshes below {data}; name some", file=sys.stderr)
        return 2
    print("| organ | points | half axes a+ a- b+ b- c+ c-, mm | mean ε1, ε2 | rms miss, mm |\n|---|---|---|---|---|")
    for file in files:
        for count in COUNTS:
            print(line_of(file, count), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
