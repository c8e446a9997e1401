"""The index against plain searches: after any history its neighbours, triangles and candidates are those of now."""

from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from constellations import front_map, looking, noise, points_of, scattered, sensor_covariances, some_points
from trifix.geometry.alignment import align
from trifix.index import Candidates, MapIndex, frame_triangles
from trifix.records import ReferenceMap, SensorPoints, TargetState

PAIRS = list(combinations(range(8), 2))
EDGE_ON_SINE = np.sin(np.radians(20.0))


def indexed(map: ReferenceMap) -> MapIndex:
    index = MapIndex()
    index.follow(map)
    return index


# --- following the map -----------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1, 1.0]), st.booleans())
def test_any_history_leads_to_what_a_fresh_index_would_hold(seed, depth, is_regular):
    rng = np.random.default_rng(seed)
    map = random_map(rng, 50, depth, is_regular)
    index = MapIndex()
    for step in range(8):
        index.follow(map)
        check_whole(index, map)
        change(map, rng.choice(len(map), rng.integers(1, 30 if step == 4 else 6), replace=False), rng)


def test_only_rows_said_to_have_changed_are_looked_at():
    rng = np.random.default_rng(0)
    map = random_map(rng, 60, 0.1, False)
    index = indexed(map)
    for _ in range(20):
        rows = rng.choice(len(map), 4)  # some of them twice
        change(map, np.unique(rows), rng)
        index.follow(map, rows)
        check_whole(index, map)


def test_index_grows_with_the_map_and_finds_its_scale():
    rng = np.random.default_rng(1)
    xyz = np.r_[rng.uniform(0, 20, (4, 3)), rng.uniform(0, 1000, (300, 3)) * [1, 1, 0.1]]
    index = MapIndex()
    for k in [0, 1, 2, 3, 4, *range(9, 305, 20)]:
        map = ReferenceMap.given(xyz[:k])
        index.follow(map)
        check_whole(index, map)
    cell_mm = index.grid[3]
    fresh_mm = indexed(ReferenceMap.given(xyz)).grid[3]
    assert fresh_mm / 1.6 < cell_mm < fresh_mm * 1.6
    assert index.bytes <= 400 * index.targets


def test_targets_that_stay_within_the_slack_are_not_indexed_anew():
    rng = np.random.default_rng(2)
    map = front_map(scattered(rng, 40))
    index = indexed(map)
    before, anchor, slack_mm = index.version, index.grid[2].copy(), index.grid[4]
    step = rng.normal(size=(40, 3))
    step *= 0.9 * slack_mm / np.linalg.norm(step, axis=1, keepdims=True)
    map.xyz_mm[:] += step
    index.follow(map)
    assert index.version == before
    map.xyz_mm[7] += 3 * step[7]
    index.follow(map)
    assert index.version == before + 1
    assert np.flatnonzero((index.grid[2] != anchor).any(axis=1)).tolist() == [7]


def test_another_map_replaces_the_first():
    rng = np.random.default_rng(3)
    index = indexed(front_map(scattered(rng, 40)))
    for n in (25, 0, 12):
        map = front_map(scattered(rng, n))
        index.follow(map)
        check_whole(index, map)
        assert index.targets == n


@pytest.mark.parametrize("xyz", [np.zeros((9, 3)), np.outer(np.arange(12.0), [3.0, 4.0, 0.0])], ids=["heap", "line"])
def test_maps_without_triangles_have_none(xyz):
    index = indexed(ReferenceMap.given(xyz))
    check_whole(index, ReferenceMap.given(xyz))
    assert index.triangles == 0


def random_map(rng: np.random.Generator, n: int, depth: float, is_regular: bool) -> ReferenceMap:
    xyz = rng.uniform(0, 200, (n, 3)) * [1, 1, depth]
    if is_regular:
        xyz = np.round(xyz / 25) * 25  # distances tie, targets coincide
    return ReferenceMap.given(xyz, state=np.where(rng.random(n) < 0.7, 1, 3))


def change(map: ReferenceMap, rows: np.ndarray, rng: np.random.Generator) -> None:
    for r in rows:
        match rng.integers(4):
            case 0:
                map.state[r] = TargetState.removed
            case 1:
                map.state[r], map.id[r] = TargetState.trusted, map.id[r] + 1000
            case 2:
                map.xyz_mm[r] += rng.normal(scale=10.0, size=3)
            case _:
                map.state[r] = rng.integers(4)


def check_whole(index: MapIndex, map: ReferenceMap) -> None:
    """Cells, neighbours and triangles are those of a plain search over the anchors of the living."""
    head, following, anchor, cell_mm, slack_mm = index.grid
    alive = np.flatnonzero(map.alive)
    at = anchor.astype(float)
    assert (np.linalg.norm(at[alive] - map.xyz_mm[alive], axis=1) <= slack_mm).all()
    assert chained(head, following) == {bucket_entry(at[r], cell_mm, len(head), r) for r in alive}

    neighbour = np.full((len(anchor), 8), -1)
    for p in alive:
        d = ((at[alive] - at[p]) ** 2).sum(axis=1)
        near = [alive[n] for n in np.lexsort((alive, d)) if alive[n] != p and d[n] <= (4 * cell_mm) ** 2][:8]
        neighbour[p, : len(near)] = near
    assert (index.neighbour == neighbour).all()

    store = index._store
    triangles = owned_triangles(at, neighbour, alive)
    expected = {
        bucket_entry(side, store.side_mm, len(store.side_head), entry) for entry, (_, side) in triangles.items()
    }
    assert chained(store.side_head, store.side_next) == expected
    assert (index.targets, index.triangles) == (len(alive), len(triangles))


def chained(head: np.ndarray, following: np.ndarray) -> set[tuple[int, int]]:
    """(bucket, entry) of all entries of a table of chains, each in one place."""
    found: list[tuple[int, int]] = []
    for b, first in enumerate(head.tolist()):
        e = first
        while e >= 0:
            found.append((b, e))
            e = int(following[e])
    assert len({e for _, e in found}) == len(found)
    return set(found)


def bucket_entry(at: np.ndarray, cell_mm: float, buckets: int, entry: int) -> tuple[int, int]:
    i, j, k = np.floor(at / cell_mm).astype(np.int64).tolist()
    return ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & (buckets - 1), int(entry)


def owned_triangles(at: np.ndarray, neighbour: np.ndarray, alive: np.ndarray) -> dict[int, tuple[set, np.ndarray]]:
    """Entry -> (rows, sorted sides): two neighbours of the corner opposite the longest side, and no needle."""
    out = {}
    for p in alive.tolist():
        for code, (i, j) in enumerate(PAIRS):
            a, b = neighbour[p, [i, j]].tolist()
            if b < 0:
                continue
            pa2, pb2, ab2 = (((at[u] - at[v]) ** 2).sum() for u, v in ((p, a), (p, b), (a, b)))
            is_longest = (ab2, -p) > (pa2, -b) and (ab2, -p) > (pb2, -a)
            along = (pa2 + pb2 - ab2) / 2
            if is_longest and pa2 * pb2 - along**2 > (0.15 * ab2) ** 2:
                out[28 * p + code] = {p, a, b}, np.sqrt(np.sort([pa2, pb2, ab2]))
    assert len({tuple(sorted(rows)) for rows, _ in out.values()}) == len(out)
    return out


# --- candidates ------------------------------------------------------------------------------------------------------


def sighting(rng: np.random.Generator, map: ReferenceMap, seen: np.ndarray, strays: int) -> SensorPoints:
    """Some targets as a sensor sees them, and strays among them, in mixed order."""
    xyz = looking(rng).inverse().apply(map.xyz_mm[seen])
    xyz = np.r_[xyz, xyz.mean(axis=0) + rng.normal(scale=40.0, size=(strays, 3))]
    cov = sensor_covariances(xyz)
    points = points_of(xyz + noise(rng, cov), cov)
    return some_points(points, rng.permutation(len(xyz)))


def congruent(
    points: SensorPoints, map: ReferenceMap, triangle: np.ndarray, targets: np.ndarray, sigmas: float, floor_mm: float
) -> set[tuple[tuple[int, ...], tuple[int, ...]]]:
    """All orders of some targets' triples in which they are congruent with a triangle of the frame."""
    triples = targets.reshape(-1, 3)[:, list(permutations(range(3)))].reshape(-1, 3)
    agree = hands_apart(points, map, triangle, triples) >= 0
    for u, v in ((0, 1), (0, 2), (1, 2)):
        d = points.xyz_mm[triangle[u]] - points.xyz_mm[triangle[v]]
        side = np.linalg.norm(d)
        var = d @ (points.cov_mm2[triangle[u]] + points.cov_mm2[triangle[v]]) @ d / side**2
        e = map.xyz_mm[triples[:, u]] - map.xyz_mm[triples[:, v]]
        map_side = np.linalg.norm(e, axis=1)
        C = map.cov_mm2[triples[:, u]] + map.cov_mm2[triples[:, v]]
        map_var = np.einsum("ni,nij,nj->n", e, C, e) / map_side**2
        agree &= np.abs(side - map_side) <= floor_mm + sigmas * np.sqrt(var + map_var)
    return {paired(triangle, triple) for triple in triples[agree]}


def paired(triangle: np.ndarray, triple: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    by_point = np.argsort(triangle)
    return tuple(triangle[by_point].tolist()), tuple(triple[by_point].tolist())


def hands_apart(points: SensorPoints, map: ReferenceMap, triangle: np.ndarray, triples: np.ndarray) -> np.ndarray:
    frame = handedness(points.xyz_mm[triangle[None]], -points.xyz_mm[triangle[None]].sum(axis=1))
    return frame * handedness(map.xyz_mm[triples], map.view[triples].sum(axis=1))


def handedness(corner: np.ndarray, towards: np.ndarray) -> np.ndarray:
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    value = np.einsum("ni,ni->n", normal, towards)
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    return np.where(np.abs(value) > EDGE_ON_SINE * size, np.sign(value), 0.0)


def as_pairs(found: Candidates) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    return [paired(p, q) for p, q in zip(found.point, found.target, strict=True)]


@pytest.mark.parametrize("seed", range(6))
def test_local_finds_every_congruent_triangle_of_the_index_once(seed):
    rng = np.random.default_rng(seed)
    map = random_sheet(rng, 150, is_regular=seed == 5)
    index = indexed(map)
    map.xyz_mm[:] += rng.uniform(-1, 1, (150, 3)) * index.grid[4] / np.sqrt(3)  # the slack is used up
    index.follow(map)
    assert index.version == 1
    alive = np.flatnonzero(map.alive)
    triangles = owned_triangles(index.grid[2].astype(float), index.neighbour, alive)
    targets = np.array([sorted(rows) for rows, _ in triangles.values()])
    points = sighting(rng, map, np.argsort(map.xyz_mm[:, 0])[20:40], strays=8)
    frame = frame_triangles(points.xyz_mm, points.cov_mm2)[:30]
    for sigmas, floor_mm in ((3.0, 0.0), (0.0, 0.5), (3.0, 8.0)):  # the last: too vague for cells
        found = index.local(points, map, frame, sigmas, floor_mm, 10**9)
        expected = set().union(*(congruent(points, map, f, targets, sigmas, floor_mm) for f in frame))
        assert len(found) == len(expected) >= 5
        assert set(as_pairs(found)) == expected
        assert found.tried == len(frame)
        assert not found.is_cut
        assert (np.sort(found.point, axis=1) == np.sort(frame[found.triangle], axis=1)).all()


@pytest.mark.parametrize("seed", range(4))
def test_any_finds_every_congruent_triple_of_targets_once(seed):
    rng = np.random.default_rng(seed)
    map = random_sheet(rng, 30, is_regular=seed == 3)
    index = indexed(map)
    map.xyz_mm[:] += rng.uniform(-1, 1, (30, 3)) * index.grid[4] / np.sqrt(3)
    points = sighting(rng, map, rng.choice(30, 9, replace=False), strays=2)
    frame = rng.permutation(np.array(list(combinations(range(len(points)), 3))))[:20]
    targets = np.array(list(combinations(range(30), 3)))
    for sigmas, floor_mm in ((3.0, 0.0), (0.0, 3.0)):
        found = index.any(points, map, frame, sigmas, floor_mm, 10**9)
        expected = set().union(*(congruent(points, map, f, targets, sigmas, floor_mm) for f in frame))
        assert len(found) == len(expected) >= 10
        assert set(as_pairs(found)) == expected
        assert (found.tried, found.is_cut) == (len(frame), False)


def random_sheet(rng: np.random.Generator, n: int, is_regular: bool) -> ReferenceMap:
    """Targets on a wavy sheet, at random or in a square pattern, some of them without a direction."""
    side = 20.0 * np.sqrt(n)
    xyz = np.c_[rng.uniform(0, side, (n, 2)), np.zeros(n)]
    if is_regular:
        xyz[:, :2] = np.stack(np.divmod(np.arange(n), int(np.sqrt(n))), axis=1) * 20.0
    xyz[:, 2] = 10 * np.sin(xyz[:, 0] / 30)
    map = front_map(xyz, 0.02)
    map.view[rng.choice(n, n // 8)] = np.nan
    return map


def test_a_true_triangle_is_among_the_first_even_with_strays():
    hits = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        map = random_sheet(rng, 300, is_regular=False)
        index = indexed(map)
        middle = np.linalg.norm(map.xyz_mm - map.xyz_mm.mean(axis=0), axis=1)
        points = sighting(rng, map, rng.choice(np.argsort(middle)[:18], 16, replace=False), strays=6)
        frame = frame_triangles(points.xyz_mm, points.cov_mm2)
        assert np.bincount(frame[:6].ravel()).max() <= 3  # points take turns
        found = index.local(points, map, frame[:12], 3.0, 0.0, 99)
        for p, q in zip(found.point, found.target, strict=True):
            T = align(points.xyz_mm[p], map.xyz_mm[q])
            apart = np.linalg.norm(T.apply(points.xyz_mm)[:, None] - map.xyz_mm, axis=2).min(axis=1)
            if np.count_nonzero(apart < 2.0) >= 8:
                hits += 1
                break
    assert hits >= 36


def test_equilateral_triangles_keep_the_three_orders_that_handedness_allows():
    corner = np.array([[0.0, 0, 0], [30, 0, 0], [15, np.sqrt(675), 0]])
    map = front_map(corner, 0.01)
    points = points_of(corner * [1, -1, 1] + [0, 0, 400.0], np.tile(np.eye(3) * 1e-4, (3, 1, 1)))  # from behind
    frame = frame_triangles(points.xyz_mm, points.cov_mm2)
    assert len(frame) == 1
    index = indexed(map)
    for search in (index.local, index.any):
        assert len(search(points, map, frame, 3.0, 0.0, 99)) == 3
        map.view[:] = np.nan
        assert len(search(points, map, frame, 3.0, 0.0, 99)) == 6
        map.view[:] = [0.0, 0.0, -1.0]


def test_search_stops_when_there_is_enough_and_says_when_it_gave_up():
    rng = np.random.default_rng(4)
    map = random_sheet(rng, 150, is_regular=True)
    index = indexed(map)
    points = sighting(rng, map, np.arange(40), strays=0)
    frame = frame_triangles(points.xyz_mm, points.cov_mm2)
    for search in (index.local, index.any):
        found = search(points, map, frame, 3.0, 0.0, 200)
        assert found.tried < len(frame)
        assert found.triangle.max() == found.tried - 1
        assert np.count_nonzero(found.triangle < found.tried - 1) < 200 <= len(found)
    assert not index.any(points, map, frame[:5], 3.0, 0.0, 10**9).is_cut
    assert index.any(points, map, frame, 3.0, 0.0, 10**9, max_comparisons=1000).is_cut
    assert indexed(map).any(points, map, frame, 3.0, 0.0, 10**9, max_comparisons=10).is_cut


def test_nothing_is_found_in_nothing():
    rng = np.random.default_rng(5)
    map = random_sheet(rng, 50, is_regular=False)
    points = sighting(rng, map, np.arange(9), strays=0)
    frame = frame_triangles(points.xyz_mm, points.cov_mm2)
    none = frame[:0]
    for index, triangles in ((indexed(map), none), (indexed(ReferenceMap.empty()), frame)):
        known = map if index.targets else ReferenceMap.empty()
        for search in (index.local, index.any):
            found = search(points, known, triangles, 3.0, 0.0, 99)
            assert (len(found), found.tried, found.expected_by_chance) == (0, len(triangles), 0.0)


def test_chance_brings_about_as_many_as_expected():
    rng = np.random.default_rng(6)
    map = ReferenceMap.given(scattered(rng, 1500, (1200.0, 1200.0, 300.0), 1.0))
    index = indexed(map)
    found = {"local": 0, "any": 0}
    expected = {"local": 0.0, "any": 0.0}
    for _ in range(20):
        xyz = scattered(rng, 30, (250.0, 250.0, 60.0)) + [0.0, 0.0, 450.0]
        points = points_of(xyz, sensor_covariances(xyz))
        frame = frame_triangles(points.xyz_mm, points.cov_mm2)
        for name, search in (("local", index.local), ("any", index.any)):
            candidates = search(points, map, frame[: 60 if name == "local" else 4], 3.0, 2.0, 10**9)
            found[name] += len(candidates)
            expected[name] += candidates.expected_by_chance
    for name in found:
        assert found[name] > 100
        assert 0.8 < expected[name] / found[name] < 1.25, name
