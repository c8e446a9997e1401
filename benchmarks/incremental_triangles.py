"""What is saved by forming anew only the triangles near a change.

Run: python benchmarks/incremental_triangles.py

Maps of 100, 1 000 and 10 000 targets on a plane. A frame sees the 20 targets nearest to some place, moves them a little
and adds one. Minimal and frequency triangles learn it as they always do; beside it stands the time that forming
everything anew takes, for frequency triangles from the same counts. Delaunay triangles are always formed anew.
"""

from functools import partial
from time import perf_counter

import numpy as np
from numba import njit
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from trifix.kernels import matching
from trifix.records import ReferenceMap
from trifix.stages.identify import DelaunayTriangles, FrequencyTriangles, IdentifyOptions, MinimalTriangles
from trifix.stages.identify.minimal import minimal_triangles

SIZES = (100, 1_000, 10_000)
SEEN = 20
SPACING_MM = 40.0


def main(sizes: tuple[int, ...] = SIZES, frames: int = 30) -> None:
    matching.warm_up()
    table = Table("targets", "technique", "triangles", "near the change, ms", "all anew, ms", "ratio")
    for n in sizes:
        for technique, near_ms, anew_ms, triangles in measured(n, frames):
            near = "–" if near_ms is None else f"{near_ms:.2f}"
            ratio = "–" if near_ms is None else f"{anew_ms / near_ms:.1f}"
            table.add_row(f"{n}", technique, f"{triangles}", near, f"{anew_ms:.2f}", ratio)
    Console().print(table)


def measured(n: int, frames: int) -> list[tuple[str, float | None, float, int]]:
    """Technique, median milliseconds of learning one frame and of forming all triangles, triangles at the end."""
    rng = np.random.default_rng(1)
    side_mm = SPACING_MM * np.sqrt(n)
    xyz = np.column_stack([rng.uniform(0, side_mm, size=(n, 2)), rng.normal(size=n)])
    map = ReferenceMap.given(xyz)
    options = IdentifyOptions()
    minimal, frequency, delaunay = MinimalTriangles(options), FrequencyTriangles(options), DelaunayTriangles(options)
    minimal.learn(map, np.zeros(0, dtype=np.int64))
    for place in rng.permutation(n)[: max(n // 4, 50)]:  # a past in which every target was seen
        frequency.learn(map, window(map, place))
    all_frequency(frequency)  # compiled before it is timed
    ms: dict[str, list[float]] = {}

    for _ in range(frames):
        place = int(rng.integers(n))
        new = map.xyz_mm[[place]] + rng.normal(scale=SPACING_MM / 2, size=(1, 3)) * [1.0, 1.0, 0.0]
        map = ReferenceMap.given(np.concatenate([map.xyz_mm, new]))
        seen = np.append(window(map, place)[:-1], len(map) - 1)
        map.xyz_mm[seen] += rng.normal(scale=0.02, size=(len(seen), 3))
        for name, work in {
            "minimal": partial(minimal.learn, map, seen),
            "minimal anew": partial(all_minimal, map),
            "frequency": partial(frequency.learn, map, seen),
            "frequency anew": partial(all_frequency, frequency),
            "delaunay anew": partial(delaunay.learn, map, seen),
        }.items():
            start = perf_counter()
            work()
            ms.setdefault(name, []).append(1e3 * (perf_counter() - start))
    median = {name: float(np.median(values)) for name, values in ms.items()}
    return [
        ("minimal", median["minimal"], median["minimal anew"], minimal.size),
        ("frequency", median["frequency"], median["frequency anew"], frequency.size),
        ("delaunay", None, median["delaunay anew"], delaunay.size),
    ]


def window(map: ReferenceMap, place: int) -> np.ndarray:
    distance = np.linalg.norm(map.xyz_mm - map.xyz_mm[place], axis=1)
    return np.argsort(distance, kind="stable")[:SEEN]


def all_minimal(map: ReferenceMap) -> np.ndarray:
    _, nearest = cKDTree(map.xyz_mm).query(map.xyz_mm, k=4)
    return distinct(minimal_triangles(nearest[:, 1:], np.arange(len(map))).reshape(-1, 3))


def all_frequency(technique: FrequencyTriangles) -> np.ndarray:
    best = np.full((len(technique._id), 3), -1)
    rank_all(technique._id, *technique._edges(), best)
    p = np.arange(len(best))
    a, b, c = best.T
    return distinct(np.concatenate([np.stack(t, axis=1) for t in ((p, a, b), (p, a, c), (p, b, c))]))


@njit
def rank_all(id, head, other, count, distance, following, best):
    for p in range(len(head)):
        matching._rank_partners(p, id, head, other, count, distance, following, best)


def distinct(triangles: np.ndarray) -> np.ndarray:
    ascending = np.sort(triangles[(triangles >= 0).all(axis=1)], axis=1)
    k = int(ascending.max(initial=0)) + 1
    key = np.unique((ascending[:, 0] * k + ascending[:, 1]) * k + ascending[:, 2])
    return np.stack([key // k**2, key // k % k, key % k], axis=1)


if __name__ == "__main__":
    main()
