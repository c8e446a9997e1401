"""Rivals are bounded, not all built: what the bound leaves out could not have come near enough."""

from itertools import combinations

import numpy as np
import pytest

from constellations import front_map, indexed, looking, saying, scattered, seen_points
from trifix.geometry.pose import exp_rotation
from trifix.index import MapIndex
from trifix.kernels.positioning import covering_triples
from trifix.records import Fix, Identification, NoFix, Reason, ReferenceMap, SensorPoints
from trifix.stages.orient import orient
from trifix.stages.verify import Evidence, VerifyOptions, verify


@pytest.mark.parametrize("n", [3, 4, 7, 12, 25])
def test_any_so_many_points_contain_a_covering_triple(n: int) -> None:
    rng = np.random.default_rng(n)
    xyz = scattered(rng, n)
    for needed in range(3, n + 1):
        triples = {frozenset(row) for row in covering_triples(xyz, needed).tolist()}
        assert all(len(triple) == 3 for triple in triples)
        for _ in range(200):
            chosen = rng.permutation(n)[:needed].tolist()
            assert any(frozenset(triple) in triples for triple in combinations(chosen, 3))


def test_fewer_triples_cover_where_more_points_are_needed() -> None:
    xyz = scattered(np.random.default_rng(1), 25)
    assert len(covering_triples(xyz, 3)) == 2300
    assert len(covering_triples(xyz, 15)) < 40


def twofold(rng: np.random.Generator, common: int, lone: int) -> tuple[np.ndarray, int]:
    """A map in which ``common`` targets stand twice, congruent, the copy far away, each among ``lone`` others."""
    patch = scattered(rng, common, (120.0, 100.0, 40.0), 14.0)
    turned = patch @ exp_rotation(np.array([0.0, 0.0, rng.uniform(-3, 3)])).T + [600.0, 0.0, 0.0]
    others = [scattered(rng, lone, (140.0, 120.0, 50.0), 12.0) + [x, 0.0, 0.0] for x in (0.0, 600.0)]
    far = [
        o[np.linalg.norm(o[:, None] - p, axis=2).min(axis=1) > 8] for o, p in zip(others, (patch, turned), strict=True)
    ]
    return np.vstack([patch, far[0], turned, far[1]]), common + len(far[0])


def brute_force(points: SensorPoints, map: ReferenceMap, index: MapIndex, options: VerifyOptions) -> Fix | NoFix:
    """The verdict over every triangle of the frame on every triangle of the map whose sides agree."""
    triples = np.array(list(combinations(range(len(points)), 3)))
    apart = np.linalg.norm(map.xyz_mm[:, None] - map.xyz_mm, axis=2)
    found_p, found_q = [], []
    for a, b, c in triples.tolist():
        side = [np.linalg.norm(points.xyz_mm[i] - points.xyz_mm[j]) for i, j in ((a, b), (b, c), (a, c))]
        for p, q in np.argwhere(np.abs(apart - side[0]) < 1.0).tolist():
            for r in np.flatnonzero((np.abs(apart[q] - side[1]) < 1.0) & (np.abs(apart[p] - side[2]) < 1.0)).tolist():
                found_p.append((a, b, c))
                found_q.append((p, q, r))
    every = Identification(np.array(found_p), np.array(found_q), expected_by_chance=1.0)
    return verify(Evidence.of(points), map, index, every, orient(points, map, every), options=options)


@pytest.mark.parametrize("seed", range(12))
def test_no_rival_is_lost(seed: int) -> None:
    """Frames of a place that stands twice in the map are as ambiguous as all hypotheses together make them."""
    rng = np.random.default_rng(seed)
    world, here = twofold(rng, common=int(rng.integers(4, 10)), lone=int(rng.integers(0, 8)))
    map, T = front_map(world, 0.02), looking(rng)
    index = indexed(map)
    points = seen_points(world[:here], T, rng)
    options = VerifyOptions(max_solutions=60)
    one = saying(list(zip(range(3), range(3), strict=True)))
    found = verify(Evidence.of(points), map, index, one, orient(points, map, one), options=options)
    expected = brute_force(points, map, index, options)
    assert type(found) is type(expected)
    if isinstance(found, NoFix) and isinstance(expected, NoFix):
        assert found.why is expected.why
        assert found.why in (Reason.ambiguous, Reason.not_proven)
        for rival in expected.rivals:
            assert any(rival.T_world_sensor.distance_mm(other.T_world_sensor) < 2.0 for other in found.rivals)


@pytest.mark.parametrize("seed", range(6))
def test_a_look_alike_is_found_though_points_that_are_no_targets_lie_between_all_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    patch = scattered(rng, 7, (90.0, 90.0, 30.0), 12.0)
    turned = patch @ exp_rotation(np.array([0.0, 0.0, rng.uniform(-3, 3)])).T + [600.0, 0.0, 0.0]
    rest = scattered(rng, 120, (1200.0, 1200.0, 60.0)) + [0.0, 900.0, 0.0]
    map, T = front_map(np.vstack([patch, turned, rest]), 0.02), looking(rng)
    clutter = (rng.random((60, 3)) - 0.5) * [180.0, 180.0, 60.0]
    points = seen_points(np.vstack([patch, clutter]), T, rng)
    index, one = indexed(map), saying(list(zip(range(3), range(3), strict=True)))
    found = verify(Evidence.of(points), map, index, one, orient(points, map, one))
    assert isinstance(found, NoFix)
    assert found.why is Reason.ambiguous
