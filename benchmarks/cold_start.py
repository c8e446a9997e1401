"""How long from a frame to its pose, with nothing known but the map: trifix beside others, on the same queries.

Run: python benchmarks/cold_start.py --out out/cold_start --queries 1000

Frames of 10 to 25 points, a quarter of them strays; one frame in five shows a foreign object. Everybody gets the same
frames in turn, on one core, in one run; what a map needs beforehand is done once and not counted. Who has used up its
time with a map gets no more of its queries, and who could not finish one with it is left out. An answer of the others
counts when at least 40 % of the frame's points, and five, agree with it; trifix decides by itself.

- trifix: the complete step, from points to fix. Where the step says when its first hypothesis was verified, under
  ``first_verified`` among its timings, that time stands in a row of its own.
- cliquematch: the largest clique of pairs whose distances agree (``A2AGraph``), bounded below by the points that must
  agree.
- KISS-Matcher: prune and solve over all pairs of a point and a target.
- Open3D: RANSAC over the same pairs, with its tests of edges and distances.
- pair table: our own plain one. Distances of all targets to their 40 nearest, sorted; a triangle of the frame is
  looked up by one side, its third point among the neighbours, and a pose is tried by a k-d tree on ever more points.
"""

import importlib.util
import json
import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import ceil
from pathlib import Path
from time import perf_counter

import cyclopts
import numpy as np
import shards
from adversarial import patch
from made_frames import GAP_NS, MOST, Batch, World, made_world, measured
from numba import njit
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from scipy.spatial import cKDTree

from trifix import Config, Fix, Positioner
from trifix.config import with_overrides
from trifix.geometry.alignment import align
from trifix.geometry.pose import Pose
from trifix.records import Frame, ReferenceMap, SensorPoints

SIZES = (50, 118, 1000, 10_000, 100_000, 1_000_000)
SPACING_MM = 35.0
FOREIGN, STRAYS = 0.2, 0.25
LEAST, LARGEST = 10, 25
TOLERANCE_MM = 0.3
"""Distances of a frame and of the map agree within this much: four sigma."""
REACH_MM = 1.0
"""A point has found a target within this distance."""
FIRST = "first_verified"

GOALS = (
    ("first", "cliquematch", {50: 20, 118: 80, 1000: 1000}),
    ("trifix", "cliquematch", {50: 10, 118: 40, 1000: 400}),
    ("trifix", "pair table", {10_000: 150, 100_000: 3000}),
)
"""How many times faster, by the median, the first should be than the second, by the size of the map; half by p99."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What somebody makes of a frame."""

    pose: Pose | None
    """``T_world_sensor``, if there is one."""
    first_s: float | None = None
    """Time until the first hypothesis was verified, where that is told (s)."""
    why: str = ""
    """Why there is no pose, where that is told."""


Solver = Callable[[SensorPoints], Answer]


def must_agree(n: int) -> int:
    """Of n points, how many must find a target before a pose is answered."""
    return max(5, ceil(0.4 * n))


class Trifix:
    """The whole step, each frame too long after the last for the motion to say anything."""

    name = "trifix"

    def __init__(self, map: ReferenceMap, config: Config) -> None:
        self.positioner = Positioner(config, map=map, is_map_frozen=True)
        self.frames = 0

    def __call__(self, points: SensorPoints) -> Answer:
        self.frames += 1
        step = self.positioner.step(Frame(self.frames, self.frames * GAP_NS, None, points))
        first_ms = step.timings_ms.get(FIRST)
        first_s = None if first_ms is None else 1e-3 * first_ms
        if isinstance(step.fix, Fix):
            return Answer(step.fix.T_world_sensor, first_s)
        return Answer(None, first_s, step.fix.why.name)


class Cliquematch:
    """The largest clique of the correspondence graph."""

    name, largest, module = "cliquematch", 1000, "cliquematch"

    def __init__(self, map: ReferenceMap) -> None:
        from cliquematch import A2AGraph

        warnings.filterwarnings("ignore", message="A2AGraph")  # that distances are Euclidean, at every query
        self.graph, self.xyz = A2AGraph, map.xyz_mm

    def __call__(self, points: SensorPoints) -> Answer:
        graph = self.graph(points.xyz_mm, self.xyz)
        graph.epsilon = TOLERANCE_MM
        graph.build_edges()
        try:
            point, target = graph.get_correspondence(lower_bound=must_agree(len(points)) - 1)
        except RuntimeError:  # no clique as large
            return Answer(None)
        return Answer(align(points.xyz_mm[point], self.xyz[target]))


class KissMatcher:
    """Pruning to the densest core of the graph of all pairs, then graduated non-convexity."""

    name, largest, module = "KISS-Matcher", 1000, "kiss_matcher"

    def __init__(self, map: ReferenceMap) -> None:
        from kiss_matcher import KISSMatcher, KISSMatcherConfig

        # the noise bounds are multiples of the voxel size, which means nothing else here
        config = KISSMatcherConfig(TOLERANCE_MM, use_voxel_sampling=False, num_max_corr=10**9)
        self.matcher, self.xyz, self.tree = KISSMatcher(config), map.xyz_mm, cKDTree(map.xyz_mm)

    def __call__(self, points: SensorPoints) -> Answer:
        n, k = len(points), len(self.xyz)
        source = np.repeat(points.xyz_mm.astype(np.float32), k, axis=0)
        solution = self.matcher.prune_and_solve(source, np.tile(self.xyz.astype(np.float32), (n, 1)))
        return settled(self.tree, points, Pose(np.array(solution.rotation), np.array(solution.translation)))


class Open3d:
    """RANSAC over all pairs."""

    name, largest, module = "Open3D", 118, "open3d"

    def __init__(self, map: ReferenceMap) -> None:
        import open3d

        self.open3d, self.tree, self.target = open3d, cKDTree(map.xyz_mm), self.cloud(open3d, map.xyz_mm)
        open3d.utility.random.seed(1)
        o3d = open3d.pipelines.registration
        self.checkers = [
            o3d.CorrespondenceCheckerBasedOnEdgeLength(0.99),
            o3d.CorrespondenceCheckerBasedOnDistance(0.5),
        ]
        self.criteria = o3d.RANSACConvergenceCriteria(2_000_000, 0.999)

    @staticmethod
    def cloud(open3d, xyz_mm: np.ndarray):
        return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz_mm))

    def __call__(self, points: SensorPoints) -> Answer:
        n, k = len(points), len(self.tree.data)
        pairs = np.column_stack([np.repeat(np.arange(n), k), np.tile(np.arange(k), n)]).astype(np.int32)
        o3d = self.open3d.pipelines.registration
        found = o3d.registration_ransac_based_on_correspondence(
            self.cloud(self.open3d, points.xyz_mm),
            self.target,
            self.open3d.utility.Vector2iVector(pairs),
            0.5,
            o3d.TransformationEstimationPointToPoint(False),
            3,
            self.checkers,
            self.criteria,
        )
        T = np.array(found.transformation)
        return settled(self.tree, points, Pose(T[:3, :3], T[:3, 3]))


class PairTable:
    """Triangles by a sorted table of distances, tried at random until one convinces."""

    name, largest = "pair table", 10**9
    neighbours, triangles = 40, 60

    def __init__(self, map: ReferenceMap) -> None:
        self.xyz, self.tree = np.ascontiguousarray(map.xyz_mm), cKDTree(map.xyz_mm)
        k = min(self.neighbours, len(self.xyz) - 1)
        distance, near = self.tree.query(self.xyz, k=k + 1)
        self.near, self.distance = near[:, 1:].astype(np.int32), distance[:, 1:].astype(np.float32)
        order = np.argsort(self.distance, axis=None)
        self.pair, self.length = order.astype(np.int32 if order.size < 2**31 else np.int64), self.distance.flat[order]
        self.rng = np.random.default_rng(1)

    def __call__(self, points: SensorPoints) -> Answer:
        xyz, n = points.xyz_mm, len(points)
        side = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
        near = np.argsort(side, axis=1)[:, 1:7]
        for _ in range(self.triangles):
            a = self.rng.integers(n)
            b, c = self.rng.choice(near[a], 2, replace=False)
            first, last = np.searchsorted(self.length, [side[a, b] - TOLERANCE_MM, side[a, b] + TOLERANCE_MM])
            found = third_points(
                self.pair, first, last, self.near, self.distance, self.xyz, side[a, c], side[b, c], TOLERANCE_MM
            )
            R, t_mm = triads(xyz[[a, b, c]], self.xyz[found])
            others = np.setdiff1d(np.arange(n), [a, b, c])
            self.rng.shuffle(others)
            for rows, least in ((others[:4], 1), (others, must_agree(n) - 3)):
                placed = np.einsum("hij,nj->hni", R, xyz[rows]) + t_mm[:, None]
                is_found = np.isfinite(self.tree.query(placed, distance_upper_bound=REACH_MM)[0])
                keep = is_found.sum(axis=1) >= least
                R, t_mm, is_found = R[keep], t_mm[keep], is_found[keep]
            if len(R):
                best = int(np.argmax(is_found.sum(axis=1)))
                return settled(self.tree, points, Pose(R[best], t_mm[best]))
        return Answer(None)


@njit(cache=True)
def third_points(pair, first, last, near, distance, xyz, ac, bc, tolerance):
    """Rows of three targets for each pair of the table between first and last that a neighbour makes congruent."""
    found = []
    k = near.shape[1]
    for p in range(first, last):
        i, j = pair[p] // k, near[pair[p] // k, pair[p] % k]
        for m in range(k):
            if abs(distance[i, m] - ac) <= tolerance:
                o = near[i, m]
                d2 = 0.0
                for x in range(3):
                    d2 += (xyz[o, x] - xyz[j, x]) ** 2
                if abs(np.sqrt(d2) - bc) <= tolerance:
                    found.append((i, j, o))
    out = np.empty((len(found), 3), dtype=np.int64)
    for h in range(len(found)):
        out[h, 0], out[h, 1], out[h, 2] = found[h]
    return out


def triads(points_mm: np.ndarray, targets_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (h, 3, 3) and (h, 3) that lay one triangle on each of h others, by their first side and normal."""

    def axes(xyz: np.ndarray) -> np.ndarray:
        x = xyz[..., 1, :] - xyz[..., 0, :]
        z = np.cross(x, xyz[..., 2, :] - xyz[..., 0, :])
        x, z = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12) for v in (x, z))
        return np.stack([x, np.cross(z, x), z], axis=-1)

    R = axes(targets_mm) @ axes(points_mm).T
    return R, targets_mm.mean(axis=1) - R @ points_mm.mean(axis=0)


def settled(tree: cKDTree, points: SensorPoints, pose: Pose) -> Answer:
    """The pose from all points that find a target, if they are enough."""
    distance, target = tree.query(pose.apply(points.xyz_mm), distance_upper_bound=REACH_MM)
    point = np.flatnonzero(np.isfinite(distance))
    if len(point) < must_agree(len(points)):
        return Answer(None)
    return Answer(align(points.xyz_mm[point], tree.data[target[point]]))


PEERS = (Cliquematch, KissMatcher, Open3d, PairTable)


@dataclass(slots=True)
class Record:
    """How somebody fared with one map."""

    build_s: float
    seconds: list[float] = field(default_factory=list)
    first_s: list[float] = field(default_factory=list)
    right: int = 0
    wrong: int = 0
    own: int = 0
    """Queries that show the object of the map."""
    refused: Counter[str] = field(default_factory=Counter)
    """Why those were not answered, where that is told."""


def main(
    out: Path = Path("out/cold_start"),
    sizes: tuple[int, ...] = SIZES,
    queries: int = 500,
    budget_s: float = 60.0,
    seed: int = 1,
    without: tuple[str, ...] = (),
    option: tuple[str, ...] = (),
) -> None:
    """Runs the queries and writes cold_start.json and cold_start.md.

    Parameters
    ----------
    out: folder for the results.
    sizes: targets of the maps.
    queries: frames for each map.
    budget_s: time that each may use with a map, after which it gets no more queries.
    seed: of all random numbers.
    without: names of those to leave out.
    option: options of trifix, such as identify.technique=minimal.
    """
    one_core()
    config = with_overrides(Config(), dict(each.split("=", 1) for each in option))
    summary = measure(sizes, queries, budget_s, seed, without, config)
    out.mkdir(parents=True, exist_ok=True)
    (out / "cold_start.json").write_text(json.dumps(summary, indent=1) + "\n")
    text = markdown(summary)
    (out / "cold_start.md").write_text(text)
    print(text)


def measure(
    sizes: tuple[int, ...],
    queries: int,
    budget_s: float,
    seed: int,
    without: tuple[str, ...],
    config: Config,
) -> dict[str, object]:
    """The numbers of a run."""
    missing = [m.name for m in PEERS if hasattr(m, "module") and importlib.util.find_spec(m.module) is None]
    chosen = [method for method in PEERS if method.name not in (*missing, *without)]
    rows: list[dict[str, object]] = []
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=shards.console(),
    )
    start = perf_counter()
    with progress:
        for n in sizes:
            bar = progress.add_task(f"{n} targets: making maps", total=queries)
            rng = np.random.default_rng([seed, n])
            world, batch = made_queries(rng, n, queries)
            methods = {m.name: m for m in chosen if n <= m.largest}
            if Trifix.name not in without:
                methods = {Trifix.name: partial(Trifix, config=config), **methods}
            records = asked(world, batch, methods, budget_s, progress, bar, n)
            rows += [row for name, record in records.items() for row in figures(n, name, record)]
    progress.console.print(
        f"{queries * len(sizes)} queries, {queries * len(sizes) / (perf_counter() - start):.1f} a second"
    )
    return {"queries": queries, "missing": missing, "rows": rows, "ratios": ratios(rows)}


def one_core() -> None:
    """Binds the process to one core, before the peers are loaded and ask how many there are."""
    os.environ["OMP_NUM_THREADS"] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def made_queries(rng: np.random.Generator, n: int, f: int) -> tuple[World, Batch]:
    """A map and frames, every fifth of which is foreign."""
    world, other = made_world(rng, n, SPACING_MM), made_world(rng, max(100, min(n, 1000)), SPACING_MM)
    count = rng.integers(LEAST, LARGEST + 1, f)
    part = (np.arange(f) % round(1 / FOREIGN) == 1).astype(int)
    own, label = patch(rng, world, count, np.round((1 - STRAYS) * count).astype(int))
    away, _ = patch(rng, other, count, np.round((1 - STRAYS) * count).astype(int))
    is_foreign = (part == 1)[:, None]
    xyz = np.where(is_foreign[..., None], away, own)
    label = np.where(is_foreign, np.full((f, MOST), -1), label)
    return world, measured(rng, xyz, label, count, part, across_mm=(0.02, 0.04), elongation=(3.0, 3.0))


def asked(
    world: World,
    batch: Batch,
    methods: Mapping[str, Callable[[ReferenceMap], Solver]],
    budget_s: float,
    progress: Progress,
    bar: TaskID,
    n: int,
) -> dict[str, Record]:
    """Everybody's record over the same frames in the same order."""
    records: dict[str, Record] = {}
    solvers: dict[str, Solver] = {}
    for name, prepare in methods.items():
        progress.update(bar, description=f"{n} targets: {name} prepares")
        start = perf_counter()
        solvers[name] = prepare(world.map)
        records[name] = Record(perf_counter() - start)
        solvers[name](batch.points(0))  # compiled, and in the cache
    for k in range(len(batch)):
        points = batch.points(k)
        for name, solver in solvers.items():
            record = records[name]
            if sum(record.seconds) > budget_s:
                continue
            progress.update(bar, description=f"{n} targets: {name}")
            start = perf_counter()
            answer = solver(points)
            record.seconds.append(perf_counter() - start)
            if answer.first_s is not None:
                record.first_s.append(answer.first_s)
            is_own, is_right = batch.part[k] == 0, False
            if answer.pose is not None:
                is_right = batch.is_right(k, answer.pose, world.map)
                record.wrong += not is_right
            record.own += bool(is_own)
            record.right += is_right
            if is_own and answer.why:
                record.refused[answer.why] += 1
        progress.advance(bar)
    return records


def figures(n: int, name: str, record: Record) -> list[dict[str, object]]:
    """A record as a row of the table; two where the first verified hypothesis was told."""
    row = {
        "targets": n,
        "method": name,
        "queries": len(record.seconds),
        "success": record.right / max(record.own, 1),
        "wrong": record.wrong,
        "refused": dict(record.refused),
        "build_s": record.build_s,
        "seconds": record.seconds,
    }
    if not record.first_s:
        return [row]
    return [row, {**row, "method": f"{name}, first verified", "seconds": record.first_s}]


def ratios(rows: list[dict]) -> list[dict[str, object]]:
    """How many times faster trifix is than each other on the queries that both have had, with the goals."""
    times = {(row["targets"], row["method"]): row["seconds"] for row in rows}
    first = "trifix, first verified"
    found = []
    for n, name in times:
        for ours, kind in (("trifix", "trifix"), (first, "first")):
            if name in ("trifix", first) or (n, ours) not in times:
                continue
            goal = next((g[n] for mine, whose, g in GOALS if mine == kind and whose == name and n in g), None)
            a, b = times[n, ours], times[n, name]
            both = min(len(a), len(b))
            median, p99 = (
                float(np.percentile(b[:both], p) / np.percentile(a[:both] if ours == "trifix" else a, p))
                for p in (50, 99)
            )
            found.append({"targets": n, "ours": ours, "than": name, "median": median, "p99": p99, "goal": goal})
    return found


def markdown(summary: dict) -> str:
    """The table, and how many times faster trifix is, as Markdown."""
    lines = [
        "| targets | method | queries | success | wrong | median ms | p99 ms | prepared in s |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in summary["rows"]:
        median, p99 = (1e3 * np.percentile(row["seconds"], p) for p in (50, 99))
        lines.append(
            f"| {row['targets']} | {row['method']} | {row['queries']} | {100 * row['success']:.1f} % | {row['wrong']} "
            f"| {median:.3g} | {p99:.3g} | {row['build_s']:.2g} |"
        )
    lines += ["", "| targets | times faster | than | median | p99 | goal |", "| ---: | --- | --- | ---: | ---: | --- |"]
    for each in summary["ratios"]:
        goal = each["goal"]
        said = "" if goal is None else f"{goal} and {goal / 2:g}"
        if goal is not None:
            said += ", reached" if each["median"] >= goal and each["p99"] >= goal / 2 else ", missed"
        lines.append("| {targets} | {ours} | {than} | {median:.3g} | {p99:.3g} | ".format(**each) + f"{said} |")
    for row in summary["rows"]:
        if row["refused"] and row["method"] == "trifix":
            why = ", ".join(f"{name} {count}" for name, count in row["refused"].items())
            lines += ["", f"Refused by trifix of those it could have answered, {row['targets']} targets: {why}."]
    if summary["missing"]:
        lines += ["", f"Not installed: {', '.join(summary['missing'])}."]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    cyclopts.run(main)
