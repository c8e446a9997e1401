"""Triangles formed anew only near a change are those that forming all of them anew would give."""

from collections import Counter
from itertools import combinations

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings

from constellations import MAP_COLUMNS
from trifix.records import ReferenceMap, TargetState
from trifix.stages.identify import FrequencyTriangles, IdentifyOptions, MinimalTriangles
from trifix.stages.identify.changes import NearestThree

Triangles = set[tuple[int, ...]]


def triangles_of(technique: MinimalTriangles | FrequencyTriangles) -> Triangles:
    table = technique.triangles()
    distinct = {tuple(sorted(row)) for row in table.tolist()}
    assert len(distinct) == len(table) == technique.size
    return distinct


def nearest_others(map: ReferenceMap, p: int) -> list[int]:
    others = [q for q in np.flatnonzero(map.alive).tolist() if q != p]
    return sorted(others, key=lambda q: (float(((map.xyz_mm[q] - map.xyz_mm[p]) ** 2).sum()), q))


def all_minimal(map: ReferenceMap) -> Triangles:
    """Every target's four triangles (p, ni, nij), from nothing."""
    nearest = {p: nearest_others(map, p)[:3] for p in np.flatnonzero(map.alive).tolist()}
    return {
        tuple(sorted((p, n, further)))
        for p, own in nearest.items()
        for n in own[:2]
        for further in [q for q in nearest[n] if q != p][:2]
    }


class PairCounts:
    """Every frame's pairs by identity of the targets, and every target's three triangles from them, from nothing."""

    def __init__(self) -> None:
        self.count: Counter[tuple[int, int]] = Counter()
        self.distance_mm: dict[tuple[int, int], float] = {}

    def learn(self, map: ReferenceMap, seen: np.ndarray) -> None:
        living = set(map.id[map.alive].tolist())
        self.count = Counter({pair: n for pair, n in self.count.items() if living.issuperset(pair)})
        for p, q in combinations(seen.tolist(), 2):
            pair = min(int(map.id[p]), int(map.id[q])), max(int(map.id[p]), int(map.id[q]))
            if pair not in self.count:
                self.distance_mm[pair] = float(np.sqrt(((map.xyz_mm[p] - map.xyz_mm[q]) ** 2).sum()))
            self.count[pair] += 1

    def triangles(self, map: ReferenceMap) -> Triangles:
        row = {int(map.id[r]): r for r in np.flatnonzero(map.alive).tolist()}
        partners: dict[int, list[int]] = {id: [] for id in row}
        for p, q in self.count:
            partners[p].append(q)
            partners[q].append(p)
        found: Triangles = set()
        for p, others in partners.items():

            def merit(q: int, p: int = p) -> tuple[float, float, int]:
                pair = min(p, q), max(p, q)
                return -self.count[pair], self.distance_mm[pair], q

            best = [row[q] for q in sorted(others, key=merit)[:3]] or nearest_others(map, row[p])[:3]
            found |= {tuple(sorted((row[p], *two))) for two in combinations(best, 2)}
        return found


class World:
    """A map that grows, moves and loses targets at random, on a grid so coarse that distances are often equal."""

    def __init__(self, seed: int, is_coarse: bool, given: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.is_coarse = is_coarse
        self.next_id = given
        self.map = ReferenceMap.given(self.places(given))

    def places(self, n: int) -> np.ndarray:
        return self.rng.integers(0, 4, size=(n, 3)) * 10.0 if self.is_coarse else self.rng.uniform(0, 100, size=(n, 3))

    def grow(self, n: int) -> np.ndarray:
        """New targets take the rows of removed ones first."""
        vacant = np.flatnonzero(self.map.state == TargetState.removed)[:n]
        rows = np.concatenate([vacant, np.arange(len(self.map), len(self.map) + n - len(vacant))])
        new = ReferenceMap.given(self.places(n - len(vacant)), id=np.zeros(n - len(vacant), dtype=np.int64))
        self.map = ReferenceMap(
            *(np.concatenate([getattr(self.map, name), getattr(new, name)]) for name in MAP_COLUMNS)
        )
        self.map.xyz_mm[rows] = self.places(n)
        self.map.state[rows] = int(TargetState.provisional)
        self.map.id[rows] = np.arange(self.next_id, self.next_id + n)
        self.next_id += n
        return rows

    def frame(self) -> np.ndarray:
        """One frame's worth of change; returns the rows seen, which lie together."""
        self.map = self.map.copy()
        alive = np.flatnonzero(self.map.alive)
        if len(alive) > 6 and self.rng.random() < 0.4:
            gone = self.rng.choice(alive, size=self.rng.integers(1, 3), replace=False)
            self.map.state[gone] = int(self.rng.choice([TargetState.removed, TargetState.quarantined]))
        added = self.grow(int(self.rng.integers(0, 4)) if len(alive) else 5)
        alive = np.flatnonzero(self.map.alive)
        centre = self.map.xyz_mm[self.rng.choice(alive)]
        near = alive[np.argsort(((self.map.xyz_mm[alive] - centre) ** 2).sum(axis=1), kind="stable")]
        seen = np.unique(np.concatenate([near[: self.rng.integers(3, 8)], added]))
        if not self.is_coarse:
            self.map.xyz_mm[seen] += self.rng.normal(scale=3.0, size=(len(seen), 3))
        return seen


worlds = st.builds(World, st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([0, 0, 7]))


@settings(deadline=None, max_examples=40)
@given(worlds, st.integers(1, 12))
def test_minimal_triangles(world: World, frames: int) -> None:
    technique = MinimalTriangles(IdentifyOptions())
    technique.learn(world.map, np.zeros(0, dtype=np.int64))
    for _ in range(frames):
        seen = world.frame()
        technique.learn(world.map, seen)
        assert triangles_of(technique) == all_minimal(world.map)


@settings(deadline=None, max_examples=40)
@given(worlds, st.integers(1, 12))
def test_frequency_triangles(world: World, frames: int) -> None:
    technique, reference = FrequencyTriangles(IdentifyOptions()), PairCounts()
    technique.learn(world.map, np.zeros(0, dtype=np.int64))
    for _ in range(frames):
        seen = world.frame()
        technique.learn(world.map, seen)
        reference.learn(world.map, seen)
        assert triangles_of(technique) == reference.triangles(world.map)


@settings(deadline=None, max_examples=20)
@given(worlds, st.integers(1, 12))
def test_the_rank_of_a_frequency_triangle_is_the_count_of_its_rarest_pair(world: World, frames: int) -> None:
    technique, reference = FrequencyTriangles(IdentifyOptions()), PairCounts()
    technique.learn(world.map, np.zeros(0, dtype=np.int64))
    for _ in range(frames):
        seen = world.frame()
        technique.learn(world.map, seen)
        reference.learn(world.map, seen)
        ids = np.sort(world.map.id[technique.triangles()], axis=1)
        expected = [min(reference.count[pair] for pair in combinations(row, 2)) for row in ids.tolist()]
        assert technique._rarest.tolist() == expected


def test_only_what_a_change_touches_is_sought_anew() -> None:
    rng = np.random.default_rng(1)
    map = ReferenceMap.given(rng.uniform(0, 1000, size=(500, 3)))
    nearest = NearestThree()
    nearest.renew(map, np.ones(500, dtype=np.bool_))
    map.xyz_mm[7] += 5.0
    is_changed = np.zeros(500, dtype=np.bool_)
    is_changed[7] = True
    assert 1 <= nearest.renew(map, is_changed).sum() < 20
