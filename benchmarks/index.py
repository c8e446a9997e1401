"""What the map's index costs, and what a look-up does.

Run: python benchmarks/index.py

Targets lie at random on a sheet, a spacing of 40 mm whatever their number. Memory is right after the first build; one
row is said to have changed when one changes. A frame sees 20 targets in the middle of the map and 5 strays; times of
its look-ups are a triangle's share of all the frame's triangles (all) and of the 12 most promising (first), of a search
among any three targets without the table of pairs, which comes once a version (table).
"""

from collections.abc import Callable
from time import process_time

import numpy as np
from rich.console import Console
from rich.table import Table

from trifix.geometry.pose import Pose
from trifix.index import MapIndex, frame_triangles
from trifix.kernels import index as kernels
from trifix.records import ReferenceMap, SensorPoints, TargetState

SIZES = (30, 118, 1_000, 10_000, 100_000, 1_000_000)
SPACING_MM = 40.0
ANY_UP_TO = 10_000  # targets; beyond, the search among any three is cut


def main(sizes: tuple[int, ...] = SIZES, repeats: int = 100) -> None:
    kernels.warm_up()
    head = ["targets", "build ms", "bytes", "triangles", "idle us", "insert us", "move us", "delete us"]
    table = Table(*head, "first us", "all us", "table ms", "any us", caption="bytes and triangles are of one target")
    for n in sizes:
        table.add_row(f"{n}", *measured(n, repeats))
    Console(width=140).print(table)


def measured(n: int, repeats: int) -> list[str]:
    rng = np.random.default_rng(1)
    side_mm = SPACING_MM * np.sqrt(n)
    xyz = np.column_stack([rng.uniform(0, side_mm, size=(n, 2)), rng.normal(scale=5.0, size=n)])
    cov = np.tile(np.eye(3) * 0.03**2, (n, 1, 1))
    map = ReferenceMap.given(xyz, cov, np.tile([0.0, 0.0, -1.0], (n, 1)))
    index = MapIndex()
    build_s = once(lambda: index.follow(map))
    cells = [f"{1e3 * build_s:.1f}", f"{index.bytes / n:.0f}", f"{index.triangles / n:.1f}"]
    cells.append(f"{1e6 * typical([lambda: index.follow(map)] * repeats):.1f}")

    moved, gone, come = [], [], []
    for r in rng.choice(n, min(repeats, n // 5), replace=False):
        rows = np.array([r])
        map.xyz_mm[r] += rng.normal(scale=3.0, size=3)
        moved.append(once(lambda rows=rows: index.follow(map, rows)))
        map.state[r] = TargetState.removed
        gone.append(once(lambda rows=rows: index.follow(map, rows)))
        map.state[r] = TargetState.trusted
        come.append(once(lambda rows=rows: index.follow(map, rows)))
    cells += [f"{1e6 * np.median(times):.0f}" for times in (come, moved, gone)]

    points = sighting(rng, map)
    frame = frame_triangles(points.xyz_mm, points.cov_mm2)
    first = frame[:12]
    for triangles in (first, frame):
        seconds = typical([lambda t=triangles: index.local(points, map, t, 3.0, 0.0, 10**9)] * repeats)
        cells.append(f"{1e6 * seconds / len(triangles):.2f}")
    if n > ANY_UP_TO:
        return [*cells, "-", "-"]
    search = [lambda: index.any(points, map, first, 3.0, 0.0, 10**9)]
    with_table_s, seconds = once(search[0]), typical(search * (repeats // 10))
    return [*cells, f"{1e3 * (with_table_s - seconds):.2f}", f"{1e6 * seconds / len(first):.1f}"]


def sighting(rng: np.random.Generator, map: ReferenceMap, seen: int = 20, strays: int = 5) -> SensorPoints:
    middle = map.xyz_mm.mean(axis=0)
    near = np.argsort(np.linalg.norm(map.xyz_mm - middle, axis=1))[:seen]
    xyz = Pose.exp(np.array([0.0, 0.0, 450.0, 0.3, -0.2, 1.0])).apply(map.xyz_mm[near] - middle)
    xyz = np.concatenate([xyz, rng.uniform(xyz.min(axis=0), xyz.max(axis=0), size=(strays, 3))])
    n = len(xyz)
    xyz += rng.normal(scale=0.05, size=xyz.shape)
    none = np.full(n, -1)
    return SensorPoints(xyz, np.tile(np.eye(3) * 0.05**2, (n, 1, 1)), none, none, np.arange(n))


def once(work: Callable[[], object]) -> float:
    start = process_time()
    work()
    return process_time() - start


def typical(works: list[Callable[[], object]]) -> float:
    return float(np.median([once(work) for work in works]))


if __name__ == "__main__":
    main()
