"""This engine and its peers in one process, interleaved, on the same points and segments: rates and ratios.

    python benchmarks/bench_queries.py MESH [--frame LPS] [--max-parameters 989] [--count 20000] [--rounds 5] [--growth]

Ours answers on the fit, the peers (`benchmarks/peers.py`) on the source mesh. Peers that are not installed are left
out, and said so; the extra `bench` has them. A rate is the best of the rounds; every round asks every engine once, so
that a load on the machine falls on all. Rates mean something only side by side in one run. The ratio is to the best
exact peer; a grid of distances is none. With n threads the process keeps to n cores: not every peer can be told.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from peers import INEXACT, PEERS

import hhsr
from hhsr.model import Cut, ModelLeaf, Node, Tree, frozen, leaves
from hhsr.shape import Shape

Query = Callable[[], Any]
PASSES = 3  # over the single calls
ALONE = "ours, one thread"


def cases(shape: Shape, count: int, seed: int = 0) -> dict[str, tuple[np.ndarray, ...]]:
    """Return the points and segments: uniform in the box, within ±2 mm of the surface, long segments."""
    rng = np.random.default_rng(seed)
    low, high = shape.bounds
    uniform = rng.uniform(low, high, (count, 3))
    foot, _ = shape.closest_point(rng.uniform(low, high, (count, 3)))
    way = rng.normal(size=(count, 3))
    way /= np.sqrt((way**2).sum(axis=1))[:, None]
    near = foot + way * rng.uniform(0, 2, (count, 1))
    return {"uniform": (uniform,), "near": (near,), "segments": (uniform, rng.uniform(low, high, (count, 3)))}


def ours(shape: Shape, given: dict[str, tuple[np.ndarray, ...]]) -> dict[str, Query]:
    """Return our queries by name."""
    uniform, near, (starts, ends) = given["uniform"][0], given["near"][0], given["segments"]
    few = len(starts) // 20
    return {
        "contains, uniform": lambda: shape.contains(uniform),
        "contains, ±2 mm": lambda: shape.contains(near),
        "all crossings": lambda: shape.crossings(starts, ends),
        "first crossing": lambda: shape.first_crossing(starts, ends),
        "signed distance, uniform": lambda: shape.signed_distance(uniform[: 4 * few]),
        "signed distance, ±2 mm": lambda: shape.signed_distance(near[: 4 * few]),
        "capsule clearance": lambda: shape.clearance(starts[:few], ends[:few], 1.0),
    }


def on_one_thread(queries: dict[str, Query], threads: int) -> dict[str, Query]:
    """Return the same queries on one thread, asked in the same rounds as on all: phases of the machine fall on both."""

    def alone(query: Query) -> Query:
        def ask() -> Any:
            numba.set_num_threads(1)
            try:
                return query()
            finally:
                numba.set_num_threads(threads)

        return ask

    return {name: alone(query) for name, query in queries.items()}


def sizes(given: dict[str, tuple[np.ndarray, ...]]) -> dict[str, int]:
    """Return how many rows each query answers."""
    n = len(given["uniform"][0])
    return {
        "contains, uniform": n,
        "contains, ±2 mm": n,
        "all crossings": n,
        "first crossing": n,
        "signed distance, uniform": 4 * (n // 20),
        "signed distance, ±2 mm": 4 * (n // 20),
        "capsule clearance": n // 20,
    }


def best_of(engines: dict[str, dict[str, Query]], rounds: int) -> dict[str, dict[str, float]]:
    """Return each engine's least time (s) by query; each round asks every engine once, one after another."""
    least: dict[str, dict[str, float]] = {name: {} for name in engines}
    for turn in range(rounds + 1):
        for query in sorted({q for queries in engines.values() for q in queries}):
            for name, queries in engines.items():
                if query not in queries:
                    continue
                start = time.perf_counter()
                queries[query]()
                spent = time.perf_counter() - start
                if turn > 0:  # the first round warms up
                    least[name][query] = min(least[name].get(query, np.inf), spent)
    return least


@numba.njit(cache=True)
def work(steps: int) -> float:
    """Return the end of a chain of dependent steps: always the same work."""
    x = 1.0
    for _ in range(steps):
        x = x * 1.0000001 + 1e-9
    return x


def single_calls(shape: Shape, given: dict[str, tuple[np.ndarray, ...]], calls: int) -> None:
    """Print the median and the 99.9th percentile of one call from Python, µs, of the middle one of three passes.

    And of the least of the three that each call took: what the machine did meanwhile is not in it. How much that is,
    a row of always the same work shows.
    """
    points, (starts, ends) = given["uniform"][0], given["segments"]
    queries: dict[str, Callable[[int], Any]] = {
        "contains": lambda i: shape.contains(points[i]),
        "crossings": lambda i: shape.crossings(starts[i], ends[i]),
        "first crossing": lambda i: shape.first_crossing(starts[i], ends[i]),
        "signed distance": lambda i: shape.signed_distance(points[i]),
        "capsule clearance": lambda i: shape.clearance(starts[i], ends[i], 1.0),
        "(the same work)": lambda i: work(8_000),
    }
    for name, query in queries.items():
        spent = np.empty((PASSES, calls))
        for i in range(100):
            query(i % len(points))
        for row in spent:
            for i in range(calls):
                start = time.perf_counter()
                query(i % len(points))
                row[i] = time.perf_counter() - start
        raw = np.percentile(spent, [50, 99.9], axis=1) * 1e6
        median, tail = raw[:, np.argsort(raw[1] / raw[0])[PASSES // 2]]
        least, least_tail = np.percentile(spent.min(axis=0), [50, 99.9]) * 1e6
        print(
            f"  one call, {name:18s} median {median:6.1f} µs   p99.9 {tail:7.1f} µs   {tail / median:5.2f}×"
            f"   least of {PASSES}: {least:6.1f} {least_tail:7.1f} µs   {least_tail / least:5.2f}×"
        )


def grown(leaf: ModelLeaf, depth: int, rng: np.random.Generator) -> Node:
    """Return a balanced tree of 2^depth copies of a leaf, moved about: for the cost in leaves."""
    if depth == 0:
        return replace(leaf, centre=frozen(rng.normal(size=3) * 15))
    return Cut(
        frozen([rng.uniform(-3, 3), rng.uniform(-1.5, 1.5)]),
        float(rng.normal() * 10),
        0.0,
        (),
        grown(leaf, depth - 1, rng),
        grown(leaf, depth - 1, rng),
    )


def growth(leaf: ModelLeaf, count: int, rounds: int) -> None:
    """Print how our rates change with the number of leaves and of parameters."""
    for depth in range(7):
        shape = Shape(Tree(grown(leaf, depth, np.random.default_rng(depth)), frozen(np.zeros(6)))).warm_up()
        given = cases(shape, count)
        least = best_of({"ours": ours(shape, given)}, rounds)["ours"]
        rates = "  ".join(f"{q.split(',')[0]} {sizes(given)[q] / t / 1e3:.0f}k/s" for q, t in least.items())
        print(
            f"  {2**depth:3d} leaves, {shape.parameters:6d} parameters, {shape.compiled.nbytes / 1e6:5.1f} MB: {rates}"
        )


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh")
    parser.add_argument("--frame", default="LPS")
    parser.add_argument("--max-parameters", type=int, default=989)
    parser.add_argument("--shape", help="a .hhsr file instead of a new fit")
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    parser.add_argument("--growth", action="store_true")
    arguments = parser.parse_args()
    surface = hhsr.read_surface(arguments.mesh, frame=arguments.frame)
    if arguments.shape:
        shape = hhsr.load(arguments.shape)
    else:
        shape = hhsr.fit(surface, hhsr.FitOptions(max_parameters=arguments.max_parameters))
    shape.warm_up()
    start = time.perf_counter()
    again = Shape(shape.tree)
    compiled = again.compiled
    print(
        f"{shape.parameters} parameters, {shape.bytes} bytes; compiled in {time.perf_counter() - start:.2f} s", end=", "
    )
    print(f"{compiled.nbytes / 1e6:.1f} MB; the mesh has {len(surface.faces)} triangles")
    given = cases(shape, arguments.count)
    cores = os.sched_getaffinity(0)
    for threads in arguments.threads:
        numba.set_num_threads(threads)
        os.sched_setaffinity(0, set(range(threads)) & cores or cores)
        engines = {"ours": ours(shape, given)}
        for name, make in PEERS.items():
            try:
                engines[name] = make(surface.vertices, surface.faces, given, threads)
            except ImportError:
                print(f"  {name} is not installed: left out")
        if threads > 1:  # last: right after the others it would find their rows in the caches
            engines[ALONE] = on_one_thread(engines["ours"], threads)
        least = best_of(engines, arguments.rounds)
        print(f"{threads} thread(s), queries per second:")
        for query, rows in sizes(given).items():
            rates = {name: rows / times[query] for name, times in least.items() if query in times}
            alone = rates.pop(ALONE, None)
            peers = {name: rate for name, rate in rates.items() if name != "ours" and name not in INEXACT}
            best = max(peers, key=lambda name: peers[name], default="")
            ratio = f"{rates['ours'] / peers[best]:.2f}× {best}" if peers else "no peer"
            ratio += f"   {rates['ours'] / alone:.2f}× one thread" if alone else ""
            print(f"  {query:26s} " + "  ".join(f"{n} {r / 1e3:9.1f}k" for n, r in rates.items()) + f"   {ratio}")
    os.sched_setaffinity(0, cores)
    single_calls(shape, given, arguments.calls)
    if arguments.growth:
        found = [node for node in leaves(shape.tree.root) if isinstance(node, ModelLeaf)]
        growth(found[0], arguments.count // 4, 2)


if __name__ == "__main__":
    main()
