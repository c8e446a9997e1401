"""When two triangles are congruent, and which of their vertices then pair."""

import numpy as np
import pytest
from scatters import looking_at, points_at

from trifix.errors import ConfigError
from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap, SensorPoints
from trifix.stages.identify import IdentifyOptions
from trifix.stages.identify.congruence import congruent_triangles, widest_triangles

TRIANGLE = np.array([[0, 1, 2]])
SCALENE = np.array([[0.0, 0, 0], [50, 0, 0], [10, 35, 0]])
ISOSCELES = np.array([[0.0, 0, 0], [40, 0, 0], [20, 60, 0]])
EQUILATERAL = np.array([[0.0, 0, 0], [40, 0, 0], [20, 20 * np.sqrt(3), 0]])
ABOVE = looking_at(np.array([10.0, 10, 0]), np.array([40.0, -60, 300]), roll_rad=1.0)
ONE_MM = IdentifyOptions(max_sigmas=0.0, tolerance_mm=1.0)


def sighting(xyz_mm: np.ndarray, T: Pose = ABOVE, sigma_mm: float = 0.0) -> SensorPoints:
    return points_at(T.inverse().apply(xyz_mm), sigma_mm, np.random.default_rng(1))


def pairs(points: SensorPoints, map: ReferenceMap, options: IdentifyOptions) -> list[dict[int, int]]:
    found = list(congruent_triangles(points, map, TRIANGLE, TRIANGLE, options))
    return [
        dict(zip(p.tolist(), q.tolist(), strict=True))
        for each in found
        for p, q in zip(each.point, each.target, strict=True)
    ]


def from_above(xyz_mm: np.ndarray) -> ReferenceMap:
    return ReferenceMap.given(xyz_mm, view=np.tile([0.0, 0.0, 1.0], (len(xyz_mm), 1)))


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 0], [2, 1, 0], [0, 2, 1]])
def test_scalene_triangles_pair_by_their_sides_whatever_the_order_of_their_points(order: list[int]) -> None:
    points = sighting(SCALENE[order])
    expected = dict(enumerate(order))
    assert pairs(points, ReferenceMap.given(SCALENE), ONE_MM) == [expected]


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 0, 2]])
def test_isosceles_triangles_pair_by_the_side_from_which_they_are_seen(order: list[int]) -> None:
    points = sighting(ISOSCELES[order])
    expected = dict(enumerate(order))
    assert pairs(points, from_above(ISOSCELES), ONE_MM) == [expected]


def test_isosceles_triangles_pair_both_ways_where_nothing_tells_from_which_side_they_are_seen() -> None:
    found = pairs(sighting(ISOSCELES), ReferenceMap.given(ISOSCELES), ONE_MM)
    assert len(found) == 2
    assert {0: 0, 1: 1, 2: 2} in found
    assert {0: 1, 1: 0, 2: 2} in found


def test_triangles_with_two_equal_long_sides_or_two_equal_short_sides_are_both_resolved() -> None:
    flat = np.array([[0.0, 0, 0], [60, 0, 0], [30, 10, 0]])  # the two shortest sides are equal
    assert pairs(sighting(flat), from_above(flat), ONE_MM) == [{0: 0, 1: 1, 2: 2}]


def test_equilateral_triangles_are_refused() -> None:
    assert pairs(sighting(EQUILATERAL), from_above(EQUILATERAL), ONE_MM) == []


def test_a_scalene_triangle_seen_from_behind_is_no_match() -> None:
    below = looking_at(np.array([10.0, 10, 0]), np.array([40.0, -60, -300]))
    assert pairs(sighting(SCALENE, below), from_above(SCALENE), ONE_MM) == []


@pytest.mark.parametrize(("change_mm", "agrees"), [(0.9, True), (1.1, False)])
def test_the_single_tolerance_of_the_paper_is_a_limit_in_millimetres(change_mm: float, agrees: bool) -> None:
    longer = SCALENE.copy()
    longer[1, 0] += change_mm  # one side longer by this; another by less
    assert bool(pairs(sighting(longer), ReferenceMap.given(SCALENE), ONE_MM)) is agrees


@pytest.mark.parametrize(("sigma_mm", "agrees"), [(0.05, False), (0.5, True)])
def test_the_tolerance_follows_from_the_covariances_of_the_points(sigma_mm: float, agrees: bool) -> None:
    longer = SCALENE.copy()
    longer[1, 0] += 0.8
    exact = sighting(longer)
    points = SensorPoints(
        exact.xyz_mm, np.tile(np.eye(3) * sigma_mm**2, (3, 1, 1)), exact.match, exact.label, exact.row
    )
    assert bool(pairs(points, ReferenceMap.given(SCALENE), IdentifyOptions(max_sigmas=3.0))) is agrees


def test_a_portion_is_compared_with_all_triangles_of_the_frame() -> None:
    rng = np.random.default_rng(2)
    xyz = rng.uniform(0, 100, size=(12, 3))
    every = np.array([[i, j, k] for i in range(12) for j in range(i) for k in range(j)])
    found = list(
        congruent_triangles(
            sighting(xyz), ReferenceMap.given(xyz), every, every, IdentifyOptions(portion=100, tolerance_mm=0.01)
        )
    )
    assert [each.comparisons for each in found] == [220 * 100, 220 * 100, 220 * 20]
    assert sum(len(each) for each in found) >= 220


def test_higher_ranks_come_first() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0, 100, size=(9, 3))
    triangles = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    found = congruent_triangles(
        sighting(xyz), ReferenceMap.given(xyz), triangles, triangles, ONE_MM, rank=np.array([5, 9, 7])
    )
    first: Identification = next(found)
    assert [sorted(row) for row in first.target.tolist()] == [[3, 4, 5], [6, 7, 8], [0, 1, 2]]


def test_a_set_of_pairs_becomes_its_widest_triangles() -> None:
    xyz = np.array([[0.0, 0, 500], [100, 0, 500], [0, 100, 500], [10, 10, 500], [20, 10, 500]])
    found = widest_triangles(points_at(xyz, 0.0, np.random.default_rng(0)), np.arange(5), np.arange(5) + 7, 3)
    assert sorted(found.point[0].tolist()) == [0, 1, 2]
    assert np.array_equal(found.target, found.point + 7)
    assert found.comparisons == 3
    assert len(widest_triangles(points_at(xyz, 0.0, np.random.default_rng(0)), np.arange(2), np.arange(2), 0)) == 0


def test_impossible_options_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"identify\.portion"):
        IdentifyOptions(portion=0)
    with pytest.raises(ConfigError, match=r"identify\.max_step_mm"):
        IdentifyOptions(max_step_mm=0.0)
